"""What figures were computed from, so that others can tell whether their figures are comparable."""

import hashlib
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sags_node.tools.evaluation.lpips import BACKBONE
from sags_node.types import Bool, StereoFrame, StereoRig

DIGITS = 16  # of a digest


class Receipt:
    """Takes note of all that was compared, frame by frame. Host, revision and command are in `provenance`."""

    def __init__(self, rig: StereoRig, size: tuple[int, int], lpips_weights: Path | None) -> None:
        """
        Args:
            rig: that the images were rectified by.
            size: width and height at which they were compared, px.
        """
        self._calibration = rig_digest(rig)
        self._raw, self._size = (rig.left.width, rig.left.height), size
        self._weights = lpips_weights
        self._ids: list[int] = []
        self._pictures, self._masks = hashlib.sha256(), hashlib.sha256()
        self._counted = 0

    def add(self, frame: StereoFrame, tissue: Bool) -> None:
        """Take note of a frame that was compared where `tissue` [H, W] is True."""
        self._ids.append(frame.frame_id)
        self._pictures.update(frame.left.tobytes())
        self._masks.update(np.packbits(tissue).tobytes())
        self._counted += int(np.count_nonzero(tissue))

    def as_json(self) -> dict[str, Any]:
        """Return all notes; digests are the first sixteen hex digits of SHA-256."""
        width, height = self._size
        return {
            "frames": {"count": len(self._ids), "ids": _spans(self._ids), "digest": _short(self._pictures)},
            "masks": {
                "polarity": "counted where 1: tissue",
                "pixels_counted": self._counted,
                "share": round(self._counted / max(1, len(self._ids) * width * height), 4),
                "digest": _short(self._masks),
            },
            "size": {
                "recorded": list(self._raw),
                "compared": list(self._size),
                "resizing": "shrunk by area, then rectified by a bilinear look-up",
            },
            "values": "RGB of 8 bits, divided by 255; drawn colours were clipped to 0..1 before",
            "lpips": None
            if self._weights is None
            else {"network": BACKBONE, "weights": digest(self._weights.read_bytes())},
            "calibration": self._calibration,
        }


def rig_digest(rig: StereoRig) -> str:
    """The digest of a calibration's numbers."""
    eyes = (rig.left, rig.right)
    numbers = [np.asarray(part, np.float64) for eye in eyes for part in (eye.K, eye.distortion, eye.R, eye.P)]
    return digest(*(part.tobytes() for part in numbers))


def digest(*parts: bytes) -> str:
    """The first sixteen hex digits of the SHA-256 of all parts together."""
    return _short(hashlib.sha256(b"".join(parts)))


def _short(found: Any) -> str:
    return str(found.hexdigest())[:DIGITS]


def _spans(ids: list[int]) -> str:
    """Frame numbers as text: `0-3, 5` for 0, 1, 2, 3, 5."""
    if not ids:
        return ""
    breaks = [i for i, (a, b) in enumerate(pairwise(ids), 1) if b != a + 1]
    starts, stops = [0, *breaks], [*breaks, len(ids)]
    spans = [(ids[start], ids[stop - 1]) for start, stop in zip(starts, stops, strict=True)]
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in spans)
