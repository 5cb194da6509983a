"""Given camera poses, put right by the image where they are off."""

import numpy as np

from sags_node.geometry import invert
from sags_node.mapping.camera_pose import towards
from sags_node.mapping.motion import Drawn, Tracks
from sags_node.mapping.resting_tissue import RestingTissue
from sags_node.mapping.tissue_map import TissueMap
from sags_node.types import F64, Observation, RenderedView
from sags_node.vision.watch.standing import watched_ns

SECONDS = 10.0  # s over which the correction follows the image: longer than a breath


class PoseRefiner:
    """Corrects the poses of a robot by where the model's tissue at rest is seen.

    A robot knows well how the scope moves within a second, and less well where it is: joints and trocar give
    way, and the error grows slowly. Tissue breathes quickly and comes back. So the camera moves as it is
    given, and a correction of its place follows the image more slowly than tissue breathes: what is quick
    is the tissue's motion. Where the image cannot tell, the correction stays.

    Attributes: see `Localizer`. It is never `lost`.
    """

    lost: str | None = None
    by_picture = True

    def __init__(self, tissue_map: TissueMap) -> None:
        self.unsure = ""
        self._tissue = RestingTissue(tissue_map)
        self._correction: F64 = np.eye(4)  # of given poses, from the left
        self._given: F64 = np.eye(4)  # pose of the last frame
        self.pose: F64 = np.eye(4)
        self._stamp_ns: int | None = None  # of the last frame

    def guess(self, given: F64 | None) -> F64 | None:
        """The expected pose of a frame: the given one, corrected."""
        if given is None:
            return None
        self._given = given
        return self._correction @ given

    def locate(self, observation: Observation, last: Drawn | None, tracks: Tracks | None) -> Tracks | None:
        """Find the pose of a frame whose camera is as guessed; it is never lost."""
        guess = observation.camera.T_world_cam
        before, self._stamp_ns = self._stamp_ns, observation.t_capture_ns
        self.pose, self.unsure = guess, ""
        if before is None or last is None or tracks is None:
            return tracks
        fit = self._tissue.fit(observation, last, tracks, guess)
        if isinstance(fit, str):
            self.unsure = fit
            return tracks
        seconds = watched_ns(before, self._stamp_ns) * 1e-9
        self.pose = towards(guess, fit.at_rest, seconds / SECONDS)
        self._correction = self.pose @ invert(self._given)
        return tracks

    def learn(self, observation: Observation, view: RenderedView) -> None:
        """Learn from a frame that was taken in."""
        self._tissue.learn(observation)
