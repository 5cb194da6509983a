"""Images half way between training frames, by optical flow: they teach the model what moves in between."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from statistics import median

import cv2
import numpy as np

from sags_node.geometry import rigid
from sags_node.tools.fitting.clip import ClipFrame, is_cut
from sags_node.types import F64

SMOOTH = 1.5  # px, standard deviation of the blur of the flow: OpenCV's jumps from patch to patch
GAP = 3.5  # usual steps of the clip: one frame held out makes two of one, and a lost one beside it three


def midway_frames(frames: Sequence[ClipFrame]) -> list[ClipFrame]:
    """Make a frame between every two consecutive ones, at the mean of their times; but none across a cut or a
    gap in time, where nothing says what lay between.

    Its colours and depth are the means of both at the same tissue, which is taken to move in a straight line.
    Optical flow matches it (Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016, as in
    OpenCV). Where one of both shows no tissue, it has none.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    steps = [after.t_capture_ns - before.t_capture_ns for before, after in pairwise(frames)]
    longest = GAP * median(steps or [0])
    return [
        _midway(before, after, flow)
        for (before, after), step in zip(pairwise(frames), steps, strict=True)
        if step <= longest and not is_cut(before, after)
    ]


def _midway(before: ClipFrame, after: ClipFrame, flow: cv2.DISOpticalFlow) -> ClipFrame:
    height, width = before.tissue.shape
    here = np.moveaxis(np.indices((height, width), np.float32)[::-1], 0, -1)
    grays = [cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY) for frame in (before, after)]
    images, tissue, depths = [], np.ones((height, width), np.bool_), []
    for near, grey, other in zip((before, after), grays, grays[::-1], strict=True):
        # The flow to this image is defined in the other one's pixels, so half of it lies a little beside.
        there = here + cv2.GaussianBlur(flow.calc(other, grey, None), (0, 0), SMOOTH) / 2
        images.append(cv2.remap(near.image, there, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))
        tissue &= cv2.remap(near.tissue.view(np.uint8), there, None, cv2.INTER_NEAREST) > 0
        depths.append(cv2.remap(near.depth, there, None, cv2.INTER_NEAREST))
    known = (depths[0] > 0) & (depths[1] > 0)
    return ClipFrame(
        before.frame_id,
        (before.t_capture_ns + after.t_capture_ns) // 2,
        replace(before.camera, T_world_cam=_pose_midway(before.camera.T_world_cam, after.camera.T_world_cam)),
        cv2.addWeighted(images[0], 0.5, images[1], 0.5, 0),
        tissue,
        tissue,
        np.where(known, (depths[0] + depths[1]) / 2, np.float32(0)),
        None,
    )


def _pose_midway(before: F64, after: F64) -> F64:
    """The pose half way, [4, 4]: half the rotation, half the translation."""
    turn, _ = cv2.Rodrigues(before[:3, :3].T @ after[:3, :3])
    half, _ = cv2.Rodrigues(turn / 2)
    return rigid(before[:3, :3] @ half, (before[:3, 3] + after[:3, 3]) / 2)
