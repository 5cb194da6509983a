"""The interface of all sources of stereo frames, and the function that opens any of them."""

from collections.abc import Callable, Iterator
from typing import Any, Protocol, Self

from sags_node.config import schema as cfg
from sags_node.config.launch_file import load_launch
from sags_node.types import Finding, StereoFrame, StereoRig


class Source(Protocol):
    """A context manager that yields `StereoFrame`s until the recording ends or `stop` is called."""

    @property
    def rate(self) -> float:
        """The nominal rate, Hz."""

    @property
    def frame_count(self) -> int | None:
        """The number of frames; None if it is not known or there is no end."""

    @property
    def dropped(self) -> int:
        """The number of frames that the source left out: late ones in `realtime` pace, unpaired live ones."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: Any) -> None: ...

    def __iter__(self) -> Iterator[StereoFrame]:
        """Yield frames in capture order.

        Raises:
            SagsError: an image cannot be read, or the eyes do not match.
        """

    def stop(self) -> None:
        """End the iteration promptly, also while it waits. Thread-safe."""


def findings_of(source: object) -> tuple[Finding, ...]:
    """Return the findings of a source of frames or poses: what is wrong, and how to fix it. Empty if it has
    none. Thread-safe."""
    found: tuple[Finding, ...] = getattr(source, "findings", ())
    return found


def open_source(
    config: cfg.Source,
    references: bool = True,
    progress: Callable[[int, int], None] | None = None,
    size: tuple[int, int] | None = None,
    rig: StereoRig | None = None,
    quiet: bool = False,
) -> Source:
    """Open the source a launch file describes.

    Args:
        config: the `source` section.
        references: read the recording's ground truth with each frame. Only evaluation needs it.
        progress: called with (done, total) while a phantom session is rendered.
        size: width and height that an eye's live images must have, px; None: those of the first.
        rig: the calibration that live cameras published, if any: it must stay the same.
        quiet: do not log warnings about a recording: whoever plays it later does.

    Raises:
        UsageError: a file, folder or device is missing or does not match the rest.
        SagsError: a device or file cannot be read.
    """
    if isinstance(config, cfg.V4l2Source):
        from sags_node.sources.v4l2 import open_cameras

        return open_cameras(config, size)
    if isinstance(config, cfg.GstSource):
        from sags_node.sources.gst import open_pipeline

        return open_pipeline(config, size)
    if isinstance(config, cfg.Ros2Source):
        from sags_node.sources.ros2 import RosCameras

        return RosCameras(config, size, rig)
    if isinstance(config, cfg.PushSource):
        from sags_node.sources.push import PushedPictures

        return PushedPictures(config, size)

    from sags_node.sources.replay import Replay

    if isinstance(config, cfg.PhantomSource):
        config = _phantom_recording(config, progress)
    return Replay(config, references=references, quiet=quiet)


def recorded_rig(config: cfg.Source, judged: bool = True) -> StereoRig | None:
    """Read the calibration that comes with the images; None if the launch file must name one. Unless
    `judged`, a bag's may be implausible, and SCARED's for another size.

    Raises:
        UsageError: it is missing, damaged or implausible.
    """
    if isinstance(config, cfg.EndoNerfSource):
        from sags_node.sources import endonerf

        return endonerf.read_rig(config)
    if isinstance(config, cfg.ScaredSource):
        from sags_node.sources import scared

        return scared.read_rig(config.folder, judged)
    if isinstance(config, cfg.BagSource):
        from sags_node.sources import bags

        return bags.read_rig(config, judged)
    if isinstance(config, cfg.Ros2Source):
        from sags_node.sources import ros2

        return ros2.read_rig(config)
    return None


def _phantom_recording(
    config: cfg.PhantomSource, progress: Callable[[int, int], None] | None
) -> cfg.FoldersSource:
    """The folders of the rendered session, to be played as this launch file says."""
    from sags_node.phantom import cached_session

    recorded = load_launch(cached_session(config, progress)).source
    assert isinstance(recorded, cfg.FoldersSource)
    playing = config.model_dump(
        include={"pace", "rate", "loop", "start", "frames", "warm_up", "stride"}, exclude_unset=True
    )
    return recorded.model_copy(update=playing)
