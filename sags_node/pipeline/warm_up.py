"""Compile (once per machine) and load every kernel of the frame path, before the first frame needs it."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np

from sags_node.config.schema import LaunchConfig, MappingConfig, VisionConfig
from sags_node.kernels.cache import is_cold
from sags_node.kernels.threads import configure_threads
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.devices import device_of
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.processes import end
from sags_node.rig import rectified_rig
from sags_node.types import U8, StereoFrame, StereoRig
from sags_node.vision.flow import OpticalFlow
from sags_node.vision.inverse_search import spread_patches
from sags_node.vision.pyramid import pyramids
from sags_node.vision.rectify import Rectifier
from sags_node.vision.stereo import StereoDepth
from sags_node.vision.tissue_classical import InstrumentFinder

COMPILING = 600.0  # s, longest compilation of the vision's kernels on a slow machine
# Images large enough for kernels of several threads: smaller ones use other kernels.
_WIDTH, _HEIGHT, _FOCAL, _BASELINE, _DISPARITY = 240, 192, 225.0, 0.0043, 12


def warm_up(config: LaunchConfig) -> None:
    """Run a few small made-up frames through a pipeline of the same kind.

    Kernels do not depend on sizes. This takes well under a second once they are in Numba's disk cache, and
    about a minute the first time, when a second process compiles those of the vision. With a GPU those of
    the CPU are prepared, too: the CPU goes on if the GPU fails.

    Raises:
        UsageError: a GPU is wanted and none can be used.
    """
    if device_of(config).kind == "cuda":
        warm_up(config.model_copy(update={"device": "cpu"}))
    small = config.model_copy(
        update={
            "vision": VisionConfig(stereo=config.vision.stereo, pose=config.vision.pose),
            "mapping": MappingConfig(method=config.mapping.method, max_gaussians=1000),
        }
    )
    pipeline = Pipeline(small, _rig())
    right = config.publish.right is not False
    request = FrameRequest(left=True, right=right, instruments=True)  # somebody may look
    budget = StepBudget(2)  # the first step covers the whole image, the second where it is worst
    frames = _frames()
    with _vision_beside():
        for frame in frames[:3]:  # these bring their depth: the other process compiles stereo
            pipeline.process(frame, budget, request)
    for frame in frames[3:]:
        result = pipeline.process(frame, budget, request)
    InstrumentFinder()(frames[-1].left, result.views["left"])  # for sessions without masks


def prepare(config: LaunchConfig) -> None:
    """Warm up, then let this thread's kernels use as many cores as the launch file says."""
    warm_up(config)
    configure_threads(config.engine.threads)


def compile_vision() -> None:
    """Compile and cache the kernels of optical flow and stereo, in the order in which they are needed."""
    rectifier = Rectifier(_rig(), _WIDTH, _HEIGHT)
    before, after = (rectifier(frame) for frame in _frames()[-2:])
    OpticalFlow(stride=4)(pyramids(before)[0], pyramids(after)[0])
    StereoDepth(VisionConfig().stereo, rectifier.camera, _BASELINE)(
        after, np.ones((_HEIGHT, _WIDTH), np.bool_)
    )


@contextmanager
def _vision_beside() -> Iterator[None]:
    """If nothing is compiled yet, run `compile_vision` in another process during the block. It only saves
    time: what it does not finish is compiled here."""
    if not is_cold(spread_patches):
        yield
        return
    other = subprocess.Popen(
        [sys.executable, "-c", "from sags_node.pipeline.warm_up import compile_vision; compile_vision()"],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        yield
        other.wait(COMPILING)
    except subprocess.TimeoutExpired:
        pass
    finally:
        end(other, grace=0.0)


def _frames() -> list[StereoFrame]:
    """Six frames of an image that moves by a pixel per frame. The first three bring their depth. In the
    last three the scope moves instead of the tissue, and an instrument hides tissue."""
    coarse: U8 = np.random.default_rng(0).integers(40, 220, (_HEIGHT // 4, _WIDTH // 4 + 16, 3), np.uint8)
    texture = cv2.resize(coarse, (_WIDTH + 64, _HEIGHT))
    tissue, free = np.ones((2, _HEIGHT, _WIDTH), np.bool_)
    tissue[_HEIGHT // 3 : _HEIGHT // 2, : _WIDTH // 2] = False
    depth = np.full((_HEIGHT, _WIDTH), np.float32(_FOCAL * _BASELINE / _DISPARITY))
    frames = []
    for i in range(6):
        left = np.ascontiguousarray(texture[:, i : i + _WIDTH])
        right = np.ascontiguousarray(texture[:, i + _DISPARITY : i + _DISPARITY + _WIDTH])
        stamp = i * 33_000_000
        own, seen = (depth, free) if i < 3 else (None, tissue)
        pose = np.eye(4)
        pose[0, 3] = max(0, i - 2) * _BASELINE / _DISPARITY
        frames.append(StereoFrame(i, stamp, stamp, left, right, T_world_cam=pose, depth=own, tissue=seen))
    return frames


def _rig() -> StereoRig:
    K = np.array([[_FOCAL, 0, _WIDTH / 2], [0, _FOCAL, _HEIGHT / 2], [0, 0, 1]])
    return rectified_rig("warm-up", _WIDTH, _HEIGHT, K, _BASELINE)
