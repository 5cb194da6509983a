"""Compile (once per machine) and load every kernel of the frame path, before the first frame needs it."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.calibration import rectified_rig
from sags_node.config import LaunchConfig, MappingConfig, VisionConfig
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline import Pipeline
from sags_node.types import StereoFrame, StereoRig
from sags_node.vision.tissue_classical import InstrumentFinder

_WIDTH, _HEIGHT, _FOCAL, _BASELINE, _DISPARITY = 160, 128, 150.0, 0.0043, 8


def warm_up(config: LaunchConfig) -> None:
    """Run a few small made-up frames through a pipeline of the same kind.

    Kernels do not depend on sizes, so this takes well under a second once they are in Numba's disk cache,
    and about half a minute the first time. A GPU is tried out, and its kernels are compiled, by the same
    frames.

    Raises:
        UsageError: a GPU is wanted and none can be used.
    """
    small = config.model_copy(
        update={
            "vision": VisionConfig(stereo=config.vision.stereo, pose=config.vision.pose),
            "mapping": MappingConfig(max_gaussians=1000, right_eye=config.mapping.right_eye),
        }
    )
    pipeline = Pipeline(small, _rig())
    budget = StepBudget(2)  # the first on the whole picture, the second where it is worst
    coarse = np.random.default_rng(0).integers(40, 220, (_HEIGHT // 4, _WIDTH // 4 + 16, 3), np.uint8)
    texture = cv2.resize(coarse, (_WIDTH + 64, _HEIGHT))
    for i in range(3):
        left = np.ascontiguousarray(texture[:, i : i + _WIDTH])
        right = np.ascontiguousarray(texture[:, i + _DISPARITY : i + _DISPARITY + _WIDTH])
        tissue = np.ones((_HEIGHT, _WIDTH), bool)
        stamp = i * 33_000_000
        result = pipeline.process(StereoFrame(i, stamp, stamp, left, right, tissue=tissue), budget)
    InstrumentFinder()(left, result.views["left"])  # for sessions without masks


def _rig() -> StereoRig:
    K = np.array([[_FOCAL, 0, _WIDTH / 2], [0, _FOCAL, _HEIGHT / 2], [0, 0, 1]])
    return rectified_rig("warm-up", _WIDTH, _HEIGHT, K, _BASELINE)
