"""What is done to the model many times per frame, behind one small interface, and its form for the CPU."""

from collections.abc import Callable
from functools import cache
from typing import Protocol

import numpy as np

from sags_node.engine.losses.tissue import tissue_loss
from sags_node.engine.rasterizer.rasterize import Gradients, Rasterizer
from sags_node.mapping.focus import largest, sum_residuals, tile_grid
from sags_node.mapping.optimiser import LearningRates, Optimiser
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, Bool, Camera, Finding, Gaussians, Observation

DEPTH_WEIGHT = 2e-3  # of a depth residual of DEPTH_SCALE, against colours 0..1
DEPTH_SCALE = 1e-3  # m: beyond this a depth residual counts linearly


class Refiner(Protocol):
    """Draws the model and moves it towards a frame.

    Between `begin` and `download` the refiner owns the rows that it was given: what it did to them, and to
    the nodes, is seen in the model only after `download`. Rows may be appended meanwhile (`take`).

    Attributes:
        loss: mean absolute colour residual before the last step, as of `download`.
        share: how much of the model's capacity it can refine, 0..1.
        problem: what is wrong with it and how to fix it; None: nothing. May be read from any thread.
    """

    loss: float = 0.0
    share: float = 1.0
    problem: Finding | None = None

    def begin(
        self, model: GaussianModel, deformation: NodeDeformation, observation: Observation, node_step: float
    ) -> None:
        """Take the model, all of it, and the frame that it is to show.

        Args:
            node_step: m, length of one step of the nodes.
        """

    def take(self, rows: slice) -> None:
        """Take these rows of the model, which the host has written, and nodes that were added."""

    def download(self) -> None:
        """Write what was refined into the model and the nodes."""

    def draw(self, tiles: Bool | None = None, share: float = 0.0) -> None:
        """Draw the model for the frame's camera.

        Args:
            tiles: [rows, columns] that are drawn; the others keep what was drawn before. None: all are drawn.
            share: of the image, where it was worst before the steps, that is drawn too; 1: all of it.
        """
        if tiles is not None and share > 0:
            tiles = None if share >= 1 else tiles | self._worst_tiles(share)
        self._forward(tiles)

    def planes(self) -> F32:
        """The planes [5, H, W] as they were drawn last; overwritten by the next drawing."""

    def refine(self, rates: LearningRates) -> None:
        """Take one step on what was drawn last: loss and its gradient, back-propagation, nodes, Gaussians.

        Stores each Gaussian's contribution in the model, too, so the whole image must have been drawn.
        """

    def refine_worst(self, share: float, rates: LearningRates, nodes: bool = True) -> Bool:
        """Draw that share of the image anew, where it is worst, and take one step on it.

        Args:
            nodes: move them too.

        Returns:
            The tiles [rows, columns] that were drawn.
        """
        tiles = self._worst_tiles(share)
        self._forward(tiles)
        self._step(rates, nodes)
        return tiles

    def show(self, gaussians: Gaussians, camera: Camera) -> F32:
        """Draw planes [5, H, W] of any Gaussians for any camera, in memory of their own, which the next
        `show` overwrites. As `Rasterizer.forward`."""

    def _forward(self, tiles: Bool | None) -> None:
        """Draw these tiles."""

    def _worst_tiles(self, share: float) -> Bool:
        """See `focus.largest`."""

    def _step(self, rates: LearningRates, nodes: bool = True) -> object:
        """Take a step on what was drawn last; `nodes`: move them, too."""


MakeRasterizer = Callable[[int, int], Rasterizer]


class CpuRefiner(Refiner):
    """The refiner that works on the model's own arrays."""

    def __init__(self, make_rasterizer: MakeRasterizer) -> None:
        """`make_rasterizer` makes a rasteriser for images of a width and height, px."""
        self._rasterizer_of, self._viewer_of = cache(make_rasterizer), cache(make_rasterizer)
        self._optimiser = Optimiser()
        # [5, H, W] and [H, W]; the planes are the rasteriser's memory: what it drew last
        self._planes: F32 = np.zeros((5, 1, 1), np.float32)
        self._v_planes, self._weight = np.zeros_like(self._planes), np.zeros_like(self._planes[0])

    def begin(
        self, model: GaussianModel, deformation: NodeDeformation, observation: Observation, node_step: float
    ) -> None:
        self._model, self._deformation, self._observation = model, deformation, observation
        self._node_step = node_step
        self._rasterizer = self._rasterizer_of(observation.camera.width, observation.camera.height)
        # [rows, columns] tiles drawn since `focus.sum_residuals` looked at them, and the sums that it found
        self._old: Bool = ~tile_grid(observation.tissue)
        self._sums: F32 = np.zeros(self._old.shape, np.float32)

    def take(self, rows: slice) -> None:
        pass

    def download(self) -> None:
        pass

    def planes(self) -> F32:
        return self._planes

    def refine(self, rates: LearningRates) -> None:
        self._model.contribution[:] = self._step(rates).contribution

    def show(self, gaussians: Gaussians, camera: Camera) -> F32:
        return self._viewer_of(camera.width, camera.height).forward(gaussians, camera)

    def _forward(self, tiles: Bool | None) -> None:
        self._planes = self._rasterizer.forward(self._model.gaussians(), self._observation.camera, tiles)
        self._old |= True if tiles is None else tiles

    def _worst_tiles(self, share: float) -> Bool:
        """As in `Refiner`; sums again only over tiles that were drawn since the last time."""
        if self._old.any():
            seen = self._observation
            sum_residuals(self._planes, seen.image, seen.tissue, self._old, self._sums)
            self._old[:] = False
        return largest(self._sums, share)

    def _step(self, rates: LearningRates, nodes: bool = True) -> Gradients:
        planes, observation = self._planes, self._observation
        if self._v_planes.shape != planes.shape:
            self._v_planes, self._weight = np.zeros_like(planes), np.zeros_like(planes[0])
        v_planes, weight = self._v_planes, self._weight
        self.loss = tissue_loss(
            planes, observation.image, observation.tissue, observation.depth, v_planes, weight,
            DEPTH_WEIGHT, DEPTH_SCALE,
        )  # fmt: skip
        gradients = self._rasterizer.backward(v_planes, weight)
        if nodes:  # they move all that follows them, also far from the tiles that were drawn
            self._deformation.descend(self._model, gradients.means, gradients.contribution, self._node_step)
        self._optimiser.step(self._model, gradients, observation.camera, rates)
        return gradients
