"""The refiner on a GPU: gsplat draws, torch does the rest, and the CPU goes on where the GPU fails.

The model is sent once per frame and fetched once. Motion, removal and insertion stay on the CPU.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar

import torch

from sags_node.engine import gsplat_backend
from sags_node.engine.gsplat_backend import Drawing, pixels_of, sent
from sags_node.engine.losses.pieces import LEVEL
from sags_node.engine.losses.tissue import COVERAGE_WEIGHT, COVERED, DEPTH_COVERED, FULL, MAX_RESIDUAL
from sags_node.engine.rasterizer.rasterize import TILE_HEIGHT, TILE_WIDTH, as_pinhole
from sags_node.mapping.exposure import exposure_gain
from sags_node.mapping.focus import EVERY, tile_grid
from sags_node.mapping.gpu_map import GpuMap
from sags_node.mapping.optimiser import LearningRates
from sags_node.mapping.refiner import DEPTH_SCALE, DEPTH_WEIGHT, CpuRefiner
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, U8, Bool, Camera, Finding, Gaussians, Observation

if TYPE_CHECKING:
    from torch import Tensor

log = logging.getLogger(__name__)

Given = ParamSpec("Given")
Result = TypeVar("Result")


def _or_on_the_cpu(
    method: Callable[Concatenate[GpuRefiner, Given], Result],
) -> Callable[Concatenate[GpuRefiner, Given], Result]:
    """Where the GPU fails, and ever after, the CPU's method of that name does it."""

    @functools.wraps(method)
    def guarded(self: GpuRefiner, /, *args: Given.args, **names: Given.kwargs) -> Result:
        if self.problem is None:
            try:
                return method(self, *args, **names)
            except RuntimeError as error:  # torch raises the driver's errors so, and those of memory
                self._give_up(error)
        result: Result = getattr(self._cpu, method.__name__)(*args, **names)
        return result

    return guarded


class GpuRefiner:
    """`refiner.Refiner` on the current GPU.

    A frame in which the GPU fails is finished on the CPU, which goes on for good: a CUDA error cannot be
    recovered from in the same process. The model still stands there as it was before the frame's steps, so
    nothing but these is lost.

    Attributes:
        on_gpu: the model as it stands there.
    """

    def __init__(self, cpu: CpuRefiner, cpu_share: float) -> None:
        """
        Args:
            cpu: goes on where the GPU fails.
            cpu_share: how much of the model's capacity it can refine, 0..1.

        Raises:
            UsageError: no GPU can be used.
        """
        self.share = 1.0
        self.problem: Finding | None = None
        self._cpu, self._cpu_share = cpu, cpu_share
        self._device = gsplat_backend.gpu()
        self.on_gpu = GpuMap(self._device)
        self._loss = 0.0
        self._frame: tuple[GaussianModel, NodeDeformation, Observation, float] | None = None

    @property
    def loss(self) -> float:
        return self._loss if self.problem is None else self._cpu.loss

    @_or_on_the_cpu
    def begin(
        self, model: GaussianModel, deformation: NodeDeformation, observation: Observation, node_step: float
    ) -> None:
        self._frame = model, deformation, observation, node_step
        self._image = self._sent(observation.image).permute(2, 0, 1) * float(LEVEL)
        self._tissue, self._depth = self._sent(observation.tissue), self._sent(observation.depth)
        self._pinhole = as_pinhole(observation.camera)
        self._touched = self._sent(tile_grid(observation.tissue))
        self._changed = False
        self.on_gpu.begin(model, deformation)

    @_or_on_the_cpu
    def take(self, rows: slice) -> None:
        assert self._frame is not None
        model, deformation, *_ = self._frame
        self.on_gpu.take(model, deformation, rows)

    @_or_on_the_cpu
    def download(self) -> None:
        if not self._changed:
            return
        assert self._frame is not None
        model, deformation, *_ = self._frame
        loss = float(self._last_loss)
        self.on_gpu.download(model, deformation)
        self._loss, self._changed = loss, False

    @_or_on_the_cpu
    def draw(self) -> None:
        self._draw()

    @_or_on_the_cpu
    def redraw(self, share: float, tiles: Bool) -> None:
        with torch.no_grad():
            self._draw()  # all of it: gsplat cannot draw a part

    @_or_on_the_cpu
    def planes(self) -> F32:
        return self._fetched_planes()

    @_or_on_the_cpu
    def exposure_gain(self) -> F32:
        assert self._frame is not None
        observation = self._frame[2]
        return exposure_gain(self._fetched_planes(), observation.image, observation.tissue)

    @_or_on_the_cpu
    def refine(self, rates: LearningRates) -> None:
        self.on_gpu.rows["contribution"] = self._step(rates, None)

    @_or_on_the_cpu
    def refine_worst(self, share: float, rates: LearningRates, nodes: bool = True) -> None:
        tiles = self._worst(share)
        self._draw()
        self._step(rates, tiles, nodes)
        self._touched |= tiles

    @_or_on_the_cpu
    def touched(self) -> Bool:
        touched: Bool = self._touched.cpu().numpy()
        return touched

    @_or_on_the_cpu
    def show(self, gaussians: Gaussians, camera: Camera) -> F32:
        with torch.no_grad():
            drawing = Drawing(sent(gaussians, self._device), as_pinhole(camera))
        planes: F32 = drawing.planes.cpu().numpy()
        return planes

    def _give_up(self, error: RuntimeError) -> None:
        said = (str(error).strip() or type(error).__name__).splitlines()[0]
        full = isinstance(error, torch.OutOfMemoryError)
        remedy = "end what else uses the GPU, or lower mapping.max_gaussians, and " if full else ""
        self.problem = Finding(
            "gpu_memory" if full else "gpu_failed",
            f"the GPU failed and the CPU goes on: {said}; {remedy}restart the node to use the GPU again",
        )
        log.info("%s", self.problem.text, exc_info=error)
        self.share = self._cpu_share
        if self._frame is not None:
            self._cpu.begin(*self._frame)
            self._cpu.draw()

    def _draw(self) -> None:
        self._drawing = Drawing(self.on_gpu.drawn(), self._pinhole)
        self._fetched: F32 | None = None

    def _fetched_planes(self) -> F32:
        if self._fetched is None:
            self._fetched = self._drawing.planes.cpu().numpy()
        return self._fetched

    def _step(self, rates: LearningRates, tiles: Tensor | None, nodes: bool = True) -> Tensor:
        """A step on what was drawn last, or on some tiles [rows, columns] of it: `CpuRefiner._step`.

        Returns:
            [N] px, what each Gaussian contributes.
        """
        assert self._frame is not None
        self._last_loss, v_planes, weight = tissue_loss(
            self._drawing.planes, self._image, self._tissue, self._depth, DEPTH_WEIGHT, DEPTH_SCALE
        )
        if tiles is not None:
            pixels = pixels_of(tiles, self._tissue.shape)
            v_planes, weight = torch.where(pixels, v_planes, 0.0), torch.where(pixels, weight, 0.0)
        gradients = self._drawing.backward(v_planes, weight)
        contribution = gradients["contribution"]
        if nodes:  # they move all that follows them, also far from the tiles that count
            self.on_gpu.descend(gradients["means"], contribution, self._frame[3])
        self.on_gpu.optimise(gradients, rates, self._frame[2].camera)
        self._changed = True
        return contribution

    def _worst(self, share: float) -> Tensor:
        return worst_tiles(self._drawing.planes, self._image, self._tissue, share)

    def _sent(self, array: F32 | U8 | Bool) -> Tensor:
        """A copy on the device."""
        return torch.tensor(array, device=self._device)


def tissue_loss(
    planes: Tensor, image: Tensor, tissue: Tensor, depth: Tensor, depth_weight: float, depth_scale: float
) -> tuple[Tensor, Tensor, Tensor]:
    """`engine.losses.tissue.tissue_loss`; nothing is fetched.

    Args:
        planes: [5, H, W] as drawn.
        image: [3, H, W] RGB 0..1.
        tissue: [H, W] bool.
        depth: [H, W] m, 0 unknown.
        depth_weight, depth_scale: as there.

    Returns:
        The mean absolute colour residual, the gradient [5, H, W] by the planes, and 1 / coverage [H, W] where
        the colour counts, else 0.
    """
    coverage = planes[4]
    inverse = 1 / coverage  # selects below keep infinity and NaN out
    color, drawn_depth = planes[:3] * inverse, planes[3] * inverse
    residual, off = color - image, (drawn_depth - depth) / depth_scale
    size = residual.abs().sum(0)
    covered = (coverage > float(COVERED)) & (coverage < torch.inf)
    used = tissue & covered & (size < float(MAX_RESIDUAL))
    measured = used & (coverage > float(DEPTH_COVERED)) & (depth > 0) & (off.abs() < torch.inf)
    v_color = torch.where(used, inverse * residual, 0.0)
    v_depth = torch.where(measured, inverse * off.clamp(-1, 1) * (depth_weight / depth_scale), 0.0)
    by_color = torch.where(used, (v_color * color).sum(0), 0.0)
    by_depth = torch.where(measured, v_depth * drawn_depth, 0.0)
    push = torch.where(tissue & (coverage.abs() < float(FULL)), COVERAGE_WEIGHT, 0.0)
    mean = torch.where(used, size, 0.0).sum() / (3 * used.sum()).clamp(min=1)
    v_planes = torch.cat([v_color, v_depth[None], (-by_color - by_depth - push)[None]])
    return mean, v_planes, torch.where(used, inverse, 0.0)


def worst_tiles(planes: Tensor, image: Tensor, tissue: Tensor, share: float) -> Tensor:
    """`focus.worst_tiles`, [rows, columns]; nothing is fetched. Arguments as of `tissue_loss`."""
    some = (..., slice(None, None, EVERY), slice(None, None, EVERY))
    planes, tissue = planes[some], tissue[some]
    residuals = planes[:3] / planes[4] - image[some]
    counted = tissue & (planes[4] > float(COVERED)) & (residuals.abs() < 1)
    squares = torch.where(counted, residuals.square(), 0.0).sum(0)
    sums = torch.nn.functional.avg_pool2d(
        squares[None], (TILE_HEIGHT // EVERY, TILE_WIDTH // EVERY), ceil_mode=True, divisor_override=1
    )[0]
    worst = torch.topk(sums.flatten(), max(1, round(share * sums.numel())), sorted=False).indices
    chosen = torch.zeros_like(sums, dtype=torch.bool)
    chosen.view(-1)[worst] = True
    return chosen
