"""The tissue loss, on the CPU and by the kernel for a GPU, against autograd of what it states."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from engine_scenes import on_one_thread
from rounding import after, moved

from sags_node.engine.losses.pieces import PIECE
from sags_node.engine.losses.tissue import tissue_loss
from sags_node.mapping.refiner import DEPTH_SCALE, DEPTH_WEIGHT
from sags_node.types import F32, F64

HEIGHT, WIDTH = 23, 31


def frame(seed: int = 0) -> dict[str, Any]:
    """Planes of every coverage, and a frame to compare them with."""
    rng = np.random.default_rng(seed)
    coverage = rng.uniform(0, 1, (HEIGHT, WIDTH))
    depth = rng.uniform(0.05, 0.06, (HEIGHT, WIDTH))
    drawn_depth = depth + rng.normal(0, 1e-3, depth.shape)  # on both branches of the Huber function
    planes = np.concatenate(
        [rng.uniform(0, 1, (3, HEIGHT, WIDTH)), drawn_depth[None], np.ones((1, HEIGHT, WIDTH))]
    )
    depth[rng.uniform(size=depth.shape) < 0.3] = 0
    return {
        "planes": (planes * coverage).astype(np.float32),
        "image": rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8),
        "tissue": rng.uniform(size=(HEIGHT, WIDTH)) < 0.8,
        "depth": depth.astype(np.float32),
    }


Run = Callable[[dict[str, Any]], tuple[float, F32, F32]]


def on_cpu(inputs: dict[str, Any]) -> tuple[float, F32, F32]:
    """Mean residual, gradient by the planes, and weight."""
    height, width = inputs["tissue"].shape
    v_planes = np.full((5, height, width), np.nan, np.float32)  # every value must be written
    weight = np.full((height, width), np.nan, np.float32)
    mean = tissue_loss(
        **inputs, v_planes=v_planes, weight=weight, depth_weight=DEPTH_WEIGHT, depth_scale=DEPTH_SCALE
    )
    return mean, v_planes, weight


def in_warp(inputs: dict[str, Any]) -> tuple[float, F32, F32]:
    from sags_node.engine.gpu import runtime
    from sags_node.mapping.gpu.refiner import Picture

    height, width = inputs["tissue"].shape
    picture = Picture(width, height, runtime.device_named("cpu"))
    picture.rasterizer.planes.assign(inputs["planes"])
    picture.show(inputs["image"], inputs["tissue"], inputs["depth"])
    v_planes, weight = (each.numpy() for each in picture.compare())
    return picture.loss(), v_planes, weight


@pytest.fixture(params=[on_cpu, in_warp])
def run(request: pytest.FixtureRequest) -> Run:
    found: Run = request.param
    return found


def twin(planes: Any, image: Any, tissue: Any, depth: Any) -> F64:
    """The gradient [5, H, W] of the stated loss by the planes."""
    import torch

    from benchmarks.kernels import reference

    drawn = torch.tensor(planes, dtype=torch.float64, requires_grad=True)
    seen = (torch.tensor(array) for array in (image / 255, tissue, depth))
    loss = reference.tissue_loss(drawn, *seen, DEPTH_WEIGHT, DEPTH_SCALE)
    return np.asarray(torch.autograd.grad(loss, drawn)[0].numpy())


def test_mean_residual_and_weight(run: Run) -> None:
    """Of tissue that something covers; without any there is no loss and no gradient."""
    inputs = frame()
    mean, _, weight = run(inputs)
    coverage = inputs["planes"][4]
    counts = inputs["tissue"] & (coverage > 0.05)
    color = inputs["planes"][:3].transpose(1, 2, 0)[counts].astype(np.float64) / coverage[counts][:, None]
    expected = np.abs(color - inputs["image"][counts] / 255).mean()
    assert mean == pytest.approx(expected, rel=after(3 * PIECE))  # pieces are added up in float64
    np.testing.assert_allclose(weight[counts], 1 / coverage[counts], rtol=after(2))
    assert not weight[~counts].any()
    mean, v_planes, weight = run(inputs | {"tissue": np.zeros_like(counts)})
    assert mean == 0 and not v_planes.any() and not weight.any()


@pytest.mark.parametrize("where", ["depth", *range(5)])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_broken_pixels_are_left_out(run: Run, where: str | int, value: float) -> None:
    clean, broken = frame(), frame()
    for inputs in (clean, broken):
        inputs["tissue"][4, 5] = True
        inputs["planes"][4, 4, 5] = 1.0
        inputs["depth"][4, 5] = inputs["planes"][3, 4, 5]
    only_depth = where in ("depth", 3)  # then the colour still counts
    clean["depth" if only_depth else "tissue"][4, 5] = 0
    if isinstance(where, str):
        broken[where][4, 5] = value
    else:
        broken["planes"][where, 4, 5] = value
    expected, v_clean, _ = run(clean)
    mean, v_broken, weight = run(broken)
    assert mean == expected
    assert np.isfinite(weight).all()
    np.testing.assert_array_equal(v_broken, v_clean)


SIZES = [(HEIGHT, WIDTH), (1, 1), (1, 256), (257, 1), (16, 32), (1, 512), (513, 1)]


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_kernel_writes_the_gradient_of_the_stated_loss(run: Run, height: int, width: int) -> None:
    inputs = {
        name: np.ascontiguousarray(np.resize(array, (*array.shape[:-2], height, width)))
        for name, array in frame().items()
        if name != "image"
    }
    inputs["tissue"][0, 0], inputs["planes"][4, 0, 0] = True, 0.5
    inputs["image"] = np.random.default_rng(1).integers(0, 256, (height, width, 3), np.uint8)
    _, found, _ = run(inputs)
    true, within = twin(**inputs), np.zeros(5)
    for move in range(3):
        rng = np.random.default_rng(move)
        near = twin(**{name: moved(array, rng) for name, array in inputs.items()})
        within = np.maximum(within, np.linalg.norm(near - true, axis=(1, 2)))
    error, size = (np.linalg.norm(each, axis=(1, 2)) for each in (found - true, true))
    assert (error <= within + after(1) * size).all(), (error, within)


def test_same_bits_for_one_and_all_threads() -> None:
    inputs = frame()
    for together, alone in zip(on_cpu(inputs), on_one_thread(lambda: on_cpu(inputs)), strict=True):
        np.testing.assert_array_equal(alone, together)
