"""What `sags export` exports: the model at one moment, from a running node, a recording or a fit."""

import json
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import msgspec
import numpy as np

from sags_node.engine.rasterizer.rasterize import Drawer
from sags_node.errors import SagsError, UsageError
from sags_node.kernels.threads import configure_threads
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.content import SLOPE_FIELDS, SPLAT_FIELDS, gaussians_of
from sags_node.messaging.received import ReceivedCameraInfo, ReceivedCloud, ReceivedRos, TopicName
from sags_node.messaging.subscriber import Subscriber
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session
from sags_node.tools.fitting import checkpoint
from sags_node.tools.fitting.clip import ClipFrame, read_clip
from sags_node.tools.fitting.fit import Fit
from sags_node.tools.fitting.settings import FitSettings
from sags_node.types import Camera, Gaussians

log = logging.getLogger(__name__)

SPLATS = TopicName("splats", ReceivedCloud)
INFO = TopicName("left/camera_info", ReceivedCameraInfo)
POSE = TopicName("tf", ReceivedRos)
PATIENCE = 5.0  # s for a fresh frame of the node
WAIT_FOR_REST = 0.2  # s for the other topics of the splats' frame

Advance = Callable[[int, int | None, str], None]  # done, of, what


@dataclass(frozen=True, slots=True)
class Scene:
    """The model at one moment, and the left camera that saw it."""

    gaussians: Gaussians
    camera: Camera
    t_capture_ns: int
    held: str = ""  # as `FrameResult.held`
    antialias: bool = True  # whether it was learnt with the 2D filter
    backend: str = "numba"  # what draws it, as for `make_rasterizer`

    def drawer(self) -> Drawer:
        """What draws it at its camera's size, as it was learnt."""
        return Drawer(self.backend, self.camera.width, self.camera.height, self.antialias)


# ---- a running node --------------------------------------------------------------------------------------


def from_node(node: NodeAddress) -> Scene:
    """Receive the newest fresh frame of a running node.

    Raises:
        SagsError: there is no node, or nothing fresh came from it within `PATIENCE`.
        UsageError: it wants keys.
    """
    names = (SPLATS, INFO, POSE)
    with Subscriber.at(node, names) as subscriber:
        deadline = time.monotonic() + PATIENCE
        newest = None
        while (left := deadline - time.monotonic()) > 0:
            newest = subscriber.wait(SPLATS, left, after=newest)
            frame = newest and subscriber.aligned(names, newest.stamp_ns, WAIT_FOR_REST)
            if frame and all(subscriber.ok(name) for name in names):
                info = frame[INFO]
                if not info.metric:
                    raise SagsError(
                        "the node has no calibration, so its lengths have no unit, and files are in metres; "
                        "calibrate (docs/calibration.md), then set rig"
                    )
                camera = Camera(info.width, info.height, info.K, frame[POSE].pose())
                return Scene(_gaussians(frame[SPLATS]), camera, frame[SPLATS].stamp_ns)
        problem = subscriber.problem(SPLATS) or "the topics of one frame did not come together"
        raise SagsError(f"nothing fresh came from {subscriber.endpoint}: {problem}; is the node running?")


def _gaussians(cloud: ReceivedCloud) -> Gaussians:
    fields = cloud.points.dtype.names or ()
    if not set(SPLAT_FIELDS) - {"confidence", *SLOPE_FIELDS} <= set(fields):
        raise SagsError(f"{cloud.topic} is not what this version reads: {cloud.meta.encoding}")
    return gaussians_of(cloud.points)


# ---- a recording -----------------------------------------------------------------------------------------


def from_session(session: Session, at: float | None, advance: Advance) -> Scene:
    """The online model after a recording was played up to a time, every frame in turn.

    Args:
        session: a recording with `source.pace` step.
        at: seconds after its first frame; None: its last frame that was taken in.
        advance: called with what is going on.

    Raises:
        UsageError: the recording ends before, or the frame there was not taken in.
        SagsError: it cannot be read, or shows nothing to make a model of.
    """
    count = session.source.frame_count
    taken: Scene | None = None
    first_ns = last_ns = 0
    held = ""
    for done, scene in enumerate(scenes_of_session(session)):
        first_ns, last_ns = (scene.t_capture_ns if done == 0 else first_ns), scene.t_capture_ns
        held = scene.held
        taken = taken if held else scene
        advance(done + 1, count, "playing")
        if at is not None and last_ns - first_ns >= round(at * 1e9):
            break
    if taken is None or len(taken.gaussians) == 0:
        why = f": {held}" if held else ""
        raise SagsError(f"{session.name}: no frame shows anything to make a model of{why}")
    _check_time(session, at, first_ns, last_ns)
    if held:
        # Rounded down: `--at` takes the frame that follows.
        before = (taken.t_capture_ns - first_ns) // 1_000_000 / 1000
        said = f"{session.name}: the frame at {(last_ns - first_ns) * 1e-9:.2f} s was not taken in ({held})"
        if at is not None:
            raise UsageError(f"{said}; the last one before it is at {before:g} s: --at {before:g}")
        log.warning("%s: exported is the last one before it, at %g s", said, before)
    return taken


def scenes_of_session(session: Session) -> Iterator[Scene]:
    """The online model after each frame of a recording but its warm-up; without Gaussians where nothing is
    known yet.

    Args:
        session: a recording with `source.pace` step.
    """
    configure_threads(session.config.engine.threads)
    pipeline = Pipeline(session.config, session.rig)
    budget = pipeline.make_budget()
    with session.source as source:
        for frame in source:
            result = pipeline.process(frame, budget)
            if not frame.warm_up:
                shown, held = result.snapshot, result.held
                yield Scene(shown.gaussians, shown.camera, frame.t_capture_ns, held, backend=session.backend)


# ---- a fit -----------------------------------------------------------------------------------------------


def from_fit(folder: Path, session: Session, at: float | None, advance: Advance) -> Scene:
    """Return what `sags fit` made of a recording, at a time.

    Args:
        folder: holds its `checkpoint.npz` and `figures.json`.
        session: the recording that was fitted.
        at: seconds after its first frame; None: its end.
        advance: called with what is going on.

    Raises:
        UsageError: there is no finished fit, it is one of another recording, or that ends before.
        SagsError: the recording or the checkpoint cannot be read.
    """
    fit, frames = _read_fit(folder, session, advance)
    first_ns, last_ns = frames[0].t_capture_ns, frames[-1].t_capture_ns
    _check_time(session, at, first_ns, last_ns)
    from_ns = last_ns if at is None else first_ns + round(at * 1e9)
    frame = next((f for f in frames if f.t_capture_ns >= from_ns), frames[-1])
    return _scene_of(fit, frame, session)


def scenes_of_fit(folder: Path, session: Session, advance: Advance) -> Iterator[Scene]:
    """Return what `sags fit` made of a recording, at the time of each of its frames; as `from_fit`."""
    fit, frames = _read_fit(folder, session, advance)
    for frame in frames:
        yield _scene_of(fit, frame, session)


def _scene_of(fit: Fit, frame: ClipFrame, session: Session) -> Scene:
    drawn = fit.settings.antialias, session.backend
    return Scene(fit.gaussians(frame), frame.camera, frame.t_capture_ns, "", *drawn)


def files_of_fit(folder: Path) -> tuple[Path, Path]:
    """The checkpoint and the figures that `sags fit` left.

    Raises:
        UsageError: one is missing.
    """
    stored, figures = folder / "checkpoint.npz", folder / "figures.json"
    for file in (stored, figures):
        if not file.is_file():
            raise UsageError(f"there is no {file}; name the folder of a finished sags fit")
    return stored, figures


def _read_fit(folder: Path, session: Session, advance: Advance) -> tuple[Fit, list[ClipFrame]]:
    """A fit, and all frames of its recording in order; as `from_fit`."""
    stored, figures = files_of_fit(folder)
    try:
        with np.load(stored, allow_pickle=False) as arrays:
            about = json.loads(str(arrays["about"]))
        settings = msgspec.convert(about["settings"], FitSettings)
        trained = set(about["frames"])
        tested = json.loads(figures.read_text(encoding="utf-8"))["heldout"]["frames"]
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile) as error:
        raise SagsError(f"the fit in {folder} cannot be read: {error}; fit the recording again") from None
    count = session.source.frame_count
    clip = read_clip(
        session, lambda frame: frame not in trained, lambda done: advance(done, count, "reading")
    )
    if len(clip.test) != tested:
        raise UsageError(
            f"{folder} is the fit of other frames than {session.name} plays; give the same overrides"
        )
    advance(0, None, "reading the fit")
    fit = Fit(clip, settings)
    checkpoint.load(fit, stored)
    if not fit.done:
        raise UsageError(f"the fit in {folder} is not finished; go on with sags fit --resume")
    return fit, sorted((*clip.train, *clip.test), key=lambda frame: frame.t_capture_ns)


def _check_time(session: Session, at: float | None, first_ns: int, last_ns: int) -> None:
    length = (last_ns - first_ns) * 1e-9
    if at is not None and at > length:
        raise UsageError(f"--at {at:g}: {session.name} ends after {length:.2f} s")
