"""Tissue by a user's segmentation network."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.config.schema import OnnxConfig, TissueConfig
from sags_node.errors import UsageError
from sags_node.types import U8, Bool
from sags_node.vision.onnx_session import DepthNetworkError, Network, Size

MULTIPLE = 32  # px, of sides that the network leaves open


class TissueNetwork(Network):
    """Takes one image, and gives scores of classes, one score, or class numbers, at its size or coarser.

    The highest of several scores is the class. Whole numbers are classes. One score is a probability while it
    lies within 0 and 1, else a logit; where it is high is class 1. How images are fed is described as for
    depth networks, in the file's metadata or a .yaml beside it; the default is RGB as for ImageNet.

    Args:
        size: width and height of the images it will get, px.

    Raises:
        UsageError: the file is missing or no such network.
    """

    def __init__(self, config: TissueConfig, size: Size) -> None:
        assert config.path is not None and config.tissue_is is not None  # the launch file was checked
        super().__init__(OnnxConfig(path=config.path), size, MULTIPLE, "imagenet", "vision.tissue")
        self._tissue_is = config.tissue_is
        if len(self._fed) != 1 or self._fed[0].eyes != ("left",):
            raise UsageError(f"{self.name} takes several images; a mask is made of the left one")
        self._is_logit = False
        try:
            self(np.full((size[1], size[0], 3), 128, np.uint8))
        except DepthNetworkError as error:
            raise UsageError(f"vision.tissue.path: {error}") from None

    def __call__(self, image: U8) -> Bool:
        """Return the tissue [H, W] of an image [H, W, 3] RGB.

        Raises:
            DepthNetworkError: the network failed, or its answer is no mask.
        """
        classes = self._classes(self._outputs(image))
        if self._tissue_is == "white":
            tissue = classes > 0
        elif self._tissue_is == "black":
            tissue = classes == 0
        else:
            tissue = np.isin(classes, self._tissue_is)
        share: NDArray[np.float32] = cv2.resize(self._without_padding(tissue.astype(np.float32)), self._size)
        return share > 0.5

    def _classes(self, outputs: Mapping[str, NDArray[Any]]) -> NDArray[np.intp]:
        """Class numbers [h, w] of the padded image."""
        for name, values in outputs.items():
            scores = self._maps(values)
            if scores is None or self._said.output not in (None, name):
                continue
            if not np.isfinite(scores).all():
                raise DepthNetworkError(f"{self.name}: output {name} is not finite")
            if len(scores) > 1:
                return np.asarray(scores.argmax(0))
            is_whole = scores.min() >= 0 and np.array_equal(scores, np.rint(scores))
            if scores.dtype.kind in "iub" or is_whole:  # exporters cast class numbers to floats
                return np.asarray(scores[0], np.intp)
            self._is_logit |= bool(scores.min() < 0 or scores.max() > 1)
            return np.asarray(scores[0] > (0 if self._is_logit else 0.5), np.intp)
        raise DepthNetworkError(f"{self.name}: no output is a mask of the {self._map_sizes}")
