"""Depth of every frame: the session's own, a network's, or matched between the eyes."""

from collections.abc import Mapping
from functools import cache, partial
from typing import NamedTuple, Self

import numpy as np

from sags_node.config.schema import VisionConfig
from sags_node.types import F32, Bool, Finding, RectifiedPair, StereoFrame
from sags_node.vision.alignment import RowErrors
from sags_node.vision.onnx_depth import NetworkDepth
from sags_node.vision.pyramid import pyramids
from sags_node.vision.rectify import Rectifier
from sags_node.vision.stereo import StereoDepth
from sags_node.vision.watch.match_watch import MatchWatch

LEAST_MATCHED = 0.05  # of the tissue that both eyes see; less is chance. Clear recordings have over a half
TOO_FEW = (
    "hardly anything matches between the eyes, so there is no depth: the tissue is too near, or beyond "
    "vision.stereo.max_depth, or the calibration is of another scope; sags calib check tells"
)
FARTHEST = 10.0  # m: a session's depth beyond it is taken for unknown
_DECLARED = Finding(
    "scale_declared",
    "one camera alone: the scale is vision.onnx.declared_depth, which nothing measures, so no depth is sure; "
    "give a right eye or the session's depth, or take depth for a drawing",
)


class Measured(NamedTuple):
    """What is known of one frame's depth."""

    depth: F32  # [H, W] m, 0 unknown
    confidence: F32  # [H, W] 0..1
    skipped: Mapping[str, str] = {}  # what was left out, and why
    hurried: bool = False  # there was no time
    is_new: bool = True  # False: it is an older frame's
    found_out: bool = False  # what was matched before turns out to be no depth

    @classmethod
    def nothing(cls, shape: tuple[int, ...], why: str = "", hurried: bool = False) -> Self:
        """Return unknown depth everywhere; `why` is the reason."""
        depth, confidence = np.zeros((2, *shape), np.float32)
        return cls(depth, confidence, {"depth": why}, hurried=hurried)

    def handed_on(self, tissue: Bool) -> Self:
        """Return it for a later frame, in which nothing has moved since and which shows `tissue` [H, W]."""
        skipped = dict.fromkeys(("depth", "motion"), "nothing moves")
        return type(self)(self.depth * tissue, self.confidence * tissue, skipped, is_new=False)


class DepthChoice:
    """Chooses the best depth that a frame can have.

    Attributes:
        stereo: matches the eyes, and judges a network's disparities.

    Raises:
        UsageError: the images cannot be matched, or the network cannot be used.
    """

    def __init__(self, config: VisionConfig, rectifier: Rectifier) -> None:
        camera, baseline = rectifier.camera, rectifier.baseline
        self._rectifier = rectifier
        self.stereo = StereoDepth(config.stereo, camera, baseline, rectifier.path)
        self._network: NetworkDepth | None = None
        if config.onnx.path is not None:
            self._network = NetworkDepth(config, self.stereo, camera, baseline)
        self._matches = MatchWatch()
        self._was_sound = True  # the last matches gave valid depth
        self._last: Measured | None = None  # of the last frame that was not handed on

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what is wrong with the eyes, the rig and the network. May be read from any thread."""
        problem = "" if self._network is None else self._network.problem
        failed = (Finding("network_failed", problem),) if problem else ()
        declared = (_DECLARED,) if self.scale_is_declared else ()
        return (*self._matches.findings, *self.stereo.findings, *failed, *declared)

    @property
    def scale_is_declared(self) -> bool:
        """True: all depth is right only up to an unknown factor. May be read from any thread."""
        return self._network is not None and self._network.is_declared

    @property
    def eyes_are_late(self) -> bool:
        """True: when the eyes were matched last, one showed another moment than the other."""
        return self._matches.is_late

    def __call__(
        self,
        frame: StereoFrame,
        pair: RectifiedPair,
        tissue: Bool,
        still: bool = False,
        has_time: bool = True,
        no_stereo: str = "",
    ) -> Measured:
        """Return the depth of a frame where it shows `tissue` [H, W].

        Args:
            still: nothing has moved: what was measured before holds.
            has_time: there is time to compute it; the session's own depth needs none.
            no_stereo: why the eyes are not to be matched; empty: they are.
        """
        self._matches.see(pair.t_capture_ns, pyramids(pair)[0])
        if still and self._last is not None and self._last.depth.any():
            self.stereo.rows.stay()
            return self._last.handed_on(tissue)
        self._last = self._measured_now(frame, pair, tissue, has_time, no_stereo)
        return self._last

    def _measured_now(
        self, frame: StereoFrame, pair: RectifiedPair, tissue: Bool, has_time: bool, no_stereo: str
    ) -> Measured:
        takes_time = frame.depth is None or self._network is not None
        if takes_time and not has_time:
            return Measured.nothing(tissue.shape, "no time", hurried=True)
        was_sound, self._was_sound = self._was_sound, True
        if no_stereo and frame.depth is None and pair.right is not None:
            return Measured.nothing(tissue.shape, no_stereo)
        measure = cache(partial(self._judged, frame, pair, tissue))
        network, found, skipped = self._network, None, {}
        can = frame.depth is not None or pair.right is not None
        # A monocular network is not fitted to matches that give no valid depth: it waits for valid ones.
        if network is not None and not (can and network.measures and measure().skipped):
            found = network(pair, tissue, lambda: measure().depth if can else None)
            if network.problem:
                skipped["network"] = network.problem
        known = Measured(*found) if found else measure()
        found_out = was_sound and not self._was_sound
        return known._replace(skipped={**known.skipped, **skipped}, found_out=found_out)

    def _judged(self, frame: StereoFrame, pair: RectifiedPair, tissue: Bool) -> Measured:
        """Depth without the network; nothing if the eyes were matched and that gave no valid depth."""
        before = self.stereo.rows.newest
        depth, confidence = self._without_network(frame, pair, tissue)
        rows = self.stereo.rows.newest
        if rows is not None and rows is not before:  # the eyes were matched
            unsound = self._unsound(pair.t_capture_ns, rows, depth, tissue)
            self._was_sound = not unsound
            if unsound:
                return Measured.nothing(tissue.shape, unsound)
        return Measured(depth, confidence)

    def _unsound(self, stamp_ns: int, rows: RowErrors, depth: F32, tissue: Bool) -> str:
        """Why the matched depth is not valid; empty: it is."""
        why = self._matches(stamp_ns, rows)
        if self._matches.is_late:
            self.stereo.rows.withdraw()
        too_few = np.count_nonzero(depth) < LEAST_MATCHED * np.count_nonzero(tissue)
        return TOO_FEW if too_few else why

    def _without_network(self, frame: StereoFrame, pair: RectifiedPair, tissue: Bool) -> tuple[F32, F32]:
        """The session's own depth, fully trusted, or else stereo; all unknown for one camera alone."""
        if frame.depth is not None:
            given = self._rectifier.depth(frame.depth)
            known = tissue & (given > 0) & (given < FARTHEST)
            return np.where(known, given, np.float32(0)), known.astype(np.float32)
        if pair.right is None:
            return np.zeros(tissue.shape, np.float32), np.zeros(tissue.shape, np.float32)
        return self.stereo(pair, tissue)
