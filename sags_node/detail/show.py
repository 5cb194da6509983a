"""What consumers are shown of a view: the drawn model, with the detail of images."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from sags_node.detail.carry import carry, coarse_camera, every_fourth, paste, trace
from sags_node.detail.memory import HiddenSource, hidden_source
from sags_node.detail.motion import SmallDrawings, gaussians_at
from sags_node.detail.seen import SeenFrame
from sags_node.detail.share import Share
from sags_node.engine.rasterizer.views import to_view
from sags_node.mapping.right_eye import coarse_right_eye_mask
from sags_node.model.gaussians import for_right_eye
from sags_node.resizing import resized_image
from sags_node.types import F32, U8, Bool, Camera, Gaussians, Shown, Snapshot

LESSON_EVERY = 4  # views drawn between lessons: what they teach changes slowly, and each costs a small view
ASIDE_EVERY = 12  # views drawn between lessons from the right eye
LOOKED_AT = 4  # px, along both axes, between the pixels that a lesson compares
COMPARED = 8  # px between the pixels at which an image's sharpness is compared with the model's error
AROUND = np.ones((5, 5), np.uint8)  # px of the working size: around hidden tissue, also filled as if hidden
UNSURE = 0.2  # share of hidden tissue's motion that is doubtful, for nobody saw it
ANOTHER_EYE = 0.5  # exponent of the right eye's lesson one baseline aside: no other view has that eye's light
f4 = np.float32


@dataclass(frozen=True, slots=True)
class Lessons:
    """The learnt trust in images. One thread teaches; any may ask."""

    moved: Share = field(default_factory=Share)  # of the expected motion, against no motion
    ahead: Share = field(default_factory=Share)  # of the image carried to the next frame, against the model
    aside: Share = field(default_factory=Share)  # of the left image carried to the right eye, likewise


class Detail:
    """Adds detail to views. For one thread."""

    def __init__(self, lessons: Lessons) -> None:
        self._lessons = lessons
        self._small = SmallDrawings()
        self._newest: SeenFrame | None = None  # the newest older frame at the last choice
        self._chosen: SeenFrame | None = None  # the older frame that shows what is hidden
        self._unsure = 0.0  # the doubt for each px that hidden tissue has moved, as in `trace`

    # ---- views -----------------------------------------------------------------------------------------

    def left(
        self, drawn: U8, depth: F32, camera: Camera, now: SeenFrame, older: Sequence[SeenFrame]
    ) -> Shown:
        """Show a frame's left view: what it sees is its own image, what is hidden comes from older ones.

        Args:
            drawn: [H, W, 3] RGB, the model for that eye.
            depth: [h, w] m, the model's depth for that eye, in any size; 0 unknown.
            camera: of that eye, in the size that is shown.
            older: frames that may have seen what is hidden now, the newest first.
        """
        rgb, size = drawn.copy(), (camera.width, camera.height)
        hidden = cv2.dilate(1 - now.tissue, AROUND)
        taken = np.asarray(cv2.resize(255 - 255 * hidden, size, interpolation=cv2.INTER_NEAREST))
        oldest = self._from_memory(rgb, taken, hidden, depth, camera, now, older)
        seen = cv2.blur(now.sure_tissue * np.uint8(255), (5, 5))  # seams over five pixels
        seen = cv2.resize(seen, size, interpolation=cv2.INTER_LINEAR)
        paste(now.picture(), seen, rgb)
        return Shown(rgb, np.maximum(taken, seen), oldest)

    def _from_memory(
        self, rgb: U8, taken: U8, hidden: U8, depth: F32, camera: Camera, now: SeenFrame,
        older: Sequence[SeenFrame],
    ) -> int:  # fmt: skip
        """Carry what an older frame saw to pixels of `hidden` [h, w] where nothing is taken yet. Returns the
        capture time of that frame, or that of `now` if nothing was carried."""
        now_ns = now.t_capture_ns
        small = coarse_camera(camera)
        free = resized_image(255 * hidden, (small.width, small.height))
        if not len(older) or not free.any():
            return now_ns
        wanted = cv2.dilate((free > 0).view(np.uint8), AROUND[:3, :3])  # pixels lie between coarse ones
        there = gaussians_at(now.gaussians, small, wanted)
        source = self._source(there, now, older, rgb)
        if source is None:
            return now_ns
        frame, lent = source.frame, source.frame.lent(float(camera.K[0, 0]), sure=True)
        motion = self._small.motion(there, camera, frame)
        depth = every_fourth(depth, small)
        traced = trace(depth, small, frame, lent, motion, unsure=self._unsure, wanted=wanted)
        carry(rgb, taken, traced, lent, source.gain)
        return frame.t_capture_ns if traced.share.any() else now_ns

    def _source(
        self, hidden: Gaussians, now: SeenFrame, older: Sequence[SeenFrame], drawn: U8
    ) -> HiddenSource | None:
        """The `hidden_source`, chosen anew only with a new frame in the memory or if the last choice fails:
        looking into all frames takes as long as drawing the motion."""
        source = None
        if self._newest is older[0] and self._chosen is not None:
            source = hidden_source(hidden, now.t_capture_ns, [self._chosen])
        if source is None:
            source = hidden_source(hidden, now.t_capture_ns, older)
            self._unsure = UNSURE * _loss_by_pixel(now, drawn)
        self._newest, self._chosen = older[0], None if source is None else source.frame
        return source

    def view(
        self,
        drawn: U8,
        depth: F32,
        camera: Camera,
        gaussians: Gaussians,
        now: SeenFrame,
        baseline: float,
        frames_ahead: float = 0.0,
        tint: F32 | None = None,
    ) -> Shown:
        """Show a view of the model from anywhere, at a frame's moment or after it.

        Args:
            drawn: [H, W, 3] RGB, the model for that camera.
            depth: as for `left`.
            camera: in the size that is shown.
            gaussians: those of the frame, at its moment or moved to a later one.
            now: the frame.
            baseline: m between the eyes.
            frames_ahead: how long the view is after the frame, in frame intervals.
            tint: from `tint`: the colours that this view has and the left image has not.
        """
        rgb, taken = drawn.copy(), _nothing(camera)
        aside = float(np.linalg.norm(camera.T_world_cam[:3, 3] - now.camera.T_world_cam[:3, 3])) / baseline
        lessons = self._lessons
        tiles = lessons.aside.tiles() ** f4(ANOTHER_EYE * np.sqrt(aside))
        if frames_ahead > 0:
            ahead = lessons.ahead.tiles() ** f4(frames_ahead)
            tiles = cv2.resize(tiles, ahead.shape[::-1], interpolation=cv2.INTER_LINEAR) * ahead
        motion = self._small.motion(gaussians, camera, now, lessons.moved.of_gaussians(now))
        lent, small = now.lent(float(camera.K[0, 0])), coarse_camera(camera)
        traced = trace(every_fourth(depth, small), small, now, lent, motion, tiles, steady=True)
        carry(rgb, taken, traced, lent, tint=tint)
        return Shown(rgb, taken, now.oldest_ns)

    def tint(self, snapshot: Snapshot, gaussians: Gaussians, camera: Camera) -> F32 | None:
        """Draw how much brighter the right eye sees the tissue, [m, n, 3]; None: not known.

        Args:
            gaussians: those of the snapshot, at its moment or moved to a later one.
        """
        more = snapshot.right_colors
        return None if more is None else self._small(gaussians, more, camera)[:3].transpose(1, 2, 0)

    # ---- lessons ---------------------------------------------------------------------------------------

    def learn_ahead(self, before: SeenFrame, expected: Gaussians, now: SeenFrame) -> None:
        """Learn from a frame how well the one before it would have been carried to it.

        Args:
            expected: the Gaussians of the frame before, moved to where they were expected now.
        """
        camera, truth, where = _sampled(now.camera, now.picture(), now.mask)
        drawn, depth = self._drawn(expected, camera)
        lessons = self._lessons

        def carried(trust: F32 | None) -> U8:
            motion = None if trust is None else self._small.motion(expected, camera, before, trust)
            return _carried(drawn, depth, camera, before, motion, steady=True)

        moved = carried(np.ones(len(before.gaussians), f4))
        lessons.moved.learn(carried(None), moved, truth, where)
        lessons.ahead.learn(drawn, carried(lessons.moved.of_gaussians(before)), truth, where)

    def learn_aside(self, now: SeenFrame, snapshot: Snapshot, right: U8, baseline: float) -> None:
        """Learn from the right eye how well the left image, carried there, shows what another eye sees.

        Args:
            snapshot: of that frame.
            right: [H, W, 3] the right image, as it is published.
            baseline: m.
        """
        where = coarse_right_eye_mask(now.mask, now.depth, float(now.camera.K[0, 0]), baseline)
        camera, truth, where = _sampled(now.camera.moved_right(baseline), right, where)
        drawn, depth = self._drawn(for_right_eye(now.gaussians, snapshot), camera)
        carried = _carried(drawn, depth, camera, now, None, tint=self.tint(snapshot, now.gaussians, camera))
        self._lessons.aside.learn(drawn, carried, _in_light_of(drawn, truth, where), where)

    def _drawn(self, gaussians: Gaussians, camera: Camera) -> tuple[U8, F32]:
        planes = self._small.rasterizer(camera.width, camera.height).forward(gaussians, camera)
        view = to_view(planes, camera, 0, 0)
        return view.rgb, view.depth


def _nothing(camera: Camera) -> U8:
    return np.zeros((camera.height, camera.width), np.uint8)


def _carried(
    drawn: U8, depth: F32, camera: Camera, source: SeenFrame, motion: F32 | None, steady: bool = False,
    tint: F32 | None = None,
) -> U8:  # fmt: skip
    """A drawn image with all the detail that a source can lend it."""
    rgb, lent, small = drawn.copy(), source.lent(np.inf), coarse_camera(camera)
    traced = trace(every_fourth(depth, small), small, source, lent, motion, steady=steady)
    carry(rgb, _nothing(camera), traced, lent, tint=tint)
    return rgb


def _sampled(camera: Camera, picture: U8, where: Bool) -> tuple[Camera, U8, Bool]:
    """Every `LOOKED_AT` th pixel of an image [H, W, 3], what `where` [h, w] says there, and the camera that
    sees just these pixels."""
    height, width = picture.shape[:2]
    first = LOOKED_AT // 2
    truth = picture[first::LOOKED_AT, first::LOOKED_AT]
    K = camera.K.copy()
    K[0] *= width / camera.width
    K[1] *= height / camera.height
    K[:2, 2] += 0.5 * np.array([width / camera.width, height / camera.height]) - 0.5 - first
    K[:2] /= LOOKED_AT
    rows = np.minimum(
        ((np.arange(truth.shape[0]) * LOOKED_AT + first) * len(where)) // height, len(where) - 1
    )
    columns = ((np.arange(truth.shape[1]) * LOOKED_AT + first) * where.shape[1]) // width
    return Camera(truth.shape[1], truth.shape[0], K, camera.T_world_cam), truth, where[rows[:, None], columns]


def _loss_by_pixel(frame: SeenFrame, drawn: U8) -> float:
    """The error of an image one pixel out of place over the model's error: RMS difference of neighbouring
    pixels over RMS error of `drawn`, on tissue. Its square is the ratio of what they add to the error."""
    height, width = drawn.shape[:2]
    size = -(-width // COMPARED), -(-height // COMPARED)
    where = cv2.resize(frame.sure_tissue, size, interpolation=cv2.INTER_NEAREST).astype(f4)
    picture = frame.picture()
    seen, beside = picture[::COMPARED, ::COMPARED], picture[::COMPARED, 1::COMPARED]
    beside = np.pad(beside, ((0, 0), (0, size[0] - beside.shape[1]), (0, 0)), mode="edge")
    change, error = (
        float(np.einsum("ijk,ijk,ij->", off, off, where))
        for off in (seen.astype(f4) - other for other in (beside, drawn[::COMPARED, ::COMPARED]))
    )
    return float(np.sqrt(change / max(error, 1.0)))


def _in_light_of(drawn: U8, picture: U8, where: Bool) -> U8:
    """An image with mean and contrast of the drawn one, channel by channel: eyes differ in both."""
    mask = where.view(np.uint8)
    mean, shown_mean = np.array(cv2.mean(picture, mask)[:3]), np.array(cv2.mean(drawn, mask)[:3])
    spread = (picture - mean.astype(f4)) * where[..., None]
    squares = np.einsum("ijk,ijk->k", spread, spread)
    gain = np.einsum("ijk,ijk->k", spread, drawn - shown_mean.astype(f4)) / np.maximum(squares, 1)
    offset = shown_mean - gain * mean
    return np.asarray(cv2.transform(picture, np.column_stack([np.diag(gain), offset])))
