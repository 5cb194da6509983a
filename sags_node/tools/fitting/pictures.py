"""The training frames at one size, with the rasterizers that draw them."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sags_node.engine.rasterizer.rasterize import Rasterizer, make_rasterizer
from sags_node.field.canvas import Canvas
from sags_node.field.losses import Compared, compare
from sags_node.tools.fitting.clip import ClipFrame
from sags_node.tools.fitting.settings import FitSettings


class Pictures:
    """Frames of one size on a device.

    Attributes:
        frames: all that are learnt; the first training frame comes first.
        drawers: rasterizers of their size, one for each image of an iteration.
        pixel: width of a pixel at the tissue's median depth in the first frame, m.
    """

    def __init__(self, frames: Sequence[ClipFrame], settings: FitSettings, device: str | None) -> None:
        """Prepare them on `device`, as in `Fit`."""
        self.frames, self._settings, self._device = frames, settings, torch.device(device or "cpu")
        first = frames[0]
        height, width = first.tissue.shape
        self.drawers: list[Rasterizer | Canvas] = [
            make_rasterizer("numba", width, height, antialias=settings.antialias)
            if device is None
            else Canvas(width, height, self._device, settings.antialias)
            for _ in range(settings.batch_size)
        ]
        known = first.depth[first.depth > 0]
        self.pixel = float(np.median(known)) / float(first.camera.K[0, 0]) if known.size else 1e-4
        unseen = ~np.any([frame.tissue for frame in frames], axis=0) | settings.smooth_everywhere
        self._unseen = unseen if device is None else self._tensor(unseen)
        self._shown: dict[int, tuple[Tensor, ...]] = {}  # frames already on the device, by their times

    def compare(self, planes: Tensor, frame: ClipFrame) -> Compared:
        """The loss of a frame that was drawn as these planes [5, H, W]."""
        if frame.t_capture_ns not in self._shown:
            shown = frame.image, frame.tissue, frame.depth
            self._shown[frame.t_capture_ns] = tuple(map(self._tensor, shown))
        settings = self._settings
        image, tissue, depth = self._shown[frame.t_capture_ns]
        return compare(planes, image, tissue, depth, self._unseen, settings.weights, settings.color_softness)

    def _tensor(self, array: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(array).to(self._device)
