"""What the node knows of every frame of a recording, as files: depth, tracks, drawn images, a data set."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np

from sags_node.errors import SagsError, UsageError
from sags_node.files import check_folder, whole, writing
from sags_node.kernels.threads import configure_threads
from sags_node.media.video_file import VideoFile
from sags_node.messaging import published
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.pipeline.session import Session
from sags_node.tools.export.scene import Advance
from sags_node.types import F32, AnchorStates, FrameResult

DEPTH_UNIT = 1e-5  # m for a count, as `source.reference.depth_unit`
MOST_DEPTH = 65535 * DEPTH_UNIT  # m; 16 bits reach no farther
TRACKS = 64  # points that are followed, on a grid
SEEN = 0.5  # visibility from which on a point counts as seen


class Product(Protocol):
    """Takes one frame after the other. Both methods may raise `OSError`."""

    def add(self, number: int, result: FrameResult, anchors: AnchorStates) -> None:
        """Take a frame; `number`: `StereoFrame.recorded_number`."""

    def finish(self) -> int:
        """Complete the file or folder; return how much is in it."""


class Kind(NamedTuple):
    """What makes a product at a path, from frames of a rate (1/s) and size (px)."""

    make: Callable[[Path, float, tuple[int, int]], Product]
    is_folder: bool = False


def write_played(session: Session, wanted: Mapping[str, Path], advance: Advance) -> list[dict[str, Any]]:
    """Play a recording, every frame in turn, and write what the node knows of each. Frames of the warm-up are
    played, but not written.

    Points to be followed are pinned on a grid, in the first frame after the warm-up that has depth.

    Args:
        session: a recording with `source.pace` step.
        wanted: files, or new folders, by kind (`KINDS`).
        advance: called with what is going on.

    Returns:
        A row for each, as `export.export`.

    Raises:
        SagsError: it cannot be read, or a file cannot be written.
    """
    count, done, rows = session.source.frame_count, 0, []
    with ExitStack() as stack:
        partial = {kind: stack.enter_context(whole(path)) for kind, path in wanted.items()}
        products = {}
        for kind, path in wanted.items():
            with writing(path):
                products[kind] = KINDS[kind].make(partial[kind], session.source.rate, session.published_size)
        for done, (number, result, anchors) in enumerate(_played(session, "render" in wanted), 1):
            for kind, product in products.items():
                with writing(wanted[kind]):
                    product.add(number, result, anchors)
            advance(done, count, "playing")
        if done == 0:
            raise SagsError("no frame was played; check source.start, source.frames and source.warm_up")
        for kind, product in products.items():
            path = wanted[kind]
            with writing(path):
                row = {"kind": kind, "file": str(path), "holds": product.finish()}
                rows.append(row | {"bytes": _size(partial[kind])})
    return rows


def _size(path: Path) -> int:
    """The size of a file, or of all in a folder, bytes."""
    return sum(file.stat().st_size for file in (path, *path.rglob("*")) if file.is_file())


def _played(session: Session, shown: bool) -> Iterator[tuple[int, FrameResult, AnchorStates]]:
    """The arguments of `Product.add` for each frame of the recording but those of its warm-up.

    Args:
        shown: somebody looks at the left view.
    """
    configure_threads(session.config.engine.threads)
    pipeline = Pipeline(session.config, session.rig)
    budget = pipeline.make_budget()
    with session.source as source:
        for frame in source:
            result = pipeline.process(frame, budget, FrameRequest(left=shown))
            if frame.warm_up:
                continue
            if len(pipeline.anchors) == 0 and not result.held:
                _pin(pipeline, result)
                yield frame.recorded_number, result, pipeline.anchors.states()
            else:
                yield frame.recorded_number, result, result.anchors


def _pin(pipeline: Pipeline, result: FrameResult) -> None:
    """Pin points on a grid over the image, but none where there is no tissue or no depth."""
    view = result.views["left"]
    height, width = view.depth.shape
    side = round(TRACKS**0.5)
    for row in range(side):
        for column in range(side):
            u, v = (column + 0.5) * width / side, (row + 0.5) * height / side
            try:
                pipeline.anchors.add_pixel(u, v, result.observation, result.snapshot, view)
            except SagsError:
                continue  # an instrument, or no depth


def depth_of(result: FrameResult) -> F32:
    """The model's depth [H, W], m, as published; 0 where it is not known, and everywhere in a frame that was
    not taken in, as the model is then that of an older frame."""
    depth = published.nearest(result.pair, result.views["left"].depth)
    return np.zeros_like(depth) if result.held else depth


def points_of(result: FrameResult, anchors: AnchorStates) -> tuple[F32, F32]:
    """The world points [TRACKS, 3] (m, NaN: lost, or never pinned) and visibility [TRACKS]; none in a frame
    that was not taken in."""
    points = np.full((TRACKS, 3), np.nan, np.float32)
    visibility = np.zeros(TRACKS, np.float32)
    if result.held:
        return points, visibility
    places = anchors.ids - 1  # they are numbered from 1, and nobody else pins any
    points[places] = anchors.points
    visibility[places] = np.where(np.isfinite(anchors.points[:, 0]), anchors.visibility, 0)
    return points, visibility


class DepthMaps:
    """A 16-bit PNG for each frame, named by its number, as `source.reference.depth` reads them."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._folder = folder
        self._holds = 0

    def add(self, number: int, result: FrameResult, anchors: AnchorStates) -> None:
        depth = depth_of(result)
        counts = np.where(depth < MOST_DEPTH, np.round(depth / DEPTH_UNIT), 0).astype(np.uint16)
        path = self._folder / f"{number:05d}.png"
        path.write_bytes(cv2.imencode(".png", counts)[1].tobytes())
        self._holds += 1

    def finish(self) -> int:
        return self._holds


class Tracks:
    """An npz with `points` [T, P, 3] (m), `visible` [T, P] and `frames` [T], as `source.reference.tracks`."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._points: list[F32] = []
        self._visible: list[F32] = []
        self._frames: list[int] = []

    def add(self, number: int, result: FrameResult, anchors: AnchorStates) -> None:
        points, visibility = points_of(result, anchors)
        self._points.append(points)
        self._visible.append(visibility)
        self._frames.append(number)

    def finish(self) -> int:
        points, seen = np.stack(self._points), np.stack(self._visible) >= SEEN
        with self._file.open("wb") as file:
            np.savez_compressed(file, points=points, visible=seen, frames=np.array(self._frames))
        return int(np.isfinite(points[..., 0]).any(0).sum())  # that were pinned


class Renders:
    """An MP4 of the left view as consumers are shown it, by the frames' stamps; black where nothing is known,
    and in frames that were not taken in."""

    def __init__(self, file: Path, rate: float, size: tuple[int, int]) -> None:
        self._video = VideoFile(file, rate, size)
        self._holds = 0

    def add(self, number: int, result: FrameResult, anchors: AnchorStates) -> None:
        pair, view = result.pair, result.views["left"]
        shown = published.alpha(view, published.size_of(pair))[..., None] > 0
        picture = published.colours(view, published.size_of(pair)) * shown * np.uint8(not result.held)
        self._video.add(picture, pair.t_capture_ns)
        self._holds += 1

    def finish(self) -> int:
        self._video.finish()
        return self._holds


def new_folder(folder: Path) -> None:
    """Make a folder, if there is none.

    Raises:
        UsageError: it holds something.
    """
    check_folder(folder)
    if any(folder.iterdir()):
        raise UsageError(f"{folder} is not empty; choose another folder")


KINDS = {  # by the option of `sags export`; `sags_lab` adds one
    "depth": Kind(lambda folder, rate, size: DepthMaps(folder), is_folder=True),
    "tracks": Kind(lambda file, rate, size: Tracks(file)),
    "render": Kind(Renders),
}
