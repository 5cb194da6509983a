"""Depth of one eye against depth of the other, for recordings of which nothing is known to be true.

Both eyes see one surface, so what is measured from either must agree. That is needed, not enough: errors that
both have alike are not seen.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.quality.depth import EVERY, Advance, Matcher, make_matchers, rounded
from sags_node.errors import SagsError
from sags_node.evaluation.provenance import machine_name
from sags_node.geometry import disparity_to_depth
from sags_node.kernels.threads import configure_threads
from sags_node.pipeline.session import Session
from sags_node.sources.source import open_source
from sags_node.types import F32, F64, Bool, Camera, RectifiedPair
from sags_node.vision.rectify import Rectifier
from sags_node.vision.tissue import TissueMask

AGREES = 1.0  # px


@dataclass
class EyesTally:
    """What one matcher gave, over all frames so far."""

    differences: list[F64] = field(default_factory=list)  # px, where both eyes have a depth
    times_ms: list[float] = field(default_factory=list)
    tissue: int = 0  # px
    known: int = 0  # px of it

    def add(self, left: F32, right: F32, tissue: Bool) -> None:
        """Disparities [H, W] (px, 0 unknown) of the left picture and of the right one."""
        found = differences(left * tissue, right)
        self.differences.append(found[np.isfinite(found)])
        self.tissue += int(tissue.sum())
        self.known += int((left * tissue > 0).sum())

    def figures(self) -> dict[str, Any]:
        sizes = np.concatenate(self.differences)
        return {
            "median_px": rounded(np.median(sizes)) if sizes.size else None,
            "p90_px": rounded(np.percentile(sizes, 90)) if sizes.size else None,
            "agree": rounded((sizes < AGREES).sum() / self.tissue),
            "coverage": rounded(self.known / self.tissue),
            "ms": rounded(statistics.median(self.times_ms)),
        }


def differences(left: F32, right: F32) -> F64:
    """How far the eyes' disparities differ [H, W], px; NaN where one of them is unknown.

    Args:
        left, right: [H, W] disparity of each eye's own picture, px, 0 unknown.
    """
    columns, rows = np.meshgrid(*(np.arange(side, dtype=np.float32) for side in left.shape[::-1]))
    there = cv2.remap(right, columns - left, rows, cv2.INTER_NEAREST, borderValue=0)
    return np.asarray(np.where((left > 0) & (there > 0), np.abs(left - there), np.nan), np.float64)


def measure_eyes(
    session: Session, advance: Advance, every: int = EVERY, network: Path | None = None
) -> dict[str, Any]:
    """One frame in `every` of a recording, each setting on the pair and on its mirror image.

    Raises:
        SagsError: the recording has no right eye, or no frame with tissue.
        UsageError: as `make_matchers`.
    """
    config, size = session.config, session.working_size
    configure_threads(config.engine.threads)
    rectifier = Rectifier(session.rig, *size)
    find_tissue = TissueMask(config.vision.tissue, rectifier)
    camera, baseline = rectifier.camera, rectifier.baseline
    # One of each for each eye: they keep how near tissue can be.
    sides = [make_matchers(config.vision.stereo, camera, baseline, network) for _ in ("left", "right")]
    tallies = {name: EyesTally() for name in sides[0]}
    measured = 0
    with open_source(config.source) as frames:
        for number, frame in enumerate(frames):
            advance(number + 1, None, "playing")
            if number % every:
                continue
            pair = rectifier(frame)
            if pair.right is None:
                raise SagsError(f"{session.name} has no right eye to compare with")
            tissue = find_tissue(frame, pair)
            for name, tally in tallies.items():
                _add(tally, sides[0][name], sides[1][name], pair, tissue)
            measured += int(tissue.any())
    if measured == 0:
        raise SagsError(f"{session.name} has no frame with tissue")
    return {
        "truth": "none: both eyes against each other",
        "session": session.name,
        "size": size,
        "frames": measured,
        "machine": machine_name(),
        "settings": [{"name": name, **tally.figures()} for name, tally in tallies.items()],
    }


def _add(
    tally: EyesTally, match: Matcher, match_mirrored: Matcher, pair: RectifiedPair, tissue: Bool
) -> None:
    focal = float(pair.camera.K[0, 0])
    if not tally.times_ms:
        match(pair, tissue)  # buffers are made and code is loaded in the first call
    started = time.perf_counter()
    depth, _ = match(pair, tissue)
    tally.times_ms.append((time.perf_counter() - started) * 1e3)
    other, _ = match_mirrored(mirrored(pair), np.ones_like(tissue))
    # Depth and disparity are each other's inverse.
    left, right = (disparity_to_depth(eye, focal, pair.baseline) for eye in (depth, other[:, ::-1]))
    tally.add(left, right, tissue)


def mirrored(pair: RectifiedPair) -> RectifiedPair:
    """The pair in a mirror: its left eye is the right one."""
    assert pair.right is not None  # there is no pair without
    camera = pair.camera
    K = camera.K.copy()
    K[0, 2] = camera.width - 1 - K[0, 2]
    turned = Camera(camera.width, camera.height, K, camera.T_world_cam)
    left, right = (np.ascontiguousarray(eye[:, ::-1]) for eye in (pair.right, pair.left))
    return RectifiedPair(pair.frame_id, pair.t_capture_ns, turned, pair.baseline, left, right)
