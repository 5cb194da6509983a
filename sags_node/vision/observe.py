"""Pictures and depth -> what the mapper may know of one frame."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.types import F32, Bool, Observation, RectifiedPair


def observe(
    pair: RectifiedPair, tissue: Bool, depth: F32, confidence: F32, right_eye: bool = False
) -> Observation:
    """Gather one frame's observation.

    Args:
        depth, confidence: [H, W] those of `StereoDepth`.
        right_eye: with the right eye's picture, where there is one.
    """
    return Observation(
        frame_id=pair.frame_id,
        t_capture_ns=pair.t_capture_ns,
        camera=pair.camera,
        image=pair.left * np.float32(1 / 255),
        gray=cv2.cvtColor(pair.left, cv2.COLOR_RGB2GRAY),
        tissue=tissue,
        depth=depth,
        depth_confidence=confidence,
        right=pair.right * np.float32(1 / 255) if right_eye and pair.right is not None else None,
        baseline=pair.baseline,
    )
