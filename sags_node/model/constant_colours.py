"""Gaussians of one colour each, for viewers and files that know no slopes (`types.Gaussians.slopes`)."""

from dataclasses import replace

import numpy as np

from sags_node.engine.rasterizer.smoothing import bake_filter
from sags_node.geometry import quat_to_matrix
from sags_node.types import Gaussians

APART = np.float32(0.6)  # standard deviations of the whole from its middle to that of a half; measured best
LEAST = np.float32(0.01)  # a gentler slope is left out: 2.5 grey levels for each standard deviation


def with_constant_colours(gaussians: Gaussians) -> Gaussians:
    """Nearly the same picture without slopes: a Gaussian with one is split in two along the axis on which it
    is steepest. The two together are as wide as the whole, and as opaque where one lies over the other: in
    its middle less, beside it more. Both have its id. The 3D filter is folded in.

    D4D, 26,000 Gaussians, against the picture: 38.1 dB with slopes, 34.7 so, 32.3 without slopes, 34.1 with
    the best colours without them (`benchmarks/slopes.md`).
    """
    gaussians = bake_filter(gaussians)
    if gaussians.slopes is None:
        return gaussians
    axis = np.abs(gaussians.slopes).argmax(axis=1)
    steepest = gaussians.slopes[np.arange(len(gaussians)), axis]
    split = np.flatnonzero(np.abs(steepest) > LEAST)
    count, axis, steepest = len(gaussians), axis[split], steepest[split]
    rows = np.concatenate([np.arange(count), split])
    axes = quat_to_matrix(gaussians.quats[split] / np.linalg.norm(gaussians.quats[split], axis=1)[:, None])
    means, scales, colors = gaussians.means[rows], gaussians.scales[rows], gaussians.colors[rows]
    opacities = gaussians.opacities[rows]
    halves = np.arange(len(split))
    offset = axes[halves, :, axis] * (APART * scales[split, axis])[:, None]
    brighter = (steepest / APART)[:, None]
    for half, side in ((split, np.float32(-1)), (count + halves, np.float32(1))):
        means[half] += side * offset
        colors[half] += side * brighter
        scales[half, axis] *= np.sqrt(1 - APART**2)
        opacities[half] = 1 - np.sqrt(1 - opacities[half])
    return replace(
        gaussians,
        means=means,
        quats=gaussians.quats[rows],
        scales=scales,
        opacities=opacities,
        colors=colors,
        ids=gaussians.ids[rows],
        sh_rest=None if gaussians.sh_rest is None else gaussians.sh_rest[rows],
        depth_errors=None if gaussians.depth_errors is None else gaussians.depth_errors[rows],
        slopes=None,
    )
