"""The interface of camera localisation, and its simplest form: given poses, or a camera that stands still."""

from typing import Protocol

import numpy as np

from sags_node.mapping.motion import Drawn, Tracks
from sags_node.types import F64, Observation, RenderedView


class Localizer(Protocol):
    """Says where the camera is, frame by frame.

    Attributes:
        lost: why the camera is lost; None: it is not.
        unsure: why the last image did not determine the pose; empty: it did, or it was not used.
        pose: `T_world_cam` [4, 4] of the last frame.
        by_picture: the pose is estimated from the images, so that it is no evidence beside them.
    """

    lost: str | None
    unsure: str
    pose: F64
    by_picture: bool

    def guess(self, given: F64 | None) -> F64 | None:
        """The expected pose of a frame, before its image is used; None: the camera stands still.

        Args:
            given: the pose that the session gives for the frame.
        """

    def locate(self, observation: Observation, last: Drawn | None, tracks: Tracks | None) -> Tracks | None:
        """Find the pose of a frame whose camera has the guessed pose, or set `lost`.

        Args:
            last: the frame before, and `tracks` from it to this one; None: there is no model yet.

        Returns:
            Where the Gaussians are found in it.
        """

    def learn(self, observation: Observation, view: RenderedView) -> None:
        """Learn from a frame that was taken in."""


class GivenCamera:
    """A `Localizer` that takes the poses of the session, if it `follows` them, and is never lost."""

    lost: str | None = None
    unsure = ""
    by_picture = False

    def __init__(self, follows: bool) -> None:
        self._follows = follows
        self.pose: F64 = np.eye(4)

    def guess(self, given: F64 | None) -> F64 | None:
        """Return what is given, or None."""
        return given if self._follows else None

    def locate(self, observation: Observation, last: Drawn | None, tracks: Tracks | None) -> Tracks | None:
        """Take the pose as it is."""
        self.pose = observation.camera.T_world_cam
        return tracks

    def learn(self, observation: Observation, view: RenderedView) -> None:
        """Do nothing: poses are given."""
