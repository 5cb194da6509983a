"""A GPU that may fail, and the CPU that goes on in its place."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from sags_node.engine.cuda.failures import FAILURES, SHORTAGES, release_memory
from sags_node.mapping.optimiser import LearningRates
from sags_node.mapping.refiner import Refiner
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, Bool, Camera, Finding, Gaussians, Observation

log = logging.getLogger(__name__)

LOWERED = 0.8  # of the Gaussians there were, when the GPU's memory was too small for them
PAUSE = 30  # frames after that on the CPU, in which the mapper gives up as many
Result = TypeVar("Result")


class FallbackRefiner:
    """Refines on the GPU. A frame in which that fails is finished on the CPU: the model still stands there as
    it was before the frame's steps, so nothing but these is lost.

    Where the GPU's memory is too small the model may hold fewer Gaussians from then on, and after `PAUSE`
    frames the GPU is tried again. After any other failure the CPU goes on for good: a CUDA error cannot be
    recovered from in the same process.
    """

    def __init__(self, gpu: Refiner, cpu: Refiner, cpu_share: float) -> None:
        """`cpu_share`: how much of the model's capacity the CPU can refine, 0..1."""
        self.share = 1.0
        self.problem: Finding | None = None
        self._gpu, self._cpu, self._cpu_share = gpu, cpu, cpu_share
        self._working = gpu
        self._failed = False
        self._pause = 0  # frames until the GPU is tried again
        self._frame: tuple[GaussianModel, NodeDeformation, Observation, float] | None = None

    @property
    def loss(self) -> float:
        return self._working.loss

    def begin(
        self, model: GaussianModel, deformation: NodeDeformation, observation: Observation, node_step: float
    ) -> None:
        frame = self._frame = model, deformation, observation, node_step
        self._pause = max(0, self._pause - 1)
        returns = self._working is self._cpu and self._pause == 0 and not self._failed
        if returns:
            self._working = self._gpu
        self._do(lambda refiner: refiner.begin(*frame))
        if returns:  # what it drew last is of long ago
            self._do(lambda refiner: refiner.draw())

    def take(self, rows: slice) -> None:
        self._do(lambda refiner: refiner.take(rows))

    def download(self) -> None:
        self._do(lambda refiner: refiner.download())

    def draw(self) -> None:
        self._do(lambda refiner: refiner.draw())

    def planes(self) -> F32:
        return self._do(lambda refiner: refiner.planes())

    def exposure_gain(self) -> F32:
        return self._do(lambda refiner: refiner.exposure_gain())

    def refine(self, rates: LearningRates, share: float = 1.0) -> None:
        self._do(lambda refiner: refiner.refine(rates, share))

    def refine_worst(self, share: float, rates: LearningRates, nodes: bool = True) -> None:
        self._do(lambda refiner: refiner.refine_worst(share, rates, nodes))

    def touched(self) -> Bool:
        return self._do(lambda refiner: refiner.touched())

    def redraw(self, share: float, tiles: Bool) -> None:
        self._do(lambda refiner: refiner.redraw(share, tiles))

    def show(self, gaussians: Gaussians, camera: Camera) -> F32:
        return self._do(lambda refiner: refiner.show(gaussians, camera))

    def _do(self, work: Callable[[Refiner], Result]) -> Result:
        if self._working is self._gpu:
            try:
                return work(self._gpu)
            except SHORTAGES as error:
                self._lower_share(error)
            except FAILURES as error:
                self._give_up(error)
            self._working = self._cpu
            if self._frame is not None:
                self._cpu.begin(*self._frame)
                self._cpu.draw()
        return work(self._cpu)

    def _lower_share(self, error: BaseException) -> None:
        release_memory()
        used = 1.0 if self._frame is None else self._frame[0].count / self._frame[0].capacity
        self.share = LOWERED * min(self.share, used)
        self._pause = PAUSE
        self.problem = Finding(
            "gpu_memory",
            f"the GPU's memory was too small; the model may hold {self.share:.0%} of its Gaussians now; "
            "end what else uses the GPU, or lower mapping.max_gaussians",
        )
        log.info("%s", self.problem.text, exc_info=error)

    def _give_up(self, error: BaseException) -> None:
        self._failed = True
        self.share = self._cpu_share
        said = (str(error).strip() or type(error).__name__).splitlines()[0]
        self.problem = Finding(
            "gpu_failed", f"the GPU failed and the CPU goes on: {said}; restart the node to use the GPU again"
        )
        log.info("%s", self.problem.text, exc_info=error)
