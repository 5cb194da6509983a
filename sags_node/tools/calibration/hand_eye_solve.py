"""Hand-eye calibration from views of a board that lies still, with the offset of the two clocks.

First the rotations alone (Park and Martin, T-RA 1994), for every possible offset: the one at which those of
the robot and of the camera agree best is taken. Then the camera on the hand, the board in the base, and the
offset together, by the reprojection errors of all corners in both eyes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product

import cv2
import numpy as np

from sags_node.errors import SagsError
from sags_node.geometry import invert, rigid
from sags_node.rig.hand_eye import HandEye
from sags_node.sources.pose_track import NoPoseError
from sags_node.tools.calibration.boards import StereoView
from sags_node.types import F32, F64, I64, StereoRig

PoseAt = Callable[[int], F64]  # the robot's pose [4, 4] at its own time, ns; NoPoseError: not known
KnownPose = Callable[[int], F64 | None]  # the same; None: not known

FEWEST_VIEWS = 10
LARGEST_OFFSET_NS = 500_000_000
OFFSET_STEP_NS = 10_000_000
MOST_PAIRS = 400  # of views, whose relative turns are compared
# Of the numeric derivative: rad and m for two poses, and s for the offset (motion is linear between poses).
STEPS = np.array([1e-6] * 12 + [1e-3])
SCALED = np.append(STEPS, 1e-4)  # and one for the scale of the robot's translations
LARGEST_SCALE = 0.02  # robots err by less, and a board that was printed to fit the page by more
BETTER = 0.95  # ratio of the residuals' spreads: a gain that large is not by chance
ROUNDS = 30  # iterations of least squares, at most
WEIGHINGS = 2  # times that views are weighted; the linear solution's error counts as the robot's at first
STILL = np.zeros(6)  # no slip
SIZES = (0.0, *np.geomspace(1e-6, 3e-2, 19))  # rad or m: the sizes of the robot's error that are tried
UNSURE = (0.005, np.radians(1.0))  # m, rad: a solution with larger standard deviations is refused
LEAST_TURN = np.radians(0.5)  # rad, root mean square: a board's rotation is measured to a tenth of it
_TURN = "turn the scope about two different axes, by 20 degrees and more"
LARGEST_ERROR = 5.0  # px: beyond it the poses are not those of this camera


@dataclass(frozen=True, slots=True)
class HandEyeSolution:
    """The calibration, and what is known of its quality."""

    hand_eye: HandEye
    errors: F64  # [V] px, root mean square of each view, both eyes
    names: list[str]  # of the views used
    position_error: float  # m, standard deviation of the camera's place on the hand
    rotation_error: float  # rad
    offset_error_ns: float


def solve_hand_eye(
    views: Sequence[StereoView], stamps: Sequence[int], points: F32, rig: StereoRig, pose_at: PoseAt
) -> HandEyeSolution:
    """Find how the left raw camera sits on the hand.

    Args:
        views: of one board that lies still.
        stamps: when each was taken, by the images' clock, ns.
        points: [N, 3] m, the board's corners by id.

    Raises:
        SagsError: there are too few views with poses, the scope was not turned enough, or nothing fits.
    """
    known_at = cache(partial(_known_pose, pose_at))  # steps that leave the offset ask again
    boards = np.stack([_board_pose(view, points, rig) for view in views])
    offset, most = _coarse_offset(boards, stamps, known_at)
    problems = [_problem(pose_at, stamp + (offset or 0)) for stamp in stamps]
    known = [i for i, problem in enumerate(problems) if problem is None]
    if offset is None or len(known) < FEWEST_VIEWS:
        raise _too_few(views, problems, len(known) if offset is not None else most)
    views, boards, stamps = [views[i] for i in known], boards[known], [stamps[i] for i in known]
    hands = np.stack([pose_at(stamp + offset) for stamp in stamps])
    _turned_enough(_turns(hands, boards)[1])
    X = _linear(hands, boards)
    Z = hands[0] @ X @ boards[0]
    residuals = _Residuals(views, stamps, points, rig, known_at, X, Z, offset)
    parameters = np.zeros(len(STEPS))
    for _ in range(WEIGHINGS):
        residuals = replace(residuals, weights=_weights(residuals, parameters))
        parameters, covariance, spread = _least_squares(residuals, STEPS)
    X, _, offset = residuals.unpacked(parameters)
    corners = residuals.of_corners(parameters)
    errors = np.array([np.sqrt(np.mean(np.sum(part.reshape(-1, 2) ** 2, 1))) for part in corners])
    if np.sqrt(np.mean(errors**2)) > LARGEST_ERROR:
        raise SagsError(
            f"the poses fit the images only to {np.sqrt(np.mean(errors**2)):.1f} px: the board must lie "
            "still, the poses must be of what carries this camera, and the rig must fit the scope"
        )
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0)) * spread
    turn, place, clock = np.linalg.norm(deviations[:3]), np.linalg.norm(deviations[3:6]), deviations[12]
    if not (place < UNSURE[0] and turn < UNSURE[1]):
        raise SagsError(
            f"the motion does not tell where the camera sits (to {place * 1e3:.1f} mm, "
            f"{np.degrees(turn):.2f} degrees): {_TURN}"
        )
    _check_scale(residuals)
    names = [view.name for view in views]
    return HandEyeSolution(HandEye(X, offset), errors, names, float(place), float(turn), float(clock * 1e9))


def _needed(views: int) -> int:
    """The number of views that must have a pose: with few, a wrong offset may seem to agree."""
    return max(FEWEST_VIEWS, -(-views // 2))


def _too_few(views: Sequence[StereoView], problems: Sequence[str | None], count: int) -> SagsError:
    """The error that too few views have a pose; it says why for the middle one of those without."""
    told = [(view.name, why) for view, why in zip(views, problems, strict=True) if why is not None]
    fix = "; give a larger --views, or record for longer"
    if told:
        fix = ". Frame {}: {}".format(*told[len(told) // 2])
    return SagsError(
        f"{count} of {len(views)} views of the board have a pose of the robot; {_needed(len(views))} are "
        f"needed, 60 are good{fix}"
    )


def _turned_enough(turns: F64) -> None:
    """Check that rotations [P, 3] go about two axes: with one, the camera's place along it is unknown."""
    second = np.linalg.svd(turns, compute_uv=False)[1] / np.sqrt(len(turns))
    if second < LEAST_TURN:
        raise SagsError(
            f"the scope is turned by {np.degrees(second):.2f} degrees about its second axis, which does not "
            f"tell where the camera sits: {_TURN}"
        )


def _check_scale(residuals: _Residuals) -> None:
    """
    Raises:
        SagsError: all fits clearly better with the robot's translations scaled. Where the scope only turns
            about one point, this cannot be seen.
    """
    parameters = _least_squares(residuals, SCALED)[0]
    if abs(parameters[-1]) <= LARGEST_SCALE:
        return
    # What the scale explains was counted as the robot's error: weight the views anew.
    residuals = replace(residuals, weights=_weights(residuals, parameters))
    (parameters, _, scaled), (_, _, spread) = (_least_squares(residuals, steps) for steps in (SCALED, STEPS))
    if abs(parameters[-1]) > LARGEST_SCALE and scaled < BETTER * spread:
        raise SagsError(
            f"by the images the scope moved {1 + parameters[-1]:.3f} times as far as the robot says: "
            "measure the board's squares (--square-mm), also of the stereo calibration, and check the "
            "robot's unit"
        )


def _known_pose(pose_at: PoseAt, t_ns: int) -> F64 | None:
    try:
        return pose_at(t_ns)
    except NoPoseError:
        return None


def _problem(pose_at: PoseAt, t_ns: int) -> str | None:
    """Why the pose at a time is unknown, or two steps of the search beside it; None: it is known."""
    reach = 2 * OFFSET_STEP_NS
    try:
        for step in (0, -reach, reach):
            pose_at(t_ns + step)
    except NoPoseError as error:
        return error.finding.text
    return None


def _board_pose(view: StereoView, points: F32, rig: StereoRig) -> F64:
    """Board to left raw camera [4, 4] m."""
    eye = rig.left
    _, turn, place = cv2.solvePnP(
        points[view.ids], view.left, eye.K, eye.distortion, flags=cv2.SOLVEPNP_ITERATIVE
    )
    return _rigid(np.concatenate([turn.ravel(), place.ravel()]))


def _coarse_offset(boards: F64, stamps: Sequence[int], pose_at: KnownPose) -> tuple[int | None, int]:
    """The offset at which the rotations of robot and camera agree best, ns, and the largest number of views
    that have a pose at any offset. None: at no offset enough views have one."""
    best, least, most = None, np.inf, 0
    for offset in range(-LARGEST_OFFSET_NS, LARGEST_OFFSET_NS + 1, OFFSET_STEP_NS):
        poses = {i: pose for i, stamp in enumerate(stamps) if (pose := pose_at(stamp + offset)) is not None}
        known = list(poses)
        most = max(most, len(known))
        if len(known) < _needed(len(stamps)):
            continue
        robot, camera = _turns(np.stack(list(poses.values())), boards[known])
        R = _rotation(robot, camera)
        residual = float(np.mean(np.sum((robot - camera @ R.T) ** 2, 1)))
        if residual < least:
            best, least = offset, residual
    return best, most


def _pairs(count: int) -> tuple[I64, I64]:
    first, second = np.triu_indices(count, 1)
    step = max(1, len(first) // MOST_PAIRS)
    return first[::step], second[::step]


def _turns(hands: F64, boards: F64) -> tuple[F64, F64]:
    """Rotation vectors [P, 3] from one view to another: of the hand and of the camera, in their own axes."""
    first, second = _pairs(len(hands))
    hand = np.swapaxes(hands[first, :3, :3], 1, 2) @ hands[second, :3, :3]
    camera = boards[first, :3, :3] @ np.swapaxes(boards[second, :3, :3], 1, 2)
    return _logarithms(hand), _logarithms(camera)


def _logarithms(R: F64) -> F64:
    return np.stack([cv2.Rodrigues(one)[0].ravel() for one in R])


def _rotation(robot: F64, camera: F64) -> F64:
    """The rotation [3, 3] that turns the camera's vectors into the robot's (Kabsch)."""
    U, _, Vt = np.linalg.svd(robot.T @ camera)
    sign = np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))])
    rotation: F64 = U @ sign @ Vt
    return rotation


def _linear(hands: F64, boards: F64) -> F64:
    """A first hand-eye transform [4, 4]: A X = X B for the motions A of the hand and B of the camera."""
    first, second = _pairs(len(hands))
    A, B = np.linalg.inv(hands[first]) @ hands[second], boards[first] @ np.linalg.inv(boards[second])
    R = _rotation(*_turns(hands, boards))
    right = B[:, :3, 3] @ R.T - A[:, :3, 3]
    return rigid(R, np.linalg.lstsq((A[:, :3, :3] - np.eye(3)).reshape(-1, 3), right.ravel(), rcond=None)[0])


@dataclass(frozen=True, slots=True)
class _Residuals:
    """The residuals of all views for given parameters, [6 V], in standard deviations.

    Parameters [13]: a small motion of the camera on the hand (turn, place), one of the board, and the
    offset's difference from the first one, s; [14]: also the scale of the robot's translations, less 1.
    """

    views: Sequence[StereoView]
    stamps: Sequence[int]
    points: F32
    rig: StereoRig
    pose_at: KnownPose
    X: F64  # where the search begins: camera to hand, board to base, and the offset, ns
    Z: F64
    offset: int
    weights: Sequence[F64] = ()  # of each view [6, 4 N], see `_weights`

    def unpacked(self, parameters: F64) -> tuple[F64, F64, int]:
        X, Z = self.X @ _rigid(parameters[:6]), self.Z @ _rigid(parameters[6:12])
        return X, Z, self.offset + round(parameters[12] * 1e9)

    def __call__(self, parameters: F64) -> F64:
        parts = self.of_corners(parameters)
        if not parts:  # a pose is unknown at this offset: the search turns back
            return np.full(6 * len(self.views), 1e3)
        return np.concatenate([weight @ part for weight, part in zip(self.weights, parts, strict=True)])

    def of_corners(self, parameters: F64, slip: F64 = STILL) -> list[F64]:
        """The residuals of each view's corners [4 N], px, left eye and right eye; empty: a pose is unknown.

        `slip` [6]: turn and place by which the hand is elsewhere than the robot says, in its own axes.
        """
        X, Z, offset = self.unpacked(parameters)
        eye_base, parts = invert(X) @ invert(_rigid(slip)), []
        for view, stamp in zip(self.views, self.stamps, strict=True):
            hand = self.pose_at(stamp + offset)
            if hand is None:
                return []
            longer = parameters[len(STEPS) :].sum()
            left = eye_base @ invert(rigid(hand[:3, :3], (1 + longer) * hand[:3, 3])) @ Z
            points = self.points[view.ids].astype(np.float64)
            eyes = (
                (self.rig.left, left, view.left),
                (self.rig.right, self.rig.T_right_left @ left, view.right),
            )
            off = [
                cv2.projectPoints(points, T[:3, :3], T[:3, 3], eye.K, eye.distortion)[0].reshape(-1, 2) - seen
                for eye, T, seen in eyes
            ]
            parts.append(np.ravel(off))
        return parts


def _weights(residuals: _Residuals, parameters: F64) -> list[F64]:
    """The matrices [6, 4 N] from each view's corner residuals to six of its hand's pose, of variance 1.

    A hand's pose is off by the noise of the corners, which averages out, and by the robot's own error, which
    all corners of a view share. The robot's error, in rotation and in translation, is that of maximum
    likelihood. Counted as noise of the corners, it would weigh some ten times too little.
    """

    def moved(way: float) -> list[F64]:
        slips = (residuals.of_corners(parameters, slip) for slip in way * np.eye(6))
        return [np.stack(view, 1) for view in zip(*slips, strict=True)]

    seen = residuals.of_corners(parameters)
    J = [(more - less) / 2e-6 for more, less in zip(moved(1e-6), moved(-1e-6), strict=True)]
    back = [np.linalg.pinv(part) for part in J]
    off = np.stack([inverse @ part for inverse, part in zip(back, seen, strict=True)])
    rest = sum(float(np.sum((part - j @ o) ** 2)) for part, j, o in zip(seen, J, off, strict=True))
    noise = rest / sum(len(part) - 6 for part in seen)  # px^2, of a corner
    by_corners = noise * np.stack([inverse @ inverse.T for inverse in back])

    def improbable(sizes: tuple[float, float]) -> float:
        whole = by_corners + np.diag(np.square(np.repeat(sizes, 3)))
        quadratic = np.einsum("vi,vij,vj->", off, np.linalg.inv(whole), off)
        return float(np.linalg.slogdet(whole)[1].sum() + quadratic)

    robot = np.diag(np.square(np.repeat(min(product(SIZES, SIZES), key=improbable), 3)))
    roots = np.linalg.cholesky(np.linalg.inv(by_corners + robot))
    return [root.T @ inverse for root, inverse in zip(roots, back, strict=True)]


def _least_squares(residuals: _Residuals, steps: F64) -> tuple[F64, F64, float]:
    """Levenberg-Marquardt: parameters [P], their covariance at a variance of 1, and the residuals' spread."""
    parameters, damping = np.zeros(len(steps)), 1e-3
    now = residuals(parameters)
    for _ in range(ROUNDS):
        J = np.stack(
            [(residuals(parameters + d) - residuals(parameters - d)) / (2 * d.sum()) for d in np.diag(steps)],
            1,
        )
        normal = J.T @ J
        while damping < 1e9:
            change = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), -J.T @ now)
            then = residuals(parameters + change)
            gain = now @ now - then @ then
            if gain >= 0:
                break
            damping *= 10
        else:
            break
        converged = gain < 1e-6 * (now @ now)
        parameters, now, damping = parameters + change, then, damping * 0.1
        if converged:
            break
    spread = float(np.sqrt(now @ now / max(1, len(now) - len(parameters))))
    return parameters, np.linalg.pinv(normal, rcond=1e-15), spread


def _rigid(parameters: F64) -> F64:
    """The pose [4, 4] of a rotation vector and a translation [6]."""
    return rigid(cv2.Rodrigues(parameters[:3])[0], parameters[3:6])
