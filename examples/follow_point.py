"""Pins a point of the tissue, and says where it is as the tissue moves: a consumer of its own.

    sags run launch/d4d_pull.yaml &
    python examples/follow_point.py 320 256

`pip install .` in a clone is enough for it. It may be started before the node. Ctrl-C ends it, and removes
the point.
"""

import argparse
import sys

from sags_node.client import ControlClient, ReceivedCloud, SagsError, Subscriber, TopicName

ANCHORS = TopicName("anchors", ReceivedCloud)
SURE = 0.5  # of both confidences: docs/wire.md, Anchors


def follow(u: float, v: float, frames: int | None) -> None:
    """Print where the tissue at pixel u, v of the left image is, a line for each frame."""
    with Subscriber([ANCHORS], patience=60) as node, ControlClient() as control:
        newest = node.wait(ANCHORS, timeout=60)  # with the first frame there is a model to pin to
        if newest is None:
            raise SagsError(f"no frame came: {node.problem(ANCHORS)}")
        session = newest.meta.session  # of the node; in another one that number is another anchor's
        pinned, came = control.request("add_anchor", {"u": u, "v": v})["id"], False
        try:
            while frames is None or frames > 0:
                newest = node.wait(ANCHORS, timeout=1.0, after=newest)
                if newest is None or not node.ok(ANCHORS):
                    print(f"nothing fresh: {node.problem(ANCHORS)}", file=sys.stderr)
                    continue
                if newest.meta.session != session:
                    raise SagsError("the node was started anew: its anchors are gone; start this again")
                rows = newest.points[newest.points["id"] == pinned]
                if came and not len(rows):
                    session = ""  # there is nothing to remove
                    raise SagsError("somebody else removed the point; start this again")
                if not len(rows):
                    continue  # it was pinned in a frame after this one
                (row,), came = rows, True
                if row["confidence"] < SURE:
                    print("not recognised: show nothing")
                elif row["depth_confidence"] < SURE or not newest.metric:
                    print(f"pixel {row['u']:.1f} {row['v']:.1f}; how deep is a guess")
                else:
                    print(
                        f"pixel {row['u']:.1f} {row['v']:.1f}  {row['x']:.4f} {row['y']:.4f} {row['z']:.4f} m"
                    )
                frames = None if frames is None else frames - 1
        finally:
            if node.latest(ANCHORS).meta.session == session:
                control.request("remove_anchor", {"id": pinned})


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("u", type=float, help="px, in the left image")
    parser.add_argument("v", type=float)
    parser.add_argument("--frames", type=int, help="stop after so many; default: Ctrl-C")
    asked = parser.parse_args()
    try:
        follow(asked.u, asked.v, asked.frames)
    except SagsError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
