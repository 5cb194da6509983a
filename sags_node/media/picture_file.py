"""Picture files: others' are decoded after a look at their size; how PNG is written."""

from __future__ import annotations

import logging
import re
import threading
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.errors import SagsError
from sags_node.media.native_output import native_output
from sags_node.media.picture_header import KINDS, claimed_size

log = logging.getLogger(__name__)

MAX_PIXELS = 64 << 20
_MOST_KINDS = 32
_FILTER, _PAETH = 19, 128  # cv2.IMWRITE_PNG_FILTER, which older versions have not and pass over
# Options of `cv2.imencode` for pictures of a camera, masks and depth: one filter for all rows, and runs
# alone. OpenCV with a level but no filter tries all of them in each row: a third to two thirds more time.
PNG = (
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_RLE,
    _FILTER,
    _PAETH,
)


def decode(data: bytes | NDArray[np.uint8], flags: int, where: str, fix: str) -> NDArray[Any]:
    """A picture as OpenCV decodes it.

    What the decoder says of a picture that it could read goes to the log, with `where`.

    Args:
        flags: of `cv2.imdecode`.
        where: what to call it in messages.
        fix: what to do where it is damaged.

    Raises:
        SagsError: it is of another kind, damaged, or says that it is larger than `MAX_PIXELS`.
    """
    array = np.frombuffer(data, np.uint8)
    size = claimed_size(array.data)
    if size is None:
        raise SagsError(f"{where} is no {KINDS}, or is damaged ({array.size} bytes); {fix}")
    width, height = size
    if not 0 < width * height <= MAX_PIXELS:
        raise SagsError(
            f"{where} says that it is {width}x{height} px; at most {MAX_PIXELS >> 20} Mpx are read; {fix}"
        )
    with native_output() as said:
        try:
            picture: NDArray[Any] | None = cv2.imdecode(array, flags)
        except cv2.error:
            picture = None
    if picture is None:
        reason = f": {said[-1]}" if said else ""
        raise SagsError(f"{where} is damaged or cut off ({array.size} bytes){reason}; {fix}")
    complaints.tell(where, said)
    return picture


class Complaints:
    """What decoders say, once of each kind: all pictures of a recording often have the same flaw."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kinds: set[str] = set()

    def tell(self, where: str, said: list[str]) -> None:
        for line in said:
            kind = re.sub(r"\d+|0x[0-9a-f]+", "", line)
            with self._lock:
                is_new = kind not in self._kinds and len(self._kinds) < _MOST_KINDS
                if is_new:
                    self._kinds.add(kind)
            if is_new:
                log.warning("%s: %s (said once, of the first such picture)", where, line)


complaints = Complaints()
