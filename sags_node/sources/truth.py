"""Reads what a recording holds besides images: poses, and references (ground truth) for evaluation."""

import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.config.schema import ReferenceConfig
from sags_node.errors import SagsError, UsageError
from sags_node.files import open_file
from sags_node.geometry import is_rotation
from sags_node.sources.pictures import list_pictures, read_picture, size_text
from sags_node.types import F32, F64, Bool, Reference

UNKNOWN = 65535  # depth count for unknown, beside 0, as many programs write it
_LARGEST = 2**31  # bytes
FARTHEST = 1.0  # m: if a scope moves by more, millimetres were taken for metres
FARTHEST_POINT = 10.0  # m from the base of any robot; as many millimetres are as near as an endoscope sees
ENDOSCOPE_DEPTH = (0.01, 0.3)  # m: plausible median depth of an endoscope's frame
FARTHEST_DEPTH = 1.0  # m: a larger median depth is refused
DEPTH_UNITS = (1e-3, 1e-4, 1e-5, 1e-6, 1.0, 1e-3 / 256)  # m per count, the usual ones first; SERV-CT's last


def read_poses(file: Path) -> F64:
    """Read `T_world_cam` [T, 4, 4] m of each frame of a recording.

    Raises:
        UsageError: the file is missing or damaged, or the poses are missing or implausible.
    """
    poses = load_array(file, "T_world_cam", (None, 4, 4)).astype(np.float64)
    if not np.isfinite(poses).all():
        raise UsageError(f"{file}: T_world_cam holds values that are not finite")
    rigid = is_rotation(poses[:, :3, :3]) & (poses[:, 3] == [0, 0, 0, 1]).all(axis=1)
    if not rigid.all():
        raise UsageError(
            f"{file}: T_world_cam of frame {int(np.argmin(rigid))} is no rotation and translation; "
            "is it transposed, or scaled?"
        )
    moved = np.ptp(poses[:, :3, 3], axis=0).max(initial=0)
    if moved > FARTHEST:
        raise UsageError(
            f"{file}: T_world_cam moves the camera by {moved:.3g} m, more than within a patient; "
            "translations are in metres: of millimetres divide them by 1000"
        )
    return poses


def fitting_units(counts: float) -> list[float]:
    """Return the units (m per count) in which this median count is a plausible distance for an endoscope."""
    return [unit for unit in DEPTH_UNITS if ENDOSCOPE_DEPTH[0] <= counts * unit <= ENDOSCOPE_DEPTH[1]]


def judge_depth(file: Path, median: float, unit: float, key: str) -> str:
    """Return a warning if the median depth of an image is farther than an endoscope sees; else "".

    Args:
        median: m, with `unit` (m per count), which `key` of a launch file sets.

    Raises:
        UsageError: it cannot be right.
    """
    each = [f"{fit:g} makes {median / unit * fit * 1e3:.0f} mm" for fit in fitting_units(median / unit)]
    fits = f" ({', '.join(each)})" if each else ""
    near, far = ENDOSCOPE_DEPTH
    if not near <= median <= FARTHEST_DEPTH:
        raise UsageError(
            f"{file}: the median depth would be {median:.3g} m, but an endoscope sees {near:g} to {far:g} m; "
            f"set {key} (m per count, now {unit:g}){fits}"
        )
    if median <= far:
        return ""
    return (
        f"{file.parent}: {median * 1e3:.0f} mm (median) with {unit:g} m per count, and an endoscope sees "
        f"{near:g} to {far:g} m; ask who made it which unit it has, and set {key}{fits}"
    )


class References:
    """The ground truth that comes with a recording.

    Attributes:
        oddity: a warning about the unit of its depth; "": there is none.

    Raises:
        UsageError: a file or folder is missing, damaged or not of the stated form, or of another unit.
    """

    def __init__(self, config: ReferenceConfig) -> None:
        self._config = config
        self._depth_files = {} if config.depth is None else _by_frame_number(config.depth)
        self.oddity = ""
        for file in list(self._depth_files.values())[:1]:
            depth = self._depth_in(file)
            if (known := depth[depth > 0]).size:
                median, key = float(np.median(known)), "source.reference.depth_unit"
                self.oddity = judge_depth(file, median, config.depth_unit, key)
        self._tracks: dict[int, tuple[F64, Bool]] = {}  # points and their visibility, by frame number
        self._numbers: Sequence[int] = ()  # frame number of each row of the tracks; empty: row i is frame i
        if config.tracks is not None:
            points = load_array(config.tracks, "points", (None, None, 3)).astype(np.float64)
            visible = load_array(config.tracks, "visible", points.shape[:2]).astype(np.bool_)
            seen = np.linalg.norm(points[visible], axis=-1)
            if seen.size and np.nanmedian(seen) > FARTHEST_POINT:
                raise UsageError(
                    f"{config.tracks}: points are {np.nanmedian(seen):.3g} m away (median), farther than an "
                    "endoscope sees; they are in metres: of millimetres divide them by 1000"
                )
            self._numbers = _frame_numbers(config.tracks, len(points))
            rows = zip(points, visible, strict=True)
            self._tracks = dict(zip(self._numbers or range(len(points)), rows, strict=True))

    def beyond(self, count: int) -> str:
        """Return an error text if a frame number is not below the recording's `count` of frames, e.g. because
        numbers begin at 1; else ""."""
        config = self._config
        for where, numbers in ((config.depth, self._depth_files), (config.tracks, self._numbers)):
            if (last := max(numbers, default=-1)) >= count:
                return (
                    f"{where} knows frame {last}, but the recording's {count} frames are numbered from 0 to "
                    f"{count - 1}; number the reference alike, and remove what is of no frame"
                )
        return ""

    def misnamed(self, pictures: Sequence[Path]) -> str:
        """Return a warning if a depth file has the name of another frame's image; else "".

        Args:
            pictures: of all frames, in order.
        """
        places = {file.stem: place for place, file in enumerate(pictures)}
        for number, file in self._depth_files.items():
            if places.get(file.stem, number) != number:
                return (
                    f"{file} is taken for the depth of {pictures[number].name}: frame numbers begin at 0; "
                    "if it is that of the image of its name, number the reference from 0"
                )
        return ""

    def at(self, index: int, size: tuple[int, int]) -> Reference | None:
        """Return the reference of one frame of the recording, None if it has none.

        Args:
            size: width and height of its image, px.

        Raises:
            SagsError: the depth image is damaged, not 16 bit, or has another aspect ratio than the frame.
        """
        depth_file = self._depth_files.get(index)
        points, visible = self._tracks.get(index, (None, None))
        if depth_file is None and points is None:
            return None
        depth = None if depth_file is None else self._read_depth(depth_file, size)
        return Reference(depth, self._config.depth_kind, points, visible)

    def _read_depth(self, file: Path, size: tuple[int, int]) -> F32:
        depth = self._depth_in(file)
        (height, width), (wide, high) = depth.shape, size
        if abs(width * high - height * wide) >= max(size):  # by a whole pixel
            raise SagsError(
                f"{file} is {size_text(width, height)} px, of another shape than the images "
                f"({size_text(wide, high)}); reference depth must show what they show, cropped as they are"
            )
        return depth

    def _depth_in(self, file: Path) -> F32:
        """Depth [H, W] m; 0 where unknown."""
        counts = read_picture(file, cv2.IMREAD_UNCHANGED)
        if counts.dtype != np.uint16 or counts.ndim != 2:
            raise SagsError(f"{file} is not a 16-bit grey PNG; reference depth must be one")
        return np.where(counts == UNKNOWN, np.float32(0), counts * np.float32(self._config.depth_unit))


def _by_frame_number(folder: Path) -> dict[int, Path]:
    files = list_pictures(folder)
    for file in files:
        if not file.stem.isdecimal():
            raise UsageError(f"{file}: reference depth files are named by frame number, e.g. 0010.png")
    return {int(file.stem): file for file in files}


def _frame_numbers(file: Path, count: int) -> Sequence[int]:
    """The frame numbers of tracks, from their array `frames` [T]; empty if there is none."""
    with zipfile.ZipFile(file) as archive:
        if "frames.npy" not in archive.namelist():
            return ()
    frames = load_array(file, "frames", (count,))
    numbers: list[int] = frames.tolist() if frames.dtype.kind in "iu" else []
    if len(set(numbers)) < count or min(numbers, default=0) < 0:
        raise UsageError(
            f"{file}: 'frames' must hold the frame number of each row, from 0, none of them twice"
        )
    return numbers


def load_array(file: Path, key: str, shape: tuple[int | None, ...]) -> NDArray[np.generic]:
    """Load one numeric array of an npz file; `None` in `shape` stands for any length.

    The header is compared with the size of the file before memory is allocated.

    Raises:
        UsageError: the file is missing or damaged, or the array is missing or of another shape or type.
    """
    with _explained(file, "npz"), open_file(file) as opened, zipfile.ZipFile(opened) as archive:
        if f"{key}.npy" not in archive.namelist():
            raise UsageError(f"{file} holds no array '{key}'")
        with archive.open(f"{key}.npy") as stream:
            return _load(stream, f"{file}: '{key}'", shape, archive.getinfo(f"{key}.npy").file_size)


def load_npy(file: Path, shape: tuple[int | None, ...]) -> NDArray[np.generic]:
    """Load the numeric array of an npy file; see `load_array`.

    Raises:
        UsageError: the file is missing or damaged, or the array is of another shape or type.
    """
    with _explained(file, "npy"), open_file(file) as stream:
        return _load(stream, str(file), shape, file.stat().st_size)


@contextmanager
def _explained(file: Path, kind: str) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise UsageError(f"{file} does not exist; check the path") from None
    except SagsError:
        raise
    except Exception as error:  # zipfile, zlib and numpy's parser of headers raise many kinds
        said = " ".join(str(error).split())[:200]
        raise UsageError(f"{file} is not a readable {kind} file: {said}") from None


def _load(stream: IO[bytes], what: str, shape: tuple[int | None, ...], room: int) -> NDArray[np.generic]:
    """Load an npy stream; its header must match the wanted shape and `room`, the bytes of the stream."""
    version = np.lib.format.read_magic(stream)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    found, _, dtype = read_header(stream)
    fits = len(found) == len(shape) and all(
        want in (None, got) for want, got in zip(shape, found, strict=True)
    )
    if not fits or dtype.kind not in "bfiu":
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise UsageError(f"{what} is {dtype} {list(found)}, wanted numbers [{wanted}]")
    size = int(np.prod(found, dtype=object)) * dtype.itemsize
    if room > _LARGEST or size > room - stream.tell():
        raise UsageError(f"{what} claims an impossible size {list(found)}")
    stream.seek(0)
    array: NDArray[np.generic] = np.load(stream, allow_pickle=False)
    return array
