"""Reads sessions of dVRK's `record` (dvrk_data): a side-by-side MP4 and a sidecar JSON with frame stamps.

The sidecar follows `dvrk_data:video_sidecar@1.0.0`. It lists the frames that reached the recorder. If the
video holds another number of frames, each of its frames takes the stamps of the sidecar's frame with the
nearest presentation time.
"""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from sags_node.config.launch_file import SIDECAR_TYPE
from sags_node.config.schema import DvrkSource, GeometryConfig
from sags_node.errors import UsageError
from sags_node.files import read_file
from sags_node.media.video import Video
from sags_node.sources.layout import Layout
from sags_node.sources.pairing import nearest
from sags_node.sources.videos import OneVideoPairs
from sags_node.types import I64

ALONE = "alone with source.kind:=videos source.geometry.layout:=side_by_side"
MAX_SIDECAR_BYTES = 512 << 20  # enough for hours at 60 Hz

Stamp = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


class _Gst(msgspec.Struct):
    pts_ns: Stamp | None = None


class _Realtime(msgspec.Struct):
    recorder_reception_ns: Stamp
    left_source_ns: Stamp | None = None
    right_source_ns: Stamp | None = None
    stereo_output_ns: Stamp | None = None


class _Cpu(msgspec.Struct):
    realtime: _Realtime


class _Frame(msgspec.Struct):
    cpu: _Cpu
    gst: _Gst = msgspec.field(default_factory=_Gst)

    def stamps(self) -> tuple[int, int]:
        """Return the capture times of the left and the right image, ns, from the best clock listed."""
        seen = self.cpu.realtime
        fallback = seen.stereo_output_ns or seen.recorder_reception_ns
        left, right = seen.left_source_ns, seen.right_source_ns
        return left or right or fallback, right or left or fallback


class Sidecar(msgspec.Struct):
    """The keys of the file that are used; others are ignored."""

    type: str
    video_file: str
    frames: list[_Frame]
    side_by_side: Literal["undefined", "LR", "RL"] = "undefined"


class DvrkPairs(OneVideoPairs):
    """The frames of a session.

    Raises:
        UsageError: files are missing or damaged, or the video is not stereo.
    """

    def __init__(self, config: DvrkSource) -> None:
        file = find_sidecar(config.path)
        sidecar = read_sidecar(file)
        order = config.side_by_side or sidecar.side_by_side
        if order == "undefined":
            raise UsageError(
                f"{file} does not say that the video is stereo; set source.side_by_side to LR or RL"
            )
        video = Video(file.parent / Path(sidecar.video_file).name)  # a name cannot lead out of the folder
        first = GeometryConfig(layout="side_by_side", first="left" if order == "LR" else "right")
        super().__init__(video, Layout(first))
        self.pixel_aspect = 1.0  # the sidecar says how both eyes share the image: no need to guess
        try:
            self.stamps, self.oddities = _stamps(file, sidecar, video)
        except UsageError:
            self.close()
            raise
        steps = np.diff(self.stamps[:, 0])
        self.rate = float(1e9 / np.median(steps)) if len(steps) and np.median(steps) > 0 else video.rate


def find_sidecar(path: Path) -> Path:
    """Find the sidecar at `path`, or the only stereo one in that folder.

    Raises:
        UsageError: there is none, or several.
    """
    if path.suffix == ".mp4":
        return path.with_suffix(".json")
    if not path.is_dir():
        return path
    stereo = [file for file in sorted(path.glob("*.json")) if _is_stereo(file)]
    if len(stereo) != 1:
        names = ", ".join(file.name for file in stereo) or "none"
        raise UsageError(f"{path}: one sidecar of a stereo video is needed, there are: {names}; name one")
    return stereo[0]


def _is_stereo(file: Path) -> bool:
    try:
        return read_sidecar(file).side_by_side != "undefined"
    except UsageError:
        return False


def read_sidecar(file: Path) -> Sidecar:
    """Read and check a sidecar.

    Raises:
        UsageError: it is missing, of another type or version, or damaged.
    """
    try:
        sidecar = msgspec.json.decode(read_file(file, MAX_SIDECAR_BYTES), type=Sidecar)
    except OSError as error:
        raise UsageError(f"cannot read sidecar {file}: {error.strerror}; check the path") from None
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise UsageError(f"{file} is not a {SIDECAR_TYPE}1.0.0 file: {error}") from None
    if not sidecar.type.startswith(f"{SIDECAR_TYPE}1."):
        raise UsageError(f"{file} is of type {sidecar.type!r}; what is read is {SIDECAR_TYPE}1.0.0")
    if not sidecar.frames:
        raise UsageError(f"{file} lists no frames; was anything recorded?")
    return sidecar


def _stamps(file: Path, sidecar: Sidecar, video: Video) -> tuple[I64, list[str]]:
    """The stamps [N, 2] of the video's frames, ns, and warnings about them."""
    stamps, oddities = np.array([frame.stamps() for frame in sidecar.frames], np.int64), []
    if len(stamps) != video.count:
        found, longer = _nearest_frames(file, sidecar, video)
        stamps = stamps[found]
        if longer:
            lost, other = (video.path, file) if longer > 0 else (file, video.path)
            oddities = [
                f"{lost} is {abs(longer) * 1e-6:.0f} ms shorter than {other}, and both are taken to begin "
                f"together: stamps are {'early' if longer > 0 else 'late'} by as much if it lacks the first "
                "frames, not the last ones; see whether images and the robot's poses move together"
            ]
    if (np.diff(stamps[:, 0]) < 0).any():
        turn = int(np.argmax(np.diff(stamps[:, 0]) < 0)) + 1
        raise UsageError(
            f"{file}: the stamp of frame {turn} lies before that of the frame before; play the MP4 {ALONE}"
        )
    return stamps, oddities


def _nearest_frames(file: Path, sidecar: Sidecar, video: Video) -> tuple[I64, int]:
    """For each frame of the video, the sidecar's frame with the nearest presentation time. Also how much
    longer the sidecar is than the video, ns (0 if less than half a period)."""
    pts = [frame.gst.pts_ns for frame in sidecar.frames]
    known = np.array([-1 if at is None else at for at in pts], np.int64)
    if (known < 0).any() or video.stamps is None or (np.diff(known) < 0).any():
        raise UsageError(
            f"{file} lists {len(known)} frames but {video.path} holds {video.count}, and there are no rising "
            f"presentation times to join them by; play the MP4 {ALONE}"
        )
    shown, listed = video.stamps - video.stamps[0], known - known[0]
    longer = int(listed[-1] - shown[-1])
    half = 0.5 * float(np.median(np.diff(shown))) if len(shown) > 1 else 0.0
    return nearest(shown, listed), longer if abs(longer) > half else 0
