"""A GPU that may fail, and the CPU that goes on in its place."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from sags_node.engine.cuda.failures import FAILURES, SHORTAGES, release_memory
from sags_node.errors import SagsError
from sags_node.fitting.clip import ClipFrame
from sags_node.fitting.density import Density
from sags_node.fitting.learner import DeviceKind, Learner
from sags_node.fitting.paths import Paths
from sags_node.model.deformable import DeformableModel
from sags_node.model.field import Field, FieldRates
from sags_node.types import F32, I64

log = logging.getLogger(__name__)

Result = TypeVar("Result")


class FallbackLearner:
    """Learns on the GPU. Where its memory is too small the CPU takes over for good, from the step that needed
    too much on: what was learnt until then stands on the GPU and can be fetched. After any other failure it
    cannot, as CUDA's errors last as long as the process; that ends the fit."""

    def __init__(self, gpu: Learner, cpu: Learner) -> None:
        self.problem: str | None = None
        self._working, self._cpu = gpu, cpu

    @property
    def device(self) -> DeviceKind:
        return self._working.device

    @property
    def residual(self) -> float:
        return self._do(lambda learner: learner.residual)

    def begin(self, model: DeformableModel, density: Density) -> None:
        self._cpu.begin(model, density)
        self._do(lambda learner: learner.begin(model, density))

    def descend(
        self, frame: ClipFrame, rates: F32, field_rates: FieldRates, exposure_rate: float, deformed: bool
    ) -> None:
        self._do(lambda learner: learner.descend(frame, rates, field_rates, exposure_rate, deformed))

    def refine(self, frame: ClipFrame, rates: F32, relaxation: float, field_rates: FieldRates) -> None:
        self._do(lambda learner: learner.refine(frame, rates, relaxation, field_rates))

    def begin_paths(self, field: Field, rows: F32, paths: Paths) -> None:
        self._cpu.begin_paths(field, rows, paths)
        self._do(lambda learner: learner.begin_paths(field, rows, paths))

    def learn_paths(self, slot: int, picked: I64, rates: FieldRates) -> None:
        self._do(lambda learner: learner.learn_paths(slot, picked, rates))

    def download(self) -> None:
        self._do(lambda learner: learner.download())

    def _do(self, work: Callable[[Learner], Result]) -> Result:
        if self._working is not self._cpu:
            try:
                return self._try(work)
            except FAILURES as error:
                said = (str(error).strip() or type(error).__name__).splitlines()[0]
                raise SagsError(
                    f"the GPU failed: {said}; go on from the last checkpoint with --resume, without the GPU "
                    "with device:=cpu"
                ) from error
        return work(self._cpu)

    def _try(self, work: Callable[[Learner], Result]) -> Result:
        try:
            return work(self._working)
        except SHORTAGES as error:
            self.problem = (
                "the GPU's memory was too small and the CPU goes on; end what else uses the GPU, or set a "
                "smaller --max-gaussians"
            )
            log.warning("%s", self.problem)
            log.info("the GPU's memory", exc_info=error)
        self._working.download()
        self._working = self._cpu
        release_memory()
        return work(self._cpu)
