"""Depth by a user's network, stereo or monocular, for as long as the network works."""

import logging
import time

import numpy as np

from sags_node.config.schema import NORMALIZATIONS, OnnxConfig, VisionConfig
from sags_node.errors import UsageError
from sags_node.resizing import resized_image
from sags_node.types import F32, U8, Bool, Camera, RectifiedPair
from sags_node.vision.mono_depth import FEWEST_SAMPLES, Measure, MonoDepth
from sags_node.vision.onnx_session import DepthNetworkError, Network, Size, has_clear_layout
from sags_node.vision.stereo import StereoDepth

log = logging.getLogger(__name__)

MOST_FAILURES = 3  # in a row, after which the network is not tried any more
MOST_CHANNELS = 4  # of an output that is maps; more are features
FEWEST_FINITE = 0.5  # of the output's numbers must be finite
ALIKE = 0.1  # of the depth: depths that differ by less agree; a wrong scale, sign or eye makes more
FEWEST_ALIKE = 0.5  # of the places with a measured depth must agree with it
MEANINGS = {True: ("disparity", "depth"), False: ("inverse_depth", "depth")}  # by whether it is stereo
HELP = "docs/networks.md says what the keys mean"


class DepthNetwork(Network):
    """The network of `vision.onnx`. It is run twice at the start.

    Attributes:
        is_stereo: it needs both eyes.

    Args:
        size: width and height of the images it will get, px.
        focal_baseline: focal length times baseline at that size, px m: for a network that gives depth.

    Raises:
        UsageError: the file is no depth network, or keys are missing that describe it.
    """

    def __init__(self, config: OnnxConfig, size: Size, focal_baseline: float) -> None:
        super().__init__(config, size, 1, "unit")  # bytes need no other
        self.is_stereo = {eye for one in self._fed for eye in one.eyes} == {"left", "right"}
        self._check_description()
        self._focal_baseline = focal_baseline
        self._output = self._said.output or self.outputs[0]
        try:
            log.info("%s", self._described(self._warm_up()))
        except DepthNetworkError as error:
            raise UsageError(f"{error} ({self.description}); {HELP}") from None

    def __call__(self, left: U8, right: U8 | None) -> F32:
        """Return disparity [H, W] (px; NaN or <= 0: unknown), or relative inverse depth if monocular.

        Args:
            left, right: [H, W, 3] RGB; the right one is only looked at by a stereo network.

        Raises:
            DepthNetworkError: it failed, or its output is no map, or not finite.
        """
        numbers = self._map(left, right)
        if np.mean(np.isfinite(numbers)) < FEWEST_FINITE:
            raise DepthNetworkError(f"{self.name}: output {self._output} is not finite")
        numbers = self._without_padding(numbers) * np.float32(self._said.scale or 1.0)
        if self._said.meaning == "depth":
            known = numbers > 0
            dividend = np.float32(self._focal_baseline if self.is_stereo else 1.0)
            return resized_image(
                np.divide(dividend, numbers, out=np.zeros_like(numbers), where=known), self._size
            )
        if self.is_stereo:
            numbers *= np.float32(self._size[0] / numbers.shape[1])
        return resized_image(numbers, self._size)

    def _map(self, left: U8, right: U8 | None) -> F32:
        """The output's first channel [h, w], a map of the padded image or coarser."""
        values = self._outputs(left, right)[self._output]
        maps = self._maps(values) if values.dtype.kind in "fiu" else None
        if maps is None or len(maps) > MOST_CHANNELS:
            raise DepthNetworkError(
                f"{self.name}: output {self._output} is not a map of the {self._map_sizes}"
            )
        first: F32 = maps[0].astype(np.float32)
        return first

    def _check_description(self) -> None:
        """
        Raises:
            UsageError: a key is missing, or says what this network cannot be.
        """
        said = self._said
        if said.output is not None and said.output not in self.outputs:
            raise UsageError(f"{self.name}: output: its outputs are {', '.join(self.outputs)}")
        meanings = MEANINGS[self.is_stereo]
        if said.meaning is not None and said.meaning not in meanings:
            kind = "stereo" if self.is_stereo else "monocular"
            raise UsageError(f"{self.name}: meaning: a {kind} network gives {' or '.join(meanings)}")
        is_open = any(one.width is None or one.height is None for one in self._fed)
        missing = {
            "inputs ([left eye's, right eye's])": said.inputs is None and len(self._fed) > 1,
            "layout (nchw or nhwc)": said.layout is None and not all(map(has_clear_layout, self.inputs)),
            f"normalization ({', '.join(NORMALIZATIONS)}, or {{mean: [], std: []}})": (
                said.normalization is None and self._fed[0].dtype != np.uint8
            ),
            "size ([width, height]) or multiple (px, of its sides)": is_open and said.multiple is None,
            f"output ({' or '.join(self.outputs)})": said.output is None and len(self.outputs) > 1,
            f"meaning ({' or '.join(meanings)})": said.meaning is None,
        }
        if unsaid := [key for key, is_missing in missing.items() if is_missing]:
            raise UsageError(
                f"{self.name} ({self.description}) is not described: set in vision.onnx, or in a .yaml "
                f"file beside it: {'; '.join(unsaid)}; {HELP}"
            )

    def _warm_up(self) -> float:
        """Run the network twice on noise; return the time of the second call, ms, for the first is slower.
        The output for noise is not judged."""
        noise = np.random.default_rng(0).integers(0, 256, (self._size[1], self._size[0], 3), np.uint8)
        right = noise if self.is_stereo else None
        self._map(noise, right)
        started = time.perf_counter()
        self._map(noise, right)
        return (time.perf_counter() - started) * 1e3

    def _described(self, cost: float) -> str:
        """One line for the log."""
        kind, (width, height) = "stereo" if self.is_stereo else "monocular", self._fits[-1].outer
        return (
            f"depth network {self.name}: {kind}, {self.description}; fed {width}x{height} px, "
            f"{cost:.0f} ms on {self.processor}"
        )


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
        self._has_agreed = False  # a stereo network's depth with a measured one
        self.problem = ""

    @property
    def measures(self) -> bool:
        """True: the next frame is fitted to the depth from `measure`, if there is any."""
        return not self._network.is_stereo and self._mono.measures and self._failures < MOST_FAILURES

    @property
    def is_declared(self) -> bool:
        """True: the scale of its depth is declared, not measured."""
        return self._mono.is_declared

    def __call__(self, pair: RectifiedPair, tissue: Bool, measure: Measure) -> tuple[F32, F32] | None:
        """Return depth [H, W] (m, 0 unknown) and confidence [H, W] (0..1); None: `problem` says why.

        Args:
            measure: for a monocular network, see `MonoDepth`; a stereo network is compared with it until it
                has agreed once.

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
                self._compare(found[0], measure)
            else:
                found = self._mono(disparity, tissue, measure)
        except DepthNetworkError as error:
            if not self._fallback:
                raise
            self._failed(str(error))
            return None
        self._failures, self.problem = 0, ""
        return found

    def _compare(self, depth: F32, measure: Measure) -> None:
        """Refuse a network that is described wrongly, whose disparities match by chance here and there.

        Raises:
            DepthNetworkError: its first depth [H, W] differs from the depth measured without it.
        """
        measured = None if self._has_agreed else measure()
        if measured is None or np.count_nonzero(measured) < FEWEST_SAMPLES:
            return
        known = measured > 0
        alike = float(np.mean(np.abs(depth - measured)[known] < ALIKE * measured[known]))
        if alike < FEWEST_ALIKE:
            raise DepthNetworkError(
                f"{self._network.name}: its depth is the measured one at only {alike:.0%} of the places: "
                "check vision.onnx: meaning, scale, inputs, normalization, color"
            )
        self._has_agreed = True

    def _failed(self, reason: str) -> None:
        self._failures += 1
        ends = f", {MOST_FAILURES} times in a row: not tried again" if self._failures == MOST_FAILURES else ""
        if ends or reason != self.problem:
            log.warning("depth without the network: %s%s", reason, ends)
        self.problem = reason + ends
