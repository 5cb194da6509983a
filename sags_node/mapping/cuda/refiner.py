"""The refiner on a GPU. The model comes up once per frame and goes back once; no step copies anything but
the number of pairs that a drawing sorts, and no step waits for another's result.

Motion, removal and insertion stay on the CPU: they happen once per frame, on rows that are there anyway.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from sags_node.engine.cuda.backend import default_device
from sags_node.engine.cuda.losses import tissue_loss
from sags_node.engine.cuda.rasterizer import CudaRasterizer
from sags_node.engine.cuda.scene import DeviceGaussians, DeviceGradients
from sags_node.engine.losses.pieces import LEVEL
from sags_node.engine.losses.tissue import COVERED
from sags_node.engine.rasterizer.rasterize import TILE_HEIGHT, TILE_WIDTH, as_pinhole
from sags_node.mapping import exposure, focus, optimiser
from sags_node.mapping.cuda import exposure as device_exposure
from sags_node.mapping.cuda import focus as device_focus
from sags_node.mapping.cuda.optimiser import Constants, Model, Optimiser, Slopes
from sags_node.mapping.optimiser import LearningRates
from sags_node.mapping.refiner import DEPTH_SCALE, DEPTH_WEIGHT
from sags_node.model.cuda.nodes import Followers, Nodes, descend
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, U8, Bool, Camera, Finding, Gaussians, Observation

if TYPE_CHECKING:
    from torch import Tensor

# Rows of the model, 200 bytes a Gaussian. The first come back, 164 bytes.
REFINED = (
    "means", "quats", "log_scales", "opacity_logits", "scales", "opacities", "colors", "adam_m", "adam_v",
    "contribution",
)  # fmt: skip
GIVEN = ("smoothing", "node_index", "node_weight")
LEAST_SEEN = 1e-3  # px: a Gaussian that contributes less moves no node, see `NodeDeformation.descend`
EXPOSURE = device_exposure.ExposureRule(
    exposure.EVERY, exposure.COVERED, exposure.DARK, exposure.BRIGHT, exposure.LEAST_PIXELS, exposure.LARGEST
)
STEP = Constants(
    relaxation=optimiser.COLOUR_RELAXATION,
    damping=optimiser.COLOUR_DAMPING,
    beta1=optimiser.BETA1,
    beta2=optimiser.BETA2,
    least_contribution=optimiser.MIN_CONTRIBUTION,
    eps=optimiser.EPS,
    color_range=optimiser.COLOR_RANGE,
    log_scale_range=optimiser.LOG_SCALE_RANGE,
    logit_range=optimiser.LOGIT_RANGE,
    largest=optimiser.LARGEST,
    largest_raw=optimiser.LARGEST_RAW,
)


class CudaRefiner:
    """`refiner.Refiner` on the current GPU, or on the CPU under Triton's interpreter.

    What the nodes' optimiser remembers stays on the device.
    """

    share = 1.0
    problem: Finding | None = None

    def __init__(self) -> None:
        self.loss = 0.0
        self._device = default_device()
        self._rasterizers: dict[tuple[int, int], CudaRasterizer] = {}  # by the size of their pictures
        self._viewers: dict[tuple[int, int], CudaRasterizer] = {}  # those of `show`
        self._optimiser = Optimiser(STEP)
        self._planes = torch.zeros((5, 1, 1), device=self._device)
        self._v_planes, self._weight = torch.zeros_like(self._planes), torch.zeros_like(self._planes[0])
        self._last_loss = torch.zeros((), device=self._device)
        self._host: GaussianModel | None = None
        self._tables: dict[str, Tensor] = {}
        self._deformation: NodeDeformation | None = None
        self._nodes = Nodes.at(torch.zeros((0, 3), device=self._device))
        self._observation: Observation | None = None

    def begin(
        self, model: GaussianModel, deformation: NodeDeformation, observation: Observation, node_step: float
    ) -> None:
        if model is not self._host:
            self._host, self._tables = model, self._room_for(model)
        if deformation is not self._deformation:
            self._deformation, self._nodes = deformation, Nodes.at(self._sent(deformation.nodes))
        else:
            known = len(self._nodes.places)
            self._nodes.places.copy_(torch.from_numpy(deformation.nodes[:known]))
        self._rasterizer = self._rasterizer_for(observation.camera, self._rasterizers)
        if observation is not self._observation:
            self._look_at(observation)
        self._node_step = node_step
        self._touched = torch.zeros(
            focus.tile_grid(observation.tissue).shape, dtype=torch.bool, device=self._device
        )
        self._changed = False
        self.take(slice(0, model.count))

    def take(self, rows: slice) -> None:
        model, deformation = self._host, self._deformation
        assert model is not None and deformation is not None
        for name, table in self._tables.items():
            table[rows].copy_(torch.from_numpy(getattr(model, name)[rows]))
        new = deformation.nodes[len(self._nodes.places) :]
        if len(new):
            still = torch.zeros((len(new), 3), device=self._device)
            self._nodes = Nodes(
                torch.cat([self._nodes.places, self._sent(new)]),
                torch.cat([self._nodes.momentum, still]),
                torch.cat([self._nodes.variance, still]),
            )
        alive = {name: table[: model.count] for name, table in self._tables.items()}
        self._contribution = alive["contribution"]
        self._model = Model(**{name: alive[name] for name in REFINED if name != "contribution"})
        drawn = ("means", "quats", "scales", "opacities", "colors", "smoothing")
        self._gaussians = DeviceGaussians(**{name: alive[name] for name in drawn})
        self._followers = Followers.of(alive["node_index"], alive["node_weight"], len(self._nodes.places))

    def download(self) -> None:
        if not self._changed:
            return
        assert self._host is not None and self._deformation is not None
        self.loss = float(
            self._last_loss
        )  # waits: an error of the steps is raised before anything is written
        for name in REFINED:
            rows = getattr(self._host, name)
            torch.from_numpy(rows).copy_(self._tables[name][: len(rows)])
        nodes = self._deformation.nodes[: len(self._nodes.places)]
        torch.from_numpy(nodes).copy_(self._nodes.places)
        self._changed = False

    def draw(self) -> None:
        self._planes = self._rasterizer.draw(self._gaussians, self._pinhole)

    def planes(self) -> F32:
        planes: F32 = self._planes.cpu().numpy()
        return planes

    def exposure_gain(self) -> F32:
        gain = device_exposure.exposure_gain(self._planes, self._image, self._tissue, EXPOSURE)
        found: F32 = gain.cpu().numpy()
        return found

    def refine(self, rates: LearningRates, share: float = 1.0) -> None:
        if share >= 1.0:
            self._contribution.copy_(self._step(self._tissue, rates).contribution)
            return
        height, width = self._tissue.shape
        rows = self._worst_tiles(share).repeat_interleave(TILE_HEIGHT, 0)[:height]
        self._step(self._tissue & rows.repeat_interleave(TILE_WIDTH, 1)[:, :width], rates)

    def refine_worst(self, share: float, rates: LearningRates, nodes: bool = True) -> None:
        tiles = self._worst_tiles(share)
        self._planes = self._rasterizer.draw(self._gaussians, self._pinhole, tiles)
        self._step(self._tissue, rates, nodes)
        self._touched |= tiles

    def touched(self) -> Bool:
        found: Bool = self._touched.cpu().numpy()
        return found

    def redraw(self, share: float, tiles: Bool) -> None:
        some = None
        if share < 1.0:
            some = self._sent(tiles) | self._touched
            if share > 0:
                some |= self._worst_tiles(share)
        self._planes = self._rasterizer.draw(self._gaussians, self._pinhole, some)

    def show(self, gaussians: Gaussians, camera: Camera) -> F32:
        drawn = DeviceGaussians.from_host(gaussians, self._device)
        planes = self._rasterizer_for(camera, self._viewers).draw(drawn, as_pinhole(camera))
        found: F32 = planes.cpu().numpy()
        return found

    def _rasterizer_for(self, camera: Camera, made: dict[tuple[int, int], CudaRasterizer]) -> CudaRasterizer:
        size = camera.width, camera.height
        if size not in made:
            made[size] = CudaRasterizer(*size, True, self._device)
        return made[size]

    def _step(self, tissue: Tensor, rates: LearningRates, nodes: bool = True) -> DeviceGradients:
        planes = self._planes
        if self._v_planes.shape != planes.shape:
            self._v_planes, self._weight = torch.zeros_like(planes), torch.zeros_like(planes[0])
        v_planes, weight = self._v_planes, self._weight
        self._last_loss = tissue_loss(
            planes, self._image, tissue, self._depth, v_planes, weight, DEPTH_WEIGHT, DEPTH_SCALE
        )
        gradients = self._rasterizer.backward_pass(v_planes, weight)
        if nodes:  # they move all that follows them, also far from the tiles that were drawn
            descend(
                self._nodes, self._followers, gradients.means, gradients.contribution, self._model.means,
                step=self._node_step, least_contribution=LEAST_SEEN,
            )  # fmt: skip
        slopes = Slopes(
            gradients.means, gradients.quats, gradients.scales, gradients.opacities, gradients.colors,
            gradients.contribution,
        )  # fmt: skip
        lengths = rates.mean_px, rates.quat, rates.log_scale, rates.opacity_logit
        self._optimiser.step(self._model, slopes, lengths, self._view_z, self._focal_px)
        self._changed = True
        return gradients

    def _worst_tiles(self, share: float) -> Tensor:
        return device_focus.worst_tiles(
            self._planes, self._image, self._tissue, share,
            every=focus.EVERY, least_coverage=float(COVERED),
        )  # fmt: skip

    def _look_at(self, observation: Observation) -> None:
        """The frame's pictures, on the device, and its camera."""
        camera = observation.camera
        self._image = self._sent(observation.image).float() * float(LEVEL)
        self._tissue, self._depth = self._sent(observation.tissue), self._sent(observation.depth)
        self._pinhole, self._focal_px = as_pinhole(camera), float(camera.K[0, 0])
        x, y, z, shift = camera.viewmat[2].tolist()
        self._view_z = x, y, z, shift
        self._observation = observation  # now all of it is here

    def _room_for(self, model: GaussianModel) -> dict[str, Tensor]:
        """Tables [capacity, ...] for the rows that are used here."""
        room = {}
        for name in REFINED + GIVEN:
            rows = getattr(model, name)
            kind = torch.int32 if rows.dtype == np.int32 else torch.float32
            room[name] = torch.zeros((model.capacity, *rows.shape[1:]), dtype=kind, device=self._device)
        return room

    def _sent(self, array: F32 | U8 | Bool) -> Tensor:
        """A copy on the device."""
        return torch.tensor(array, device=self._device)
