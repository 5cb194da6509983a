"""The camera's gain as the device finds it, against the mapper's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from engine_scenes import as_bytes, relative_error

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")

from sags_node.engine.cuda.backend import default_device
from sags_node.engine.losses.pieces import LEVEL
from sags_node.mapping import exposure
from sags_node.mapping.cuda.exposure import exposure_gain
from sags_node.mapping.cuda.refiner import EXPOSURE

HEIGHT, WIDTH = 88, 120


@pytest.mark.parametrize(("share", "brightness"), [(1.0, 1.2), (1.0, 9.0), (0.002, 1.2), (0.0, 1.2)])
def test_gain_is_the_mappers(share: float, brightness: float) -> None:
    """Of one that is larger than any camera's, and where few pixels or none tell it, as well."""
    rng = np.random.default_rng(0)
    color = rng.uniform(0.2, 0.7, (3, HEIGHT, WIDTH))
    planes = np.concatenate([color, np.ones((2, HEIGHT, WIDTH))]) * rng.uniform(0.4, 1, (HEIGHT, WIDTH))
    image = np.clip(color * 1.1 + rng.normal(0, 0.02, color.shape), 0, 1).transpose(1, 2, 0) * brightness
    planes, image = planes.astype(np.float32), as_bytes(image)
    tissue = rng.uniform(size=(HEIGHT, WIDTH)) < share
    expected = exposure.exposure_gain(planes, image, tissue)
    given = [torch.tensor(array, device=default_device()) for array in (planes, image * LEVEL, tissue)]
    found = exposure_gain(*given, EXPOSURE).cpu().numpy()
    assert relative_error(found, expected) < 1e-6
    assert (found == 1).all() == (share < 1 or brightness > 2)
