"""Depth by the user's network, for as long as it delivers."""

from __future__ import annotations

import logging

from sags_node.config.schema import VisionConfig
from sags_node.errors import UsageError
from sags_node.types import F32, Bool, Camera, RectifiedPair
from sags_node.vision.mono_depth import Measure, MonoDepth
from sags_node.vision.onnx_network import DepthNetwork
from sags_node.vision.onnx_session import DepthNetworkError
from sags_node.vision.stereo import StereoDepth

log = logging.getLogger(__name__)

MOST_FAILURES = 3  # in a row, after which the network is not tried any more


class NetworkDepth:
    """Depth and confidence of each frame from the network of `vision.onnx`.

    Attributes:
        problem: why the newest frame has no depth of the network; empty: it has.

    Args:
        stereo: judges a stereo network's disparity as it judges its own.

    Raises:
        UsageError: as `DepthNetwork`.
    """

    def __init__(self, config: VisionConfig, stereo: StereoDepth, camera: Camera, baseline: float) -> None:
        size = camera.width, camera.height
        self._network = DepthNetwork(config.onnx, size, float(camera.K[0, 0]) * baseline)
        self._stereo = stereo
        self._mono = MonoDepth(config.onnx.declared_depth, config.stereo)
        self._fallback = config.onnx.fallback
        self._failures = 0  # in a row
        self.problem = ""

    def __call__(self, pair: RectifiedPair, tissue: Bool, measure: Measure) -> tuple[F32, F32] | None:
        """Depth [H, W] (m, 0 unknown) and confidence [H, W] (0..1); None: `problem` says why.

        Args:
            measure: for a monocular network, see `MonoDepth`.

        Raises:
            UsageError: the frames lack what this network needs.
            DepthNetworkError: it failed, and `vision.onnx.fallback` is off.
        """
        if self._network.is_stereo and pair.right is None:
            raise UsageError(
                f"{self._network.name} is a stereo network but the source has no right eye; name a "
                "monocular one, and vision.onnx.declared_depth (docs/networks.md, 'One eye')"
            )
        if self._failures == MOST_FAILURES:
            return None
        try:
            disparity = self._network(pair.left, pair.right)
            if self._network.is_stereo:
                found = self._stereo.judge(pair, disparity, tissue)
            else:
                found = self._mono(disparity, tissue, measure)
        except DepthNetworkError as error:
            if not self._fallback:
                raise
            self._failed(str(error))
            return None
        self._failures, self.problem = 0, ""
        return found

    def _failed(self, reason: str) -> None:
        self._failures += 1
        ends = f", {MOST_FAILURES} times in a row: not tried again" if self._failures == MOST_FAILURES else ""
        if ends or reason != self.problem:
            log.warning("depth without the network: %s%s", reason, ends)
        self.problem = reason + ends
