"""Tissue masks by a process of your own; this one calls tissue what is red. Put your network in `segment`.

python -m sags_node run vision.tissue.method:=topic vision.tissue.tissue_is:=white \
    vision.tissue.endpoint:=tcp://127.0.0.1:5600
python examples/tissue_masks.py tcp://127.0.0.1:5600
"""

import argparse
import sys
import uuid

import numpy as np

from sags_node.client import ReceivedImage, SagsError, Subscriber, TopicName
from sags_node.config.schema import PublishConfig
from sags_node.messaging import cdr
from sags_node.messaging.publisher import Publisher
from sags_node.types import U8

PICTURE, MASK = TopicName("left/image_rect_color", ReceivedImage), "left/tissue_mask"


def segment(picture: U8) -> U8:
    """255 where an image [H, W, 3] RGB shows tissue, else 0."""
    red, green, _ = np.moveaxis(picture.astype(np.int16), -1, 0)
    return np.where(red - green > 25, 255, 0).astype(np.uint8)


def main(endpoint: str) -> None:
    config = PublishConfig(data=(endpoint,), control=None)
    with Publisher(config, "masks", uuid.uuid4().hex) as publisher, Subscriber([PICTURE]) as subscriber:
        last: ReceivedImage | None = None
        while True:
            publisher.poll(0)  # lets the node subscribe
            newest = subscriber.wait(PICTURE, timeout=0.1, after=last)
            if newest is not None:
                last, stamp_ns = newest, newest.stamp_ns  # the mask bears the stamp of its image
                mask = cdr.image(segment(newest.array), "mono8", stamp_ns)
                publisher.publish_content(MASK, mask, newest.meta.frame_id, stamp_ns, newest.meta.epoch)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("endpoint", help="where the masks are published")
    try:
        main(parser.parse_args().endpoint)
    except SagsError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        pass
