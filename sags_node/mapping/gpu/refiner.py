"""The refiner on a GPU; the CPU goes on where the GPU fails.

The model's rows go up once per frame and come down once. Motion, removal and insertion stay on the CPU.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
import warp as wp

from sags_node.engine import device
from sags_node.engine.gpu.rasterizer import DeviceRasterizer, sent
from sags_node.engine.rasterizer.arguments import view_of
from sags_node.errors import first_line
from sags_node.mapping.focus import largest, tile_grid
from sags_node.mapping.gpu import kernels
from sags_node.mapping.gpu.device_map import DeviceMap
from sags_node.mapping.optimiser import LearningRates
from sags_node.mapping.refiner import DEPTH_SCALE, DEPTH_WEIGHT, CpuRefiner, Refiner
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, U8, Bool, Camera, Finding, Gaussians, Observation

log = logging.getLogger(__name__)

Given = ParamSpec("Given")
Result = TypeVar("Result")


def _or_on_the_cpu(
    method: Callable[Concatenate[GpuRefiner, Given], Result],
) -> Callable[Concatenate[GpuRefiner, Given], Result]:
    """Wrap a method so that the CPU's method of that name runs instead once the GPU has failed."""

    @functools.wraps(method)
    def guarded(self: GpuRefiner, /, *args: Given.args, **names: Given.kwargs) -> Result:
        if self.problem is None:
            try:
                return method(self, *args, **names)
            except Exception as error:
                if not device.is_of_warp(error):
                    raise
                self._give_up(error)
        result: Result = getattr(self._cpu, method.__name__)(*args, **names)
        self.loss = self._cpu.loss
        return result

    return guarded


class GpuRefiner(Refiner):
    """The refiner on the current GPU.

    A frame in which the GPU fails is finished on the CPU, which goes on for good: a CUDA error cannot be
    recovered from in the same process. The host still has the model as it was before the frame's steps, so
    only these and Adam's state are lost.

    Attributes:
        on_gpu: the copy of the model on the GPU.
    """

    def __init__(self, cpu: CpuRefiner, cpu_share: float) -> None:
        """
        Args:
            cpu: goes on where the GPU fails.
            cpu_share: how much of the model's capacity the CPU can refine, 0..1.

        Raises:
            UsageError: no GPU can be used.
        """
        self._cpu, self._cpu_share = cpu, cpu_share
        self._device = device.gpu()
        self.on_gpu = DeviceMap(self._device)
        self._frame: tuple[GaussianModel, NodeDeformation, Observation, float] | None = None
        make = functools.partial(Picture, device=self._device)
        self._picture_of, self._viewer_of = functools.cache(make), functools.cache(make)

    @_or_on_the_cpu
    def begin(
        self, model: GaussianModel, deformation: NodeDeformation, observation: Observation, node_step: float
    ) -> None:
        self._frame = model, deformation, observation, node_step
        self._picture = self._picture_of(observation.camera.width, observation.camera.height)
        self._picture.show(observation.image, observation.tissue, observation.depth)
        self._view = view_of(observation.camera)
        self._changed = False
        self.on_gpu.begin(model, deformation)

    @_or_on_the_cpu
    def take(self, rows: slice) -> None:
        self.on_gpu.take(rows)

    @_or_on_the_cpu
    def download(self) -> None:
        if self._changed:
            loss = self._picture.loss()
            self.on_gpu.download()
            self.loss, self._changed = loss, False

    draw = _or_on_the_cpu(Refiner.draw)
    refine_worst = _or_on_the_cpu(Refiner.refine_worst)

    @_or_on_the_cpu
    def planes(self) -> F32:
        return self._picture.fetched()

    @_or_on_the_cpu
    def refine(self, rates: LearningRates) -> None:
        self.on_gpu.note_contribution(self._step(rates))

    @_or_on_the_cpu
    def show(self, gaussians: Gaussians, camera: Camera) -> F32:
        picture = self._viewer_of(camera.width, camera.height)
        picture.rasterizer.forward(sent(gaussians, self._device), view_of(camera))
        return picture.fetched(anew=True)

    def _give_up(self, error: Exception) -> None:
        said = first_line(error)
        full = "allocate" in said  # Warp has no error of its own for it
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

    def _forward(self, tiles: Bool | None) -> None:
        self._picture.rasterizer.forward(self.on_gpu.drawn(), self._view, tiles)
        self._picture.is_fetched = False

    def _step(self, rates: LearningRates, nodes: bool = True) -> wp.array:
        """Take a step on what was drawn last, as `CpuRefiner._step`.

        Returns:
            [N] px, what each Gaussian contributes.
        """
        assert self._frame is not None
        gradients = self._picture.rasterizer.backward(*self._picture.compare())
        if nodes:  # they move all that follows them, also far from the tiles that were drawn
            self.on_gpu.descend(gradients, self._frame[3])
        self.on_gpu.optimise(gradients, rates, self._frame[2].camera)
        self._changed = True
        return gradients["contribution"]

    def _worst_tiles(self, share: float) -> Bool:
        return largest(self._picture.residuals(), share)


class Picture:
    """Draws images of one size on the GPU, and compares them with a frame.

    Attributes:
        rasterizer: draws them.
        is_fetched: what was drawn last is on the host.
    """

    def __init__(self, width: int, height: int, device: wp.Device) -> None:
        self._device = device
        self.rasterizer = DeviceRasterizer(width, height, device)
        self.is_fetched = False
        self._planes = wp.zeros((5, height, width), dtype=float, device="cpu", pinned=device.is_cuda)
        self._v_planes = wp.zeros((5, height, width), dtype=float, device=device)
        self._weight = wp.zeros((height, width), dtype=float, device=device)
        self._sums = wp.zeros(1, dtype=wp.vec2, device=device)
        shape = tile_grid(np.empty((height, width), np.bool_)).shape
        self._residuals = wp.zeros(shape, dtype=float, device=device)

    def show(self, image: U8, tissue: Bool, depth: F32) -> None:
        """Set the frame to compare with: RGB [H, W, 3], where it counts [H, W], and depth [H, W] m."""
        self._seen = [
            wp.array(image, dtype=wp.uint8, device=self._device),
            wp.array(tissue, dtype=wp.bool, device=self._device),
        ]
        self._depth = wp.array(depth, dtype=float, device=self._device)

    def fetched(self, anew: bool = False) -> F32:
        """The planes [5, H, W] as they were drawn last, on the host; the next `fetched` overwrites them."""
        if anew or not self.is_fetched:
            wp.copy(self._planes, self.rasterizer.planes)
            wp.synchronize_device(self._device)
            self.is_fetched = True
        planes: F32 = self._planes.numpy()
        return planes

    def compare(self) -> tuple[wp.array, wp.array]:
        """Compute `engine.losses.tissue.tissue_loss` of what was drawn last; returns the gradient by its
        planes [5, H, W] and the pixels' weight [H, W]."""
        self._sums.zero_()
        blocks = -(-self._weight.size // kernels.PIXELS)
        self._launch(kernels.tissue_loss, blocks * kernels.PIXELS, [
            self.rasterizer.planes, *self._seen, self._depth, DEPTH_WEIGHT, DEPTH_SCALE,
            self._v_planes, self._weight, self._sums,
        ])  # fmt: skip
        return self._v_planes, self._weight

    def loss(self) -> float:
        """The mean absolute colour residual of the last `compare`."""
        residuals, pixels = self._sums.numpy()[0].tolist()
        return residuals / (3.0 * pixels) if pixels > 0 else 0.0

    def residuals(self) -> F32:
        """Compute `focus.sum_residuals` of all tiles, on the host."""
        found = self._residuals
        self._launch(kernels.sum_residuals, found.shape, [self.rasterizer.planes, *self._seen, found])
        sums: F32 = found.numpy()
        return sums

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim, inputs=inputs, device=self._device, block_dim=kernels.PIXELS)
