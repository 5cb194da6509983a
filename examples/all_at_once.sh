#!/bin/sh
# A node, the overlay and a bridge, started and ended together:
#
#   examples/all_at_once.sh launch/d4d_pull.yaml source.loop:=true
#   SCENE=vessels.yaml BRIDGE="ros2 --domain 7" examples/all_at_once.sh mine.yaml
#
# Overlay and bridge wait for the node. When it ends, or on Ctrl-C, all end. As services: examples/systemd.
set -eu
sags overlay ${SCENE:+--scene "$SCENE"} & started=$!
sags bridge ${BRIDGE:-web} & started="$started $!"
sags run "$@" & node=$!
trap 'kill $started $node 2>/dev/null; wait' EXIT
trap 'exit 130' INT TERM
wait $node
