"""What a run says of a moment that the mapper never saw: later than its frames, or between two of them."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from sags_node.detail.carry import EVERY, trace
from sags_node.detail.motion import SmallDrawings
from sags_node.detail.seen import SeenFrame
from sags_node.engine.rasterizer.views import colours_of, to_view
from sags_node.geometry import resized_camera
from sags_node.model.forecast import gaussians_ahead, reached
from sags_node.types import F32, Camera, Gaussians, Snapshot

VELOCITY_SHARE = 0.8  # tissue slows down: less than the last velocity predicts best (0.3 to 0.7 dB over none)


def extrapolated(snapshot: Snapshot, seconds: float) -> Gaussians:
    """The Gaussians `seconds` after the snapshot, as a node's views ahead of the image show them: by its
    forecast, no farther than that has skill for. Without one, by 0.8 times their last observed velocity."""
    gaussians = snapshot.gaussians
    if snapshot.forecast is not None:
        ahead = reached(snapshot, seconds)
        return gaussians_ahead(snapshot, ahead) if ahead > 0 else gaussians
    return replace(
        gaussians, means=gaussians.means + snapshot.velocities * np.float32(VELOCITY_SHARE * seconds)
    )


def between(before: SeenFrame, after: Gaussians, share: float) -> Gaussians:
    """The Gaussians of a moment between two mapped frames: means and colours are interpolated linearly,
    `share` (0..1) of the way from the earlier to the later. Gaussians that the earlier one lacks are as in
    the later one."""
    rows, shared = before.rows_of(after.ids)
    left = np.where(shared, np.float32(1 - share), np.float32(0))[:, None]
    return replace(
        after,
        means=after.means + left * (before.gaussians.means[rows] - after.means),
        colors=after.colors + left * (before.gaussians.colors[rows] - after.colors),
    )


def carried(
    planes: F32,
    middle: Gaussians,
    camera: Camera,
    around: Sequence[tuple[SeenFrame, float]],
    drawings: SmallDrawings,
) -> F32:
    """The mean of some images, carried along the model's motion to where the tissue is at another moment.

    Gaussians cannot say all of an image's detail, but they know where everything went. Where nothing moves
    this is the mean of the images, whose noise is less than that of each. Tissue is traced as for a view of
    the node, but of every pixel, and looked up cubically, not rounded: a mean shows the difference.

    Args:
        planes: [5, H, W], drawn of `middle`.
        middle: the Gaussians at that moment.
        camera: that sees it.
        around: the frames with images, and the weight of each in the mean, more than 0.

    Returns:
        [H, W, 3] RGB 0..1; where no image shows tissue, what the Gaussians show.
    """
    depth = to_view(planes, camera, 0, 0).depth
    finer = resized_camera(camera, EVERY * camera.width, EVERY * camera.height)  # its coarse camera is ours
    total = np.zeros((*depth.shape, 4), np.float32)
    for source, weight in around:
        lent = source.lent(np.inf)
        traced = trace(depth, camera, source, lent, drawings.motion(middle, finer, source), steady=True)
        places, share = traced.places[1:-1, 1:-1], traced.share[1:-1, 1:-1, None]
        tissue = lent * (lent[..., 3:] / np.float32(255))  # so that no instrument's colour comes in
        found = cv2.remap(tissue, places, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        shown = (share > 0) & (found[..., 3:] > 255 / 2)
        total += np.where(shown, np.float32(weight) * found, np.float32(0))
    mean: F32 = colours_of(planes)
    np.divide(total[..., :3], total[..., 3:], out=mean, where=total[..., 3:] > 0)
    return np.clip(mean, 0, 1)
