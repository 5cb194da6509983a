"""A user's depth network, stereo or monocular, behind one call: pictures in, one map out."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.config.schema import NORMALIZATIONS, Normalization, OnnxConfig
from sags_node.errors import UsageError
from sags_node.types import F32, U8
from sags_node.vision.onnx_format import read_format
from sags_node.vision.onnx_inputs import Eye, Fit, Size, recognise
from sags_node.vision.onnx_outputs import MapName, Reading, find_maps, unfit
from sags_node.vision.onnx_session import DepthNetworkError, OnnxSession
from sags_node.vision.onnx_test_pair import NEAREST, make_pair

log = logging.getLogger(__name__)

MULTIPLES = (32, 14, 64)  # px, of sides: convolutions, vision transformers, deep pyramids
LARGEST_ERROR = 3.0  # px, mean on the test pair: a larger one is no disparity
WRONG = 10.0  # px: no error counts for more
EQUAL_COSTS = 0.01  # px: within them what is tried first wins
ERROR_PER_OCTAVE = 0.25  # px
FEWEST_FINITE = 0.5  # of the numbers
MENDS = "docs/networks.md says what to write into a .yaml file beside it"


@dataclass(frozen=True, slots=True)
class Way:
    """How to feed a network, and how to read it."""

    normalization: Normalization
    multiple: int
    map_name: MapName
    reading: Reading
    error: float = 0.0  # px, mean on the test pair

    @property
    def cost(self) -> float:
        """A finer map may be a little less exact: the test pair has no edges, which it is finer for."""
        return self.error + ERROR_PER_OCTAVE * float(np.log2(self.map_name.coarseness))


class DepthNetwork:
    """What a file does not say of itself is found by trying it on a made-up pair of the working size.

    Attributes:
        name: of the file.
        is_stereo: it needs both eyes.
        way: how it is fed and read.
        processor: where it runs, "cuda" or "cpu".

    Args:
        size: width and height of the pictures it will get, px.
        focal_baseline: focal length times baseline at that size, px m: for a network that gives depth.

    Raises:
        UsageError: the file is no depth network, or none of the ways to feed and read it fits.
    """

    def __init__(self, config: OnnxConfig, size: Size, focal_baseline: float) -> None:
        session = OnnxSession(config)
        self._session = session
        self.name, self.processor = session.name, session.processor
        self._said = read_format(config, session.metadata)
        self._inputs = recognise(session.inputs, self._said, self.name)
        self.is_stereo = {eye for one in self._inputs for eye in one.eyes} == {"left", "right"}
        self._size = size
        self.way = self._find_way(focal_baseline)
        log.info("%s", self._described(self._warm_up()))

    def __call__(self, left: U8, right: U8 | None) -> F32:
        """Disparity [H, W] (px; NaN or <= 0: unknown), or relative inverse depth of a monocular network.

        Args:
            left, right: [H, W, 3] RGB; the right one is only looked at by a stereo network.

        Raises:
            DepthNetworkError: it failed, or its output is not what it was at the start.
        """
        way = self.way
        maps, fit = self._maps(left, right, way.normalization, way.multiple)
        if way.map_name not in maps:
            raise DepthNetworkError(
                f"{self.name}: output {way.map_name.output} has another size than at the start"
            )
        numbers = maps[way.map_name]
        if np.mean(np.isfinite(numbers)) < FEWEST_FINITE:
            raise DepthNetworkError(f"{self.name}: output {way.map_name.output} is not finite")
        inner = way.reading.disparity(unfit(numbers, fit))
        if not self.is_stereo:
            return _resized(inner, self._size)
        return _resized(inner, self._size) * np.float32(self._size[0] / fit.inner[0])

    def _warm_up(self) -> float:
        """What one call costs, ms: the first of all was slower."""
        left, right, _ = make_pair(*self._size)
        started = time.perf_counter()
        self(left, right)
        return (time.perf_counter() - started) * 1e3

    def _described(self, cost: float) -> str:
        """One line for the log: what was recognised."""
        way, one = self.way, self._inputs[-1]
        fit = one.fit(self._size, way.multiple)
        kind = "stereo" if self.is_stereo else "monocular"
        layout = "NCHW" if one.channels_first else "NHWC"
        names = {value: name for name, value in NORMALIZATIONS.items()}
        fed = "uint8" if one.dtype == np.uint8 else names.get(way.normalization, "its own normalization")
        error = f", off by {way.error:.2f} px on the test pair" if self.is_stereo else ""
        return (
            f"depth network {self.name}: {kind}, {layout} {one.channels} channels {fed} "
            f"{fit.outer[0]}x{fit.outer[1]}, output {way.map_name.output}{error}, {cost:.0f} ms on "
            f"{self.processor}"
        )

    def _maps(
        self, left: U8, right: U8 | None, normalization: Normalization, multiple: int
    ) -> tuple[dict[MapName, F32], Fit]:
        pictures: dict[Eye, U8] = {"left": left} if right is None else {"left": left, "right": right}
        feeds = {}
        for one in self._inputs:  # of several sizes the last is the full one
            fit = one.fit(self._size, multiple)
            feeds[one.name] = one.tensor(pictures, fit, normalization, self._said.color == "bgr")
        return find_maps(self._session.run(feeds), fit), fit

    def _find_way(self, focal_baseline: float) -> Way:
        failure = ""
        for multiple in (self._said.multiple,) if self._said.multiple else MULTIPLES:
            try:
                return (
                    self._stereo_way(multiple, focal_baseline) if self.is_stereo else self._mono_way(multiple)
                )
            except DepthNetworkError as error:
                failure = failure or str(error)
        raise UsageError(f"{failure}; {MENDS}")

    def _stereo_way(self, multiple: int, focal_baseline: float) -> Way:
        """The way with the least error on the test pair."""
        presets = [NORMALIZATIONS["unit"]] if self._takes_bytes else list(NORMALIZATIONS.values())
        if self._said.normalization is not None:
            presets = [self._said.normalization]
        left, right, truth = make_pair(*self._size)
        best: Way | None = None
        failure: DepthNetworkError | None = None
        for preset in presets:
            try:
                maps, fit = self._tried(left, right, preset, multiple)
            except DepthNetworkError as error:  # an input far from what it knows may give infinity
                failure = failure or error
                continue
            expected = _resized(truth, fit.inner) * np.float32(fit.inner[0] / self._size[0])
            focal = focal_baseline * fit.inner[0] / self._size[0]
            for name, numbers in maps.items():
                for reading in self._readings(name.coarseness, fit, focal):
                    off = _error(reading.disparity(unfit(numbers, fit)), expected)
                    way = Way(preset, multiple, name, reading, off)
                    if best is None or way.cost < best.cost - EQUAL_COSTS:
                        best = way
        if best is None and failure is not None:
            raise failure
        if best is None:
            raise UsageError(f"{self.name}: meaning: a stereo network gives no {self._said.meaning}")
        if best.error > LARGEST_ERROR:
            reason = f"the best is off by {best.error:.1f} px (mean) on a made-up pair"
            if self._said.meaning is None or self._said.normalization is None:
                raise DepthNetworkError(f"{self.name} gives no disparity in any way that was tried: {reason}")
            log.warning("%s is used as it is said, but %s", self.name, reason)
        return best

    def _mono_way(self, multiple: int) -> Way:
        """What one picture cannot tell is as in most networks: ImageNet's normalisation, inverse depth."""
        if self._said.meaning in ("disparity", "negative_disparity"):
            raise UsageError(f"{self.name}: meaning: a monocular network gives depth or inverse_depth")
        normalization = self._said.normalization or NORMALIZATIONS["imagenet"]
        left, _, _ = make_pair(*self._size)
        maps, _ = self._tried(left, None, normalization, multiple)
        finest = min(maps, key=lambda name: name.coarseness)
        return Way(normalization, multiple, finest, Reading(1.0, inverted=self._said.meaning == "depth"))

    @property
    def _takes_bytes(self) -> bool:
        return self._inputs[0].dtype == np.uint8

    def _tried(
        self, left: U8, right: U8 | None, normalization: Normalization, multiple: int
    ) -> tuple[dict[MapName, F32], Fit]:
        """The maps that can be used, of the output that was asked for.

        Raises:
            DepthNetworkError: the network fails, gives no map, or none that is finite.
        """
        maps, fit = self._maps(left, right, normalization, multiple)
        maps = {name: map_ for name, map_ in maps.items() if self._said.output in (None, name.output)}
        if not maps:
            width, height = fit.outer
            which = f"output {self._said.output} is not" if self._said.output else "no output is"
            raise DepthNetworkError(
                f"{self.name}: {which} a map of the {width}x{height} px that it was given, or of a half, a "
                "quarter or an eighth of them"
            )
        finite = {name: map_ for name, map_ in maps.items() if np.mean(np.isfinite(map_)) >= FEWEST_FINITE}
        if not finite:
            raise DepthNetworkError(f"{self.name} gives numbers that are not finite for an ordinary picture")
        return finite, fit

    def _readings(self, coarseness: int, fit: Fit, focal_baseline: float) -> list[Reading]:
        """What a stereo map's numbers may be: px of the picture, of the map, or widths of the picture, of
        either sign; or depth in metres."""
        factors = dict.fromkeys((1.0, float(coarseness), float(fit.outer[0])))
        positive, negative = [Reading(f) for f in factors], [Reading(-f) for f in factors]
        depth = [Reading(focal_baseline, inverted=True)]
        said = {"disparity": positive, "negative_disparity": negative, "depth": depth, "inverse_depth": []}
        return [*positive, *negative, *depth] if self._said.meaning is None else said[self._said.meaning]


def _error(disparity: F32, truth: F32) -> float:
    """Mean error, px, each counted up to WRONG, where the right eye sees the surface too."""
    seen = slice(int(NEAREST * truth.shape[1]) + 1, None)
    errors = np.abs(disparity - truth)[::2, seen][:, ::2]
    return float(np.mean(np.fmin(errors, WRONG)))  # NaN counts as wrong


def _resized(picture: F32, size: Size) -> F32:
    if picture.shape[1::-1] == size:
        return picture
    shrinks = size[0] < picture.shape[1]
    resized: F32 = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return resized
