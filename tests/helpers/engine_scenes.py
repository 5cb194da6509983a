"""Small scenes for the engine's tests."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from rounding import U, after, moved, roughly

from benchmarks.kernels.reference import ReferenceRasterizer
from sags_node.engine.interface import MAX_OPACITY
from sags_node.engine.rasterizer.rasterize import Gradients, Rasterizer, make_rasterizer, to_view
from sags_node.mapping.focus import largest, sum_residuals, tile_grid
from sags_node.types import F32, F64, U8, Bool, Camera, Gaussians, RenderedView

T = TypeVar("T")
INPUTS = ("means", "quats", "scales", "opacities", "colors", "slopes")
DERIVATIVES = tuple(field.name for field in dataclasses.fields(Gradients))


def as_bytes(picture: Any) -> U8:
    """An image 0..1, as a camera gives it."""
    return np.ascontiguousarray(np.rint(255 * np.clip(picture, 0, 1)), np.uint8)


def camera(width: int = 48, height: int = 40, focal: float = 60.0, moved: bool = False) -> Camera:
    """Looks along z from the origin, or from a turned and shifted place; off-centre principal point."""
    K = np.array([[focal, 0, width / 2 - 1.3], [0, focal * 1.03, height / 2 + 0.7], [0, 0, 1]])
    T = np.eye(4)
    if moved:
        a, b = 0.15, -0.1
        turn = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
        tilt = np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
        T[:3, :3] = turn @ tilt
        T[:3, 3] = [-0.004, 0.002, 0.003]
    return Camera(width, height, K, T)


def random_gaussians(seed: int, count: int, view: Camera, spread: float = 1.0) -> Gaussians:
    """Gaussians of all shapes and turns in front of `view`, 5 to 9 cm away, some beyond its border."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.05, 0.09, count)
    pixels = rng.uniform([-4, -4], [view.width + 4, view.height + 4], (count, 2))
    local = np.stack(
        [
            (pixels[:, 0] - view.K[0, 2]) / view.K[0, 0] * depth,
            (pixels[:, 1] - view.K[1, 2]) / view.K[1, 1] * depth,
            depth,
        ],
        1,
    )
    means = local @ view.T_world_cam[:3, :3].T + view.T_world_cam[:3, 3]
    spacing = 0.07 / view.K[0, 0] * math.sqrt(view.width * view.height / max(count, 1))
    return Gaussians(
        means=means.astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        scales=(spread * spacing * rng.uniform(0.3, 1.2, (count, 3))).astype(np.float32),
        opacities=rng.uniform(0.3, 0.97, count).astype(np.float32),
        colors=rng.uniform(0, 1, (count, 3)).astype(np.float32),
        ids=np.arange(count),
        slopes=rng.normal(0, 0.2, (count, 3)).astype(np.float32),
    )


def one_gaussian(mean: NDArray[np.floating], scale: float, opacity: float = 0.9) -> Gaussians:
    colour = np.array([0.8, 0.5, 0.2], np.float32)
    one = round_gaussians(np.asarray(mean, np.float32).reshape(1, 3), scale, colour, opacity)
    return dataclasses.replace(one, slopes=np.zeros((1, 3), np.float32))


def round_gaussians(means: F32, scale: float, colours: F32 | float = 0.5, opacity: float = 0.9) -> Gaussians:
    """Of one size, at `means` [N, 3]."""
    count = len(means)
    return Gaussians(
        means=means,
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), scale, np.float32),
        opacities=np.full(count, opacity, np.float32),
        colors=np.broadcast_to(np.asarray(colours, np.float32), (count, 3)).copy(),
        ids=np.arange(count),
    )


def with_view_dependence(gaussians: Gaussians, degree: int, seed: int = 0) -> Gaussians:
    """The same with spherical harmonics, strong enough to leave the range of colours."""
    shape = (len(gaussians), (degree + 1) ** 2 - 1, 3)
    sh_rest = np.random.default_rng(seed).normal(0, 0.4, shape).astype(np.float32)
    return dataclasses.replace(gaussians, sh_rest=sh_rest)


def with_filter(gaussians: Gaussians, seed: int = 0) -> Gaussians:
    """The same with a 3D filter of up to the Gaussians' own size; the first has none."""
    widths = gaussians.scales.mean(1) * np.random.default_rng(seed).uniform(0, 1, len(gaussians))
    widths[:1] = 0
    return dataclasses.replace(gaussians, smoothing=(widths**2).astype(np.float32))


def rows(gaussians: Gaussians, keep: NDArray[np.bool_] | NDArray[np.integer] | slice) -> Gaussians:
    """Some of the Gaussians, with everything that belongs to them."""
    values = {field.name: getattr(gaussians, field.name) for field in dataclasses.fields(Gaussians)}
    return Gaussians(**{name: None if value is None else value[keep] for name, value in values.items()})


def cotangents(view: Camera, seed: int) -> tuple[F32, F32]:
    """Random v_planes [5, H, W] and weight [H, W]."""
    rng = np.random.default_rng(seed)
    size = view.height, view.width
    v_planes = rng.normal(size=(5, *size)).astype(np.float32)
    return v_planes, rng.uniform(0, 2, size).astype(np.float32)


def draw_and_differentiate(
    gaussians: Gaussians, view: Camera, backend: str = "numba", seed: int = 0, antialias: bool = True
) -> tuple[F32, dict[str, NDArray[np.floating]]]:
    """Planes, and gradients for a random cotangent, as copies."""
    rasterizer = make_rasterizer(backend, view.width, view.height, antialias)
    return _drawn(rasterizer, gaussians, view, cotangents(view, seed))


def _drawn(
    rasterizer: Rasterizer, gaussians: Gaussians, view: Camera, given: tuple[F32, F32]
) -> tuple[F32, dict[str, NDArray[np.floating]]]:
    planes = rasterizer.forward(gaussians, view).copy()
    gradients = rasterizer.backward(*given)
    return planes, {name: getattr(gradients, name).copy() for name in DERIVATIVES}


@dataclasses.dataclass(frozen=True)
class Truth:
    """What the float64 twin draws, and how near to it float32 must come."""

    planes: F32  # [5, H, W]
    gradients: dict[str, NDArray[np.floating]]
    off: F64  # [5, H, W] how far values moved that were computed from inputs a little off
    gradients_within: dict[str, float]  # of the norm of all values

    def check(self, planes: F32, gradients: dict[str, NDArray[np.floating]]) -> None:
        np.testing.assert_allclose(planes, self.planes, rtol=0, atol=self.off.max(initial=0))
        for name in DERIVATIVES:
            self.check_gradient(name, gradients[name])

    def check_gradient(self, name: str, found: NDArray[np.floating]) -> None:
        assert found.shape == self.gradients[name].shape
        error = np.linalg.norm(found - self.gradients[name])
        assert error <= self.gradients_within[name], name


EXPONENTIAL = 2.7e-6  # relative error of `compositing`'s 2^x
SUMMED = 60  # additions one after the other: the pixels of a tile's column, its columns, and tiles


def truth(
    gaussians: Gaussians,
    view: Camera,
    seed: int = 0,
    antialias: bool = True,
    given: tuple[F32, F32] | None = None,
) -> Truth:
    """Of a scene and `given` v_planes and weights; None: the random ones of `draw_and_differentiate`.

    As `rounding` says: the twin draws three times more from inputs that are a little off, with an exponential
    that is off by `EXPONENTIAL`.
    """
    rasterizer = ReferenceRasterizer(antialias)
    given = given or cotangents(view, seed)
    planes, gradients = _drawn(rasterizer, gaussians, view, given)
    off = np.zeros(planes.shape)
    within = dict.fromkeys(gradients, 0.0)
    for move in range(3):
        rng = np.random.default_rng([seed, move])
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch, "exp", roughly(torch.exp, rng, EXPONENTIAL))
            names = (*INPUTS, "sh_rest", "smoothing")
            others = dataclasses.replace(
                gaussians, **{name: moved(getattr(gaussians, name), rng) for name in names}
            )
            aside = Camera(view.width, view.height, moved(view.K, rng), moved(view.T_world_cam, rng))
            v_planes, weight = (moved(array, rng) for array in given)
            near, near_gradients = _drawn(rasterizer, others, aside, (v_planes, weight))
        off = np.maximum(off, np.abs(near - planes))
        for name, values in gradients.items():
            within[name] = max(within[name], float(np.linalg.norm(near_gradients[name] - values)))
    for name, values in gradients.items():
        within[name] += (EXPONENTIAL + after(SUMMED)) * float(np.linalg.norm(values))
    if len(gaussians):
        # what is behind a splat comes by subtraction from all that a pixel shows, and is divided by 1 - alpha
        shown = np.linalg.norm((given[0] * planes).sum(0))
        within["opacities"] += U * float(shown) / (1 - min(gaussians.opacities.max(), MAX_OPACITY))
    return Truth(planes, gradients, off + EXPONENTIAL * np.abs(planes).max(initial=0), within)


def relative_error(found: NDArray[np.floating], true: NDArray[np.floating]) -> float:
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


def on_one_thread(run: Callable[[], T]) -> T:
    cores = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        return run()
    finally:
        numba.set_num_threads(cores)


def rasterize(gaussians: Gaussians, view: Camera, backend: str = "numba") -> RenderedView:
    """Drawn by a rasteriser of its own."""
    rasterizer = make_rasterizer(backend, view.width, view.height)
    return to_view(rasterizer.forward(gaussians, view), view, 0, 0)


def worst_tiles(planes: F32, image: U8, tissue: Bool, share: float) -> Bool:
    """The tiles of `focus.largest`, of all residuals."""
    residuals = np.zeros(tile_grid(tissue).shape, np.float32)
    sum_residuals(planes, image, tissue, ~tile_grid(tissue), residuals)
    return largest(residuals, share)
