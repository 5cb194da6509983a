"""A rig for eyes that nobody has calibrated: usual optics, and the rows that their own images show."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from sags_node.config.schema import RecordedSource, Source
from sags_node.errors import SagsError
from sags_node.rig import guessed_rig
from sags_node.sources.replay import Replay
from sags_node.sources.source import open_source
from sags_node.tools.calibration.matches import match_eyes
from sags_node.tools.calibration.pictures import Pair
from sags_node.tools.calibration.rows import FEWEST_MATCHES, rectified_rows
from sags_node.types import F64, Eye, StereoRig

LOOKED_AT = 4  # pairs of images
EVERY = 10  # frames from one pair to the next
ROUNDS = 3  # of fitting: turning an eye also moves columns, and these change rows


def guess_rig(source: Source) -> StereoRig:
    """A rig for the images of a source, with depth up to an unknown scale; not `metric`.

    Raises:
        SagsError: it gives no frame.
    """
    (width, height), pixel_aspect, pairs = first_pairs(source)
    return with_equal_rows(guessed_rig(width, height, pixel_aspect), pairs)


def with_equal_rows(rig: StereoRig, pairs: Sequence[Pair]) -> StereoRig:
    """The rig with its right eye turned and zoomed until the rows of images agree; unchanged where too
    little matches."""
    matches = np.concatenate([np.empty((0, 4)), *(match_eyes(*pair) for pair in pairs)])
    if len(matches) < FEWEST_MATCHES:
        return rig
    for _ in range(ROUNDS):
        rows = rectified_rows(rig, matches)
        pitch, roll = np.radians(rows.turn)
        scale = rows.scale if rows.scale_differs else 0.0
        rig = replace(rig, right=_turned(rig.right, pitch, roll, 1 + scale))
    return rig


def _turned(eye: Eye, pitch: float, roll: float, scale: float) -> Eye:
    """The eye with points higher by `pitch` + `roll` x at distance 1, an image `scale` times as large."""
    turn: F64 = cv2.Rodrigues(np.array([pitch, 0.0, -roll]))[0]
    K = np.diag([scale, scale, 1.0]) @ eye.K
    K[:2, 2] = eye.K[:2, 2]
    return replace(eye, K=K, R=turn @ eye.R)


def first_pairs(source: Source, count: int = LOOKED_AT) -> tuple[tuple[int, int], float, list[Pair]]:
    """The width and height of an eye's image, px, the aspect ratio of its pixels, and some pairs; no pairs
    where there is one eye.

    Raises:
        SagsError: it gives no frame.
    """
    if isinstance(source, RecordedSource):
        source = source.model_copy(update={"pace": "step", "loop": False, "warm_up": 0})
    size, pairs = None, list[Pair]()
    with open_source(source, references=False, quiet=True) as opened:
        reader = opened.pairs if isinstance(opened, Replay) else opened
        pixel_aspect = float(getattr(reader, "pixel_aspect", 1.0))
        for index, frame in enumerate(opened):
            size = size or (frame.left.shape[1], frame.left.shape[0])
            if frame.right is not None and index % EVERY == 0:
                pairs.append((frame.left, frame.right))
            if frame.right is None or len(pairs) == count:
                break
    if size is None:
        raise SagsError("no calibration, and not one frame came that could tell a size; set rig")
    return size, pixel_aspect, pairs
