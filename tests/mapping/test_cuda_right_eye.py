"""What the device makes of the right eye's picture against what the mapper makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from engine_scenes import camera, relative_error

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")

from sags_node.engine.cuda.backend import default_device
from sags_node.mapping import exposure, right_eye
from sags_node.mapping.cuda.exposure import ExposureRule, exposure_gain
from sags_node.mapping.cuda.right_eye import RightEyeRule, right_eye_loss, right_eye_mask
from sags_node.types import F32, Observation

# the kernels divide by a coverage of zero and select afterwards; a GPU says nothing of it
pytestmark = [
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),
    pytest.mark.usefixtures("quick_interpreter"),
]

DEVICE = default_device()
HEIGHT, WIDTH = 88, 120
BASELINE = 0.004  # m
EXPOSURE = ExposureRule(
    exposure.EVERY, exposure.COVERED, exposure.DARK, exposure.BRIGHT, exposure.LEAST_PIXELS, exposure.LARGEST
)
RULE = RightEyeRule(right_eye.FAR_MARGIN, right_eye.NEAR_MARGIN, right_eye.WEIGHT, right_eye.EVERY, EXPOSURE)


def scene() -> tuple[F32, Observation]:
    """Planes of both eyes, and a pair with an instrument, brighter on the right."""
    rng = np.random.default_rng(0)
    view = camera(WIDTH, HEIGHT, focal=100.0)
    color = rng.uniform(0.2, 0.7, (3, HEIGHT, WIDTH))
    depth = np.linspace(0.05, 0.08, WIDTH) * np.ones((HEIGHT, 1))
    coverage = rng.uniform(0.4, 1, (2, 1, HEIGHT, WIDTH))
    planes = np.concatenate([color, depth[None], np.ones((1, HEIGHT, WIDTH))])[None] * coverage
    tissue = np.ones((HEIGHT, WIDTH), np.bool_)
    tissue[20:40, 60:80] = False
    image = np.clip(color * 1.1 + rng.normal(0, 0.02, color.shape), 0, 1).transpose(1, 2, 0)
    nothing = np.zeros((HEIGHT, WIDTH), np.float32)
    observation = Observation(
        frame_id=0, t_capture_ns=0, camera=view, image=image.astype(np.float32),
        gray=nothing.astype(np.uint8), tissue=tissue, depth=nothing, depth_confidence=nothing,
        right=np.ascontiguousarray(image, np.float32), baseline=BASELINE,
    )  # fmt: skip
    return planes.astype(np.float32), observation


def compare(planes: F32, observation: Observation) -> F32:
    """Both losses agree; returns the gradient."""
    v_expected, expected = np.empty((5, HEIGHT, WIDTH), np.float32), np.empty((HEIGHT, WIDTH), np.float32)
    right_eye.right_eye_loss(planes, observation, v_expected, expected)
    v_planes = torch.full((5, HEIGHT, WIDTH), torch.nan, device=DEVICE)
    weight = torch.full((HEIGHT, WIDTH), torch.nan, device=DEVICE)
    given = [torch.tensor(a, device=DEVICE) for a in (planes, observation.right, observation.tissue)]
    focal = float(observation.camera.K[0, 0])
    right_eye_loss(*given, focal, observation.baseline, RULE, v_planes, weight)
    np.testing.assert_allclose(weight.cpu().numpy(), expected, rtol=1e-6)
    np.testing.assert_allclose(v_planes.cpu().numpy(), v_expected, rtol=1e-4, atol=1e-6)
    return v_expected


def test_right_eye_loss_is_the_mappers() -> None:
    planes, observation = scene()
    v_planes = compare(planes, observation)
    assert 0.2 < (v_planes[0] != 0).mean() < 0.9


@pytest.mark.parametrize("tissue", [True, False])
@pytest.mark.parametrize("depth", [0.0, np.nan, 1e-9])
def test_without_a_depth_the_right_eye_says_nothing_of_colour(tissue: bool, depth: float) -> None:
    planes, observation = scene()
    planes[0, 3] = depth
    v_planes = compare(planes, replace(observation, tissue=np.full((HEIGHT, WIDTH), tissue)))
    assert not v_planes.any()


@pytest.mark.parametrize(("near", "far"), [(0.05, 0.08), (0.0045, 0.3), (0.021, 0.021)])
def test_right_eye_mask_is_the_mappers(near: float, far: float) -> None:
    rng = np.random.default_rng(1)
    tissue = rng.uniform(size=(HEIGHT, WIDTH)) < 0.98
    depths = rng.uniform(near, far, 400).astype(np.float32)
    expected = right_eye.right_eye_mask(tissue, depths, 100.0, BASELINE)
    given = torch.tensor(np.append(depths, np.float32(np.nan)), device=DEVICE)
    found = right_eye_mask(torch.tensor(tissue, device=DEVICE), given, 100.0, BASELINE, RULE)
    np.testing.assert_array_equal(found.cpu().numpy(), expected)


@pytest.mark.parametrize(("share", "brightness"), [(1.0, 1.2), (1.0, 9.0), (0.002, 1.2), (0.0, 1.2)])
def test_gain_is_the_mappers(share: float, brightness: float) -> None:
    """Of one that is larger than any camera's, and where few pixels or none tell it, as well."""
    planes, observation = scene()
    image = observation.image * np.float32(brightness)
    tissue = np.random.default_rng(2).uniform(size=(HEIGHT, WIDTH)) < share
    expected = exposure.exposure_gain(planes[0], image, tissue)
    given = [torch.tensor(array, device=DEVICE) for array in (planes[0], image, tissue)]
    found = exposure_gain(*given, EXPOSURE).cpu().numpy()
    assert relative_error(found, expected) < 1e-6
    assert (found == 1).all() == (share < 1 or brightness > 2)
