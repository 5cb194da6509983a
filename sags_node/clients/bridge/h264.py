"""Images as H.264 for thin links, by PyAV: each message is one image (Annex B)."""

from fractions import Fraction

import av
import numpy as np
from av.video.frame import PictureType
from av.video.reformatter import Colorspace

from sags_node.clients.bridge.compressed import over_black
from sags_node.types import U8

RATE = 30.0  # Hz of the images, from which the largest bit rate follows
KEY_EVERY = 30  # images: who comes, or has lost one, sees something within a second
BITS_PER_PIXEL = 0.2  # of an image: 2 Mbit/s at 640x512 and 30 Hz, with tissue still sharp


class Encoder:
    """The encoder of one stream of images, whose size may change.

    No image refers to a later one, and each key image says all that a decoder must know.
    """

    def __init__(self) -> None:
        self._codec: av.VideoCodecContext | None = None
        self._number = 0

    def encode(self, picture: U8, key: bool = False) -> bytes:
        """Encode an image [H, W, 3], or [H, W, 4] over black (H.264 has no alpha), cut to even sizes.

        Args:
            key: make it a key image, which refers to no other.
        """
        height, width = (side - side % 2 for side in picture.shape[:2])
        if self._codec is None or (self._codec.height, self._codec.width) != (height, width):
            self._codec, self._number = self._opened(width, height), 0
        rgb = over_black(picture) if picture.shape[2] == 4 else picture
        even = np.ascontiguousarray(rgb[:height, :width])
        frame = av.VideoFrame.from_ndarray(even, "rgb24").reformat(format="yuv420p")
        frame.pts, self._number = self._number, self._number + 1
        frame.pict_type = PictureType.I if key else PictureType.NONE
        return b"".join(bytes(packet) for packet in self._codec.encode(frame))

    def _opened(self, width: int, height: int) -> av.VideoCodecContext:
        codec = av.CodecContext.create("libx264", "w")
        assert isinstance(codec, av.VideoCodecContext)
        codec.width, codec.height, codec.pix_fmt = width, height, "yuv420p"
        codec.time_base = Fraction(1, round(RATE))
        codec.thread_count = 1
        codec.colorspace = Colorspace.ITU601  # stated, as decoders take HD for BT.709 otherwise
        bits = round(BITS_PER_PIXEL * width * height * RATE)
        codec.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "forced-idr": "1",
            "x264-params": f"keyint={KEY_EVERY}:annexb=1:repeat-headers=1:vbv-maxrate={bits // 1000}"
            f":vbv-bufsize={bits // 1000 // 4}",
            "crf": "26",
        }
        return codec
