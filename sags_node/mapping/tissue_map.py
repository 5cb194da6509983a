"""The map: the tissue's Gaussians, how they deform, and the light that their colours show."""

from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from sags_node.mapping import initialise
from sags_node.mapping.motion_field import MotionField
from sags_node.model.deformation import NodeDeformation, nearest_nodes
from sags_node.model.gaussians import GaussianModel
from sags_node.model.light import is_near, light_gain
from sags_node.types import F32, F64, I64, Camera, Gaussians, Observation


@dataclass(frozen=True, slots=True)
class Learnt:
    """A copy of the map, to go back to."""

    model: GaussianModel
    deformation: NodeDeformation | None
    lamp: F64 | None


class TissueMap:
    """What the mapper refines, and what a pose is found against.

    Attributes:
        model: the Gaussians, where they are now.
        deformation: the nodes that move them; None: there is no tissue yet.
        motion: what is remembered of how they moved (`mapping.motion_field`); None: nothing is.
        lamp: `T_world_cam` [4, 4] of the scope whose light the colours show.
        restarts: how often a new map was begun because the old one did not fit any more.
    """

    def __init__(self, max_gaussians: int, field: bool = False) -> None:
        """
        Args:
            field: remember motion, for hidden tissue and to predict.
        """
        self.model = GaussianModel(max_gaussians)
        self.deformation: NodeDeformation | None = None
        self.motion = MotionField() if field else None
        self.lamp: F64 | None = None
        self.restarts = 0

    @property
    def nodes(self) -> NodeDeformation:
        """The deformation of a map that has tissue."""
        assert self.deformation is not None
        return self.deformation

    def begin(self, observation: Observation, limit: int, nodes: int, smoothing: bool = True) -> F32:
        """Make the first model of a map from a frame; returns the depths of its Gaussians [N] m.

        Args:
            limit: the most Gaussians that the map may have.
            nodes: how many move them.
            smoothing: give them the 3D filter.
        """
        pixels, depths, errors, spacing = initialise.first_pixels(
            observation, int(initialise.INITIAL_SHARE * limit)
        )
        rows = initialise.insert(self.model, observation, pixels, depths, errors, spacing, smoothing)
        self.deformation = NodeDeformation(self.model.means, nodes)
        self.deformation.attach(self.model, rows)
        self.lamp = observation.camera.T_world_cam
        return depths

    def restart(self) -> None:
        """Forget the tissue; the next frame, or this one if it is being taken in, makes a new map."""
        self.model.clear()
        self.deformation = None
        self._forget_motion()
        self.restarts += 1

    def remember_motion(self) -> None:
        """Remember motion from now on. Any thread may call this."""
        if self.motion is None:
            self.motion = MotionField()

    def learnt(self) -> Learnt:
        """Copy what is known now."""
        return Learnt(*deepcopy((self.model, self.deformation)), self.lamp)

    def go_back(self, learnt: Learnt) -> None:
        """Restore `learnt`, and forget what was learnt since."""
        learnt.model.never_reuse(self.model)
        self.model, self.deformation, self.lamp = learnt.model, learnt.deformation, learnt.lamp
        self._forget_motion()

    def relight(self, camera: Camera) -> Gaussians:
        """The Gaussians as the scope's light shows them from `camera`; views, for drawing now."""
        gaussians, lamp = self.model.gaussians(), self.lamp
        if lamp is None or self.deformation is None or np.array_equal(lamp, camera.T_world_cam):
            return gaussians
        model, normals = self.model, self.deformation.normals(lamp[:3, 3])
        gain = light_gain(
            model.means, normals, model.node_index, model.node_weight, lamp, camera.T_world_cam
        )[:, None]
        return replace(gaussians, colors=model.colors * gain, slopes=model.slopes * gain)

    def move_light(self, camera: Camera) -> None:
        """Change the colours to those that the scope's light gives from where it is now."""
        if self.lamp is None or not is_near(self.lamp, camera.T_world_cam):
            lit = self.relight(camera)
            assert lit.slopes is not None
            self.model.colors[:], self.model.slopes[:] = lit.colors, lit.slopes
            self.lamp = camera.T_world_cam

    def away(self, rows: I64) -> F32:
        """The displacement [K, 3] m of the Gaussians in `rows` from where they rest."""
        if self.deformation is None:
            return np.zeros((len(rows), 3), np.float32)
        return self.deformation.away(self.model.node_index[rows], self.model.node_weight[rows])

    def displacement_at(self, points: F32) -> F32:
        """The displacement [K, 3] m of the tissue now at places [K, 3] from where it rests."""
        if self.deformation is None:
            return np.zeros_like(points)
        index, weight, _ = nearest_nodes(points, self.deformation.nodes)
        return self.deformation.away(index, weight)

    def settle(self, share: float) -> None:
        """Move the places where the tissue rests a share of the way to where it is now."""
        if self.deformation is not None:
            self.deformation.settle(share)

    def doubt(self, error: float) -> None:
        """Raise the predicted depth error of all Gaussians by `error` (m), until depth is measured again."""
        self.model.depth_errors[:] = np.minimum(
            self.model.depth_errors + np.float32(error), initialise.LARGEST_ERROR
        )

    def _forget_motion(self) -> None:
        if self.motion is not None:
            self.motion.forget()
