#!/bin/bash
# A node, the overlay and a bridge, started and ended together:
#
#   examples/all_at_once.sh launch/d4d_pull.yaml source.loop:=true
#   SCENE=vessels.yaml BRIDGE="ros2 --domain 7" examples/all_at_once.sh mine.yaml
#
# Overlay and bridge wait for the node. When one of the three ends, or on Ctrl-C, all end. As services: examples/systemd.
set -u
declare -A name
trap 'kill ${!name[@]} 2>/dev/null; wait' EXIT
trap 'exit 130' INT TERM
sags overlay ${SCENE:+--scene "$SCENE"} & name[$!]="sags overlay"
sags bridge ${BRIDGE:-web} & name[$!]="sags bridge ${BRIDGE:-web}"
sags run "$@" & name[$!]="sags run $*"
wait -n -p first; status=$?
[ $status = 0 ] || echo "${name[$first]} ended with exit code $status; the others end with it" >&2
exit $status
