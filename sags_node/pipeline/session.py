"""Open what a launch file names, and the node needs: configuration, rig and source."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sags_node.config import schema
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import (
    BagSource,
    EndoNerfSource,
    GstSource,
    LaunchConfig,
    PhantomSource,
    RecordedSource,
    Ros2Source,
    V4l2Source,
)
from sags_node.errors import UsageError
from sags_node.mapping.devices import backend_of, with_scale
from sags_node.rig import load_camera, load_rig
from sags_node.sources.endonerf import baseline_of
from sags_node.sources.pictures import say
from sags_node.sources.rectified import as_pictures_come
from sags_node.sources.robot import Posed
from sags_node.sources.source import Source, open_source, recorded_rig
from sags_node.types import StereoRig

Guess = Callable[[schema.Source], StereoRig]  # makes a rig from the images of a source


@dataclass(frozen=True, slots=True)
class Session:
    """What a node needs. The source gives no ground truth; evaluation opens a source of its own."""

    name: str  # of the launch file or folder
    config: LaunchConfig
    rig: StereoRig
    source: Source

    @property
    def working_size(self) -> tuple[int, int]:
        """Width and height of the images that the mapper works on, px."""
        return self.config.vision.working_size(self.rig.left.width, self.rig.left.height)

    @property
    def published_size(self) -> tuple[int, int]:
        """Width and height of the images that consumers get, px."""
        return self.config.vision.published_size(self.rig.left.width, self.rig.left.height)

    @property
    def backend(self) -> str:
        """What draws, as for `make_rasterizer`."""
        return backend_of(self.config)


def open_session(
    launch: Path | str | None,
    overrides: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
    guess: Guess | None = None,
) -> Session:
    """Read a launch file or session folder (None: the built-in phantom) and open what it names.

    Args:
        progress: called with (frames done, frames in all) while the phantom is rendered for the first time.
        guess: makes a calibration where none is named; None: a missing one is an error.

    Raises:
        UsageError: a wrong key, value or path.
        SagsError: the recording or the calibration cannot be used.
    """
    say.cache_clear()
    config = load_launch(launch, overrides)
    one_eyed = isinstance(config.source, EndoNerfSource) and baseline_of(config.source) is None
    if config.one_camera or one_eyed:
        if config.publish.right is True:
            raise UsageError(
                "publish.right: there is no right eye; set source.baseline, or leave publish.right out"
            )
        config = config.model_copy(update={"publish": config.publish.model_copy(update={"right": False})})
    rig = rig_to_play(config, progress, guess)
    source = open_posed(config, rig, references=False)
    return Session(_name(launch), config, rig, source)


def at_best_scale(session: Session) -> Session:
    """The session with its `vision.scale` chosen, see `with_scale`. Kernels must be ready: they are timed."""
    config = with_scale(session.config, *session.working_size, session.source.rate)
    return replace(session, config=config)


def open_posed(config: LaunchConfig, rig: StereoRig, references: bool = True) -> Source:
    """The frames of a launch file, with the robot's poses where it names one.

    Args:
        references: read the recording's ground truth with each frame. Only evaluation needs it.

    Raises:
        UsageError, SagsError: see `open_source` and `Posed`.
    """
    size = rig.left.width, rig.left.height
    source = open_source(config.source, references, size=size, rig=rig if config.rig is None else None)
    return source if config.robot is None else Posed(source, config, rig)


def _name(launch: Path | str | None) -> str:
    if launch is None:
        return "phantom"
    path = Path(launch)
    return path.name if path.is_dir() else path.stem


def lacks_rig(config: LaunchConfig) -> bool:
    """Tell whether `open_session` would guess the calibration."""
    opens = isinstance(config.source, RecordedSource | V4l2Source | GstSource)  # these need no sender
    return config.rig is None and opens and recorded_rig(config.source, judged=False) is None


def rig_to_play(
    config: LaunchConfig, progress: Callable[[int, int], None] | None = None, guess: Guess | None = None
) -> StereoRig:
    """Return the calibration that `open_session` uses with the same arguments."""
    if isinstance(config.source, PhantomSource):
        from sags_node.phantom import cached_session

        return load_rig(cached_session(config.source, progress) / "calib")
    return guess(config.source) if guess is not None and lacks_rig(config) else rig_of(config)


def rig_of(config: LaunchConfig) -> StereoRig:
    """Return the calibration that comes with the images, or that the launch file names, adapted to whether
    the images come rectified."""
    return as_pictures_come(_named_rig(config), config)


def _named_rig(config: LaunchConfig) -> StereoRig:
    if config.rig is not None and isinstance(config.source, BagSource | Ros2Source):
        return load_rig(config.rig)  # a driver's calibration is often missing or outdated
    recorded = recorded_rig(config.source)
    if recorded is not None and config.rig is not None:
        raise UsageError(f"rig: {config.rig} is one calibration too many: the recording brings its own")
    if recorded is not None:
        return recorded
    if config.rig is None:
        raise UsageError(
            "no calibration: set rig to the folder with left.yaml and right.yaml of this scope; "
            "docs/calibration.md says how to make one. sags run plays recordings and cameras without one; "
            "depth then has no unit"
        )
    if config.one_camera and not config.rig.is_dir():
        return load_camera(config.rig)
    return load_rig(config.rig)
