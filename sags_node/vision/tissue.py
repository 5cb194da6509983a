"""Which working pixels show tissue."""

import logging
from collections.abc import Callable

import cv2
import numpy as np

from sags_node.config.schema import TissueConfig
from sags_node.errors import UsageError
from sags_node.types import U8, Bool, RectifiedPair, RenderedView, StereoFrame
from sags_node.vision.onnx_session import DepthNetworkError
from sags_node.vision.rectify import Rectifier
from sags_node.vision.tissue_classical import InstrumentFinder
from sags_node.vision.tissue_network import TissueNetwork
from sags_node.vision.tissue_topic import NearestMask, NoMaskError, TopicMasks

log = logging.getLogger(__name__)

LARGEST_INSTRUMENTS = 0.5  # of the usable image
FIRST_FRAMES = 5  # if all of them have more, the mask is inverted


class TissueMask:
    """The tissue mask of every frame: the session's own, a network's, another process's, or found without.

    Attributes:
        usable: [H, W], False where no frame shows tissue: in what is excluded, and outside the raw image.
        problem: why the newest frame's mask is not the network's or the other process's; empty: it is, or
            there is none.

    Args:
        masks: those of another process, for method topic.

    Raises:
        UsageError: an excluded box does not lie in the raw image, the network cannot be used, or nothing
            receives masks.
    """

    def __init__(self, config: TissueConfig, rectifier: Rectifier, masks: NearestMask | None = None) -> None:
        self._config = config
        self._rectifier = rectifier
        self.usable = rectifier.mask(_outside(config, rectifier.raw_size))
        self._segment: Callable[[RectifiedPair], Bool] | None = None
        self._topic: TopicMasks | None = None
        if config.method == "onnx":
            camera = rectifier.camera
            network = TissueNetwork(config, (camera.width, camera.height))
            self._segment = lambda pair: network(pair.left)
        elif config.method == "topic":
            self._segment = self._topic = TopicMasks(config, masks)
        self._find_instruments = InstrumentFinder()
        self._frames_checked = 0
        side = 2 * config.dilate + 1
        self._neighbourhood = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        self.problem = ""
        self._found: Bool | None = None

    def __call__(self, frame: StereoFrame, pair: RectifiedPair, expected: RenderedView | None = None) -> Bool:
        """Return the mask [H, W], True = tissue; highlights on tissue are tissue.

        Args:
            expected: the model as it was drawn last, where there is one: only looked at where nobody gives a
                mask.

        Raises:
            UsageError: the masks of a recording's first frames call most of the image instrument.
        """
        if self._config.method == "none":
            return self.usable
        tissue = self._given(frame, pair)
        if tissue is None:
            tissue = ~self._find_instruments(pair.left, expected, pair.t_capture_ns)
        self._found = tissue
        # The image's border counts as tissue here: only instruments grow.
        eroded: U8 = cv2.erode(tissue.view(np.uint8), self._neighbourhood)
        return eroded.view(np.bool_) & self.usable

    @property
    def instruments(self) -> Bool | None:
        """Return where the newest frame shows instruments [H, W], without the margin; None: nobody looks."""
        return None if self._found is None else ~self._found & self.usable

    @property
    def bare(self) -> Bool:
        """Return the newest frame's mask [H, W] as it was given or found, without the margin."""
        return self.usable if self._found is None else self._found & self.usable

    def _given(self, frame: StereoFrame, pair: RectifiedPair) -> Bool | None:
        if self._segment is not None:
            try:
                tissue = self._segment(pair)
                self._check_polarity(tissue, is_live=frame.t_arrival_ns > 0)
            except (DepthNetworkError, NoMaskError) as error:
                if not self.problem:
                    log.warning("%s; instruments are found without it", error)
                self.problem = str(error)
                return None
            self.problem = ""
            return tissue
        if self._config.method == "session" and frame.tissue is not None:
            tissue = self._rectifier.mask(frame.tissue)
            self._check_polarity(tissue, is_live=False)
            return tissue
        return None

    def _check_polarity(self, tissue: Bool, is_live: bool) -> None:
        """Refuses inverted masks: with them the model would learn the instruments alone. A live mask may also
        be right, as the scope is still outside: then masks are left out until one calls less instrument."""
        if self._frames_checked == FIRST_FRAMES:
            return
        share = float(np.mean(~tissue[self.usable]))
        if share <= LARGEST_INSTRUMENTS:
            self._frames_checked = FIRST_FRAMES
            return
        said = self._config.tissue_is
        opposite = {"white": "black", "black": "white"}.get(str(said), "other class numbers")
        hint = f"set vision.tissue.tissue_is to {opposite}, it is {said}"
        whose = {"onnx": "network's", "topic": "topic's"}.get(self._config.method, "session's")
        if is_live:
            raise NoMaskError(
                f"so far the {whose} masks call over half of each image instrument: the scope is outside, "
                f"or they are upside down: {hint}"
            )
        self._frames_checked += self._topic is None or self._topic.is_new
        if self._frames_checked == FIRST_FRAMES:
            if self._segment is None:
                hint = "white must be instrument in its files; source.instruments turns EndoNeRF's round"
            raise UsageError(
                f"the {whose} masks call over half of each of the first {FIRST_FRAMES} images instrument "
                f"({share:.0%} now): upside down? {hint}. If they are right, begin later (source.start), or "
                "find instruments without them: vision.tissue.method:=classical"
            )


def _outside(config: TissueConfig, raw_size: tuple[int, int]) -> Bool:
    """True outside the excluded boxes, [H, W] of the raw image."""
    width, height = raw_size
    outside = np.ones((height, width), np.bool_)
    for x, y, box_width, box_height in config.exclude:
        if (
            min(x, y) < 0
            or min(box_width, box_height) < 1
            or x + box_width > width
            or y + box_height > height
        ):
            raise UsageError(
                f"vision.tissue.exclude: box {[x, y, box_width, box_height]} (x, y, width, height) is not "
                f"inside the raw image of {width}x{height}"
            )
        outside[y : y + box_height, x : x + box_width] = False
    return outside
