"""Pictures and depth -> what the mapper may know of one frame."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.types import F32, Bool, Observation, RectifiedPair


def observe(pair: RectifiedPair, tissue: Bool, depth: F32, confidence: F32) -> Observation:
    """Gather one frame's observation; `depth` and `confidence` [H, W] are those of `StereoDepth`."""
    return Observation(
        frame_id=pair.frame_id,
        t_capture_ns=pair.t_capture_ns,
        camera=pair.camera,
        image=pair.left * np.float32(1 / 255),
        gray=cv2.cvtColor(pair.left, cv2.COLOR_RGB2GRAY),
        tissue=tissue,
        depth=depth,
        depth_confidence=confidence,
    )
