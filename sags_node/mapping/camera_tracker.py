"""Where the camera is, frame by frame, against the model's tissue at rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sags_node.geometry import invert
from sags_node.mapping.camera_pose import towards
from sags_node.mapping.keyframes import Keyframes, distance
from sags_node.mapping.motion import Drawn, SurfaceTracker, Tracks
from sags_node.mapping.pose_agreement import Agreement, agreement, small_frame, small_view
from sags_node.mapping.resting_tissue import RestingTissue, correlation
from sags_node.mapping.tissue_map import Learnt, TissueMap
from sags_node.types import F64, Camera, Observation, RenderedView
from sags_node.vision.watch.standing import watched_ns

HOLD = 0.2  # share of the way to the pose against the tissue at rest, per frame: keeps it from drifting
LARGEST_JUMP = 8e-3  # m between frames, as `keyframes.distance` counts: a larger jump must be verified
TRIAL = 6  # frames in which a pose that was found again must agree with image and depth
TRIED = 3  # poses by the keyframes that are tried per frame
LOOK_NS = 150_000_000  # ns between checks of a frame against the keyframes
DISAGREEING = 5  # failed checks in a row, after which the pose that was found again counts as wrong
PROBATION_NS = 3_000_000_000  # ns after a pose was found again: no new keyframes, learning can be undone
GIVE_UP_NS = 3_000_000_000  # ns of lit frames that show one other scene: then a new model is begun
SAME_SCENE = 0.7  # correlation of a lit frame with the one before, both shrunk
LIT = 4.0  # grey levels, standard deviation over the tissue: a covered or dark image has less


class CameraTracker:
    """Estimates the camera's pose from where the model's Gaussians are found in each frame.

    Images cannot tell a camera that moves from tissue that moves as one. Here the motion that most of the
    tissue shares is the camera's: every Gaussian has a place at rest, which follows it slowly, and the camera
    is where most of them are seen nearest to that. What moves otherwise, as pulled tissue does, counts
    little.

    A frame in which too few are found, or in which what is found looks otherwise, leaves the camera lost.
    Then the last pose stays; it and those by the keyframes are tried in every frame. The one at which the
    model agrees best with image and measured depth is on trial: it must go on to agree for `TRIAL` frames
    before anything is learnt or shown again. Later the keyframes from before are its witnesses: if they
    disagree for long, the camera is lost again and what was learnt since is undone. When lit frames have
    shown one other scene for `GIVE_UP_NS`, a new model is begun at the last pose.

    Attributes: see `Localizer`.
    """

    unsure = ""
    by_picture = True

    def __init__(
        self, tissue_map: TissueMap, surface: SurfaceTracker, draw: Callable[[Camera], RenderedView]
    ) -> None:
        """
        Args:
            surface: finds the map's Gaussians in a frame.
            draw: shows the map as it is now.
        """
        self.lost: str | None = None
        self._map = tissue_map
        self._surface = surface
        self._draw = draw
        self._tissue = RestingTissue(tissue_map)
        self.pose: F64 = np.eye(4)  # of the last frame that was tracked
        self._motion: F64 = np.eye(4)  # of the camera in its own axes, from the frame before to the last one
        self._keyframes = Keyframes()
        self._restarts = tissue_map.restarts
        self._trial: _Candidate | None = None
        self._passed = 0  # frames that the trial's pose has agreed with
        self._unknown: Observation | None = None  # the last frame that showed something else
        self._unknown_ns = 0  # ns for which frames have shown it
        self._found_ns: int | None = None  # when the camera was found again, during the probation
        self._before: Learnt | None = None  # the map as it was then
        self._looked_ns = 0
        self._disagreed = 0  # looks in a row

    def guess(self, given: F64 | None) -> F64 | None:
        """The expected pose of a frame: that of the last one, whatever pose the session gives."""
        return self.pose

    def locate(self, observation: Observation, last: Drawn | None, tracks: Tracks | None) -> Tracks | None:
        """Find the pose of a frame, whatever its camera says, or set `lost`. Returns `tracks`, or those from
        where the camera was found again; None: it is lost, or there is no model yet."""
        if self._map.model.count == 0:
            self.lost, self._motion = None, np.eye(4)
            return None  # the model begins where the camera was last
        if self.lost is not None:
            found = self._find_again(observation)
            if found is None:
                self._begin_anew(observation)
            return found
        fit = self._follow(observation, last, tracks)
        if isinstance(fit, str):
            self.lost, self._motion = fit, np.eye(4)
            self._trial, self._passed, self._unknown = None, 0, None
            return None
        self.pose, self._motion = fit, invert(self.pose) @ fit
        return tracks

    def _follow(self, observation: Observation, last: Drawn | None, tracks: Tracks | None) -> F64 | str:
        """The pose of a frame that follows one that was tracked, or why the camera is lost."""
        if last is None or tracks is None:
            return "hardly any tissue in view"
        start = self.pose @ self._motion
        fit = self._tissue.fit(observation, last, tracks, start)
        if isinstance(fit, str):
            return fit
        pose, camera = towards(fit.near, fit.at_rest, HOLD), observation.camera
        moved = replace(camera, T_world_cam=pose)
        if distance(replace(camera, T_world_cam=start), moved) > LARGEST_JUMP:
            return "the camera jumped"
        if self._is_found_out(replace(observation, camera=moved)):
            return "the camera was taken to be elsewhere"
        return pose

    def _is_found_out(self, observation: Observation) -> bool:
        """Tell whether the keyframes have disagreed for long; then what was learnt is undone."""
        now = observation.t_capture_ns
        if 0 <= now - self._looked_ns < LOOK_NS:
            return False
        self._looked_ns = now
        found = self._keyframes.agree(observation)
        contradicted = found is not None and found.is_contradiction
        self._disagreed = self._disagreed + 1 if contradicted else 0
        if self._disagreed < DISAGREEING:
            return False
        self._disagreed = 0
        if self._before is not None:
            self._map.go_back(self._before)
        self._found_ns = self._before = None
        return True

    def _find_again(self, observation: Observation) -> Tracks | None:
        """Search for the camera; return tracks once the pose that was found is verified, else None."""
        tried = None if self._trial is None else self._tried(observation, self._trial.drawn)
        if tried is None or tried.agreement.problem:
            self._passed = 0
            tried = self._best_candidate(observation)
        self._trial = tried
        if tried is None:
            return None
        self._passed += tried.agreement.near is not None  # without depth nothing is verified
        self.lost = f"verifying where it is, {self._passed} of {TRIAL} frames"
        if self._passed < TRIAL:
            return None
        self.pose, self._motion = tried.T_world_rest, np.eye(4)
        self.lost = None
        self._found_ns, self._before = observation.t_capture_ns, self._map.learnt()
        self._looked_ns, self._disagreed = observation.t_capture_ns, 0
        return self._surface.track(self._map.model.means, tried.drawn, observation)

    def _begin_anew(self, observation: Observation) -> None:
        """Begin a new map where something else has been shown, lit and steadily, for long."""
        if self._trial is not None:
            return
        before, self._unknown = self._unknown, observation if _is_lit(observation) else None
        if before is None or self._unknown is None or not _is_same_scene(before, observation):
            self._unknown_ns = 0
            return
        self._unknown_ns += watched_ns(before.t_capture_ns, observation.t_capture_ns)
        if self._unknown_ns >= GIVE_UP_NS:
            self._map.restart()
            self.lost = None

    def learn(self, observation: Observation, view: RenderedView) -> None:
        """Learn from a frame that was tracked and taken in; `view` is the model drawn for it."""
        if self._map.restarts != self._restarts:
            self._restarts = self._map.restarts
            self._keyframes.clear()
            self._found_ns = self._before = None
        self._tissue.learn(observation)
        if self._found_ns is not None and not 0 <= observation.t_capture_ns - self._found_ns < PROBATION_NS:
            self._found_ns = self._before = None
        if self._found_ns is None:
            self._keyframes.offer(observation, view)

    def _best_candidate(self, observation: Observation) -> _Candidate | None:
        """Find the pose at which the model agrees best with a frame, near the last one or the keyframes'."""
        starts = [self.pose, *self._keyframes.find(observation)[:TRIED]]
        tried = [self._tried(observation, self._seen_from(observation, start)) for start in starts]
        found = [each for each in tried if each is not None]
        best = max(found, key=lambda each: each.agreement.rank, default=None)
        if best is not None and best.agreement.problem:
            self.lost = best.agreement.problem
            return None
        return best

    def _tried(self, observation: Observation, before: Drawn) -> _Candidate | None:
        """Fit the camera's pose, starting from the pose that `before` is drawn from; None: it is not near."""
        tracks = self._surface.track(self._map.model.means, before, observation)
        fit = self._tissue.fit(observation, before, tracks, before.view.camera.T_world_cam)
        if isinstance(fit, str):
            self.lost = fit
            return None
        now = self._seen_from(observation, fit.near)
        frame = small_frame(observation)
        agrees = agreement(small_view(now.view), frame, observation.camera, observation.baseline)
        return _Candidate(now, agrees, fit.at_rest)

    def _seen_from(self, observation: Observation, pose: F64) -> Drawn:
        """The model drawn from a pose, in the form of a frame that was taken there."""
        view = self._draw(replace(observation.camera, T_world_cam=pose))
        gray = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
        shown = replace(observation, camera=view.camera, gray=gray, tissue=view.alpha > 0.5)
        return Drawn(shown, view)


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A pose that may be the camera's: the model drawn from there, and how well a frame agrees with it."""

    drawn: Drawn
    agreement: Agreement
    T_world_rest: F64  # [4, 4] the pose against the tissue at rest: the tissue may have moved since


def _is_lit(observation: Observation) -> bool:
    shown = observation.gray[::8, ::8][observation.tissue[::8, ::8]]
    return bool(shown.size > 0 and shown.std() > LIT)


def _is_same_scene(before: Observation, now: Observation) -> bool:
    both = before.tissue[::8, ::8] & now.tissue[::8, ::8]
    pictures = (
        cv2.resize(each.gray, both.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)[both]
        for each in (before, now)
    )
    return bool(both.any()) and correlation(*pictures) > SAME_SCENE
