"""Which learner a fit gets: the CPU's, or a GPU's with the CPU's to fall back to."""

from __future__ import annotations

from sags_node.engine.rasterizer.rasterize import Rasterizer
from sags_node.fitting.learner import CpuLearner, DeviceKind, Learner
from sags_node.fitting.settings import FitSettings
from sags_node.types import Bool


def make_learner(device: DeviceKind, rasterizer: Rasterizer, settings: FitSettings, unseen: Bool) -> Learner:
    """A learner for pictures of the size of `unseen` [H, W]: the pixels that no frame shows.

    Args:
        device: where it works; a GPU must be usable, see `engine.device.choose_device`.
        rasterizer: on the CPU, for pictures of that size.
        settings: of the fit.
        unseen: where smoothness applies.
    """
    cpu = CpuLearner(rasterizer, settings, unseen)
    if device == "cpu":
        return cpu
    from sags_node.fitting.cuda.learner import CudaLearner
    from sags_node.fitting.fallback_learner import FallbackLearner

    return FallbackLearner(CudaLearner(settings, unseen), cpu)
