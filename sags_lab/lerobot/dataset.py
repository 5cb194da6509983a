"""Data sets in the form of LeRobot: Parquet, MP4 and their description, an episode for each recording."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from sags_lab.lerobot.form import (
    COARSE,
    DEPTH,
    LEFT,
    NUMBERS,
    POINTS,
    POSE,
    RIGHT,
    TISSUE,
    VISIBILITY,
    Version,
    check_lerobot,
    data_path,
    describe,
    features_of,
    schema_of,
    video_path,
    videos_of,
)  # fmt: skip
from sags_lab.lerobot.stats import Stats, Sums
from sags_node.errors import UsageError
from sags_node.files import whole
from sags_node.media.video_file import VideoFile
from sags_node.tools.export.played import depth_of, new_folder, points_of
from sags_node.types import AnchorStates, FrameResult, RectifiedPair

if TYPE_CHECKING:
    import pyarrow as pa

log = logging.getLogger(__name__)

UNEVEN = 0.02  # share that a rate may be off a whole one: stamps in whole ms make 30 Hz 1 % wrong
ROWS = 64  # frames that are kept in memory until they are written
PICTURES_LOOKED_AT = 10  # one frame in so many counts in the statistics of images
STATISTICS = {  # feature -> shape of its statistics; (1,): one number for all pixels or values
    DEPTH: (1,), TISSUE: (1,), POSE: (4, 4), POINTS: (3,), VISIBILITY: (1,), "timestamp": (1,),
    LEFT: (3, 1, 1), RIGHT: (3, 1, 1),
}  # fmt: skip


class LeRobot:
    """A data set of one episode.

    Observations: images of both eyes (`observation.images.endoscope.left` and `right`), the model's depth
    (m, 0 unknown) and the tissue mask at a fourth of the size, the camera's pose T_world_cam [4, 4] (m, NaN:
    not known), and 64 points that are followed ([64, 3] m, world; NaN: lost) with their visibility 0..1.

    Args:
        folder: is made here.
        rate: frames per second; LeRobot takes whole ones, without gaps.

    Raises:
        UsageError: pyarrow is not installed, or the rate is not whole.
    """

    def __init__(self, folder: Path, rate: float, version: Version) -> None:
        check_lerobot()
        self._fps = max(1, round(rate))
        if abs(rate - self._fps) > UNEVEN * self._fps:
            raise UsageError(
                f"LeRobot knows whole rates only, and {rate:.4g} frames a second are recorded; set "
                f"source.rate to what they are to have, e.g. source.rate:={self._fps}"
            )
        folder.mkdir()
        self._folder, self._version = folder, version
        self._stamps: list[int] = []  # ns
        self._features: dict[str, Any] = {}
        self._videos: dict[str, VideoFile] = {}
        self._sums: dict[str, Sums] = {}
        self._rows: list[dict[str, Any]] = []
        self._count = 0
        self._table: Any = None  # a ParquetWriter

    def _open(self, pair: RectifiedPair) -> None:
        """Open the videos of a recording whose first pair this is."""
        size = pair.camera.width, pair.camera.height
        eyes = (LEFT,) if pair.right is None else (LEFT, RIGHT)
        self._features = features_of(size, eyes, self._fps)
        self._sums = {name: Sums() for name in STATISTICS if name in self._features}
        for eye in eyes:
            path = self._folder / video_path(self._version, eye, 0)
            path.parent.mkdir(parents=True)
            self._videos[eye] = VideoFile(path, self._fps, size)

    def add(self, number: int, result: FrameResult, anchors: AnchorStates) -> None:
        pair = result.pair
        if self._count == 0:
            self._open(pair)
        self._stamps.append(pair.t_capture_ns)
        points, visibility = points_of(result, anchors)
        small = pair.camera.width // COARSE, pair.camera.height // COARSE
        tissue = result.observation.tissue.astype(np.uint8)
        pose = np.full((4, 4), np.nan) if "pose" in result.skipped else pair.camera.T_world_cam
        row = {
            DEPTH: cv2.resize(depth_of(result), small, interpolation=cv2.INTER_NEAREST),
            TISSUE: cv2.resize(tissue, small, interpolation=cv2.INTER_NEAREST),
            POSE: pose.astype(np.float32),
            POINTS: points,
            VISIBILITY: visibility,
            "timestamp": np.float32(self._count / self._fps),
        }
        for name, value in row.items():
            self._sums[name].add(np.asarray(value, np.float64).reshape(-1, int(np.prod(STATISTICS[name]))))
        for eye, picture in ((LEFT, pair.left), (RIGHT, pair.right)):
            if eye in self._videos:
                assert picture is not None  # a session has a right eye in all frames, or in none
                self._videos[eye].add(picture)
                if self._count % PICTURES_LOOKED_AT == 0:
                    self._sums[eye].add(picture[::COARSE, ::COARSE].reshape(-1, 3) / 255.0)
        numbers = dict.fromkeys(NUMBERS, 0) | {"frame_index": self._count, "index": self._count}
        self._rows.append(row | numbers)
        self._count += 1
        if len(self._rows) == ROWS:
            self._write_rows()

    def finish(self) -> int:
        self._write_rows()
        self._table.close()
        for video in self._videos.values():
            video.finish()
        steps = np.diff(self._stamps) * 1e-9
        if uneven := int(np.sum(np.abs(steps - 1 / self._fps) > 0.5 / self._fps)):
            log.warning(
                "%d of %d steps between frames are not of %d Hz, the longest is of %.1f s: LeRobot knows no "
                "gaps, so the timestamps are not the recording's there; cut it where it paused",
                *(uneven, len(steps), self._fps, steps.max()),
            )
        stats = {name: sums.stats(STATISTICS[name]) for name, sums in self._sums.items()}
        describe(self._folder, self._version, self._features, self._fps, [self._count], [stats])
        return self._count

    def _write_rows(self) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        if not self._rows:
            return
        schema = schema_of(self._features)
        columns = {name: [_plain(row[name]) for row in self._rows] for name in schema.names}
        if self._table is None:
            path = self._folder / data_path(self._version, 0)
            path.parent.mkdir(parents=True)
            self._table = pq.ParquetWriter(path, schema)
        self._table.write_table(pa.table(columns, schema))
        self._rows = []


def merge(folders: Sequence[Path], out: Path, version: Version) -> int:
    """Merge data sets into one, in this order; videos are hard-linked where that is possible.

    Args:
        folders: data sets of one episode each, of any version.
        out: new or empty.

    Returns:
        How many frames it has.

    Raises:
        UsageError: they differ in rate, size or what is in them, or `out` holds something.
        SagsError: one cannot be read, or it cannot be written.
    """
    new_folder(out)
    with whole(out) as partial:
        partial.mkdir()
        return _merge(folders, partial, version)


def _merge(folders: Sequence[Path], out: Path, version: Version) -> int:
    import pyarrow.parquet as pq

    lengths: list[int] = []
    stats: list[dict[str, Stats]] = []
    first: dict[str, Any] = {}
    for number, folder in enumerate(folders):
        info = json.loads((folder / "meta/info.json").read_text(encoding="utf-8"))
        first = first or info
        if (info["features"], info["fps"]) != (first["features"], first["fps"]):
            raise UsageError(
                f"{folder} has images of another size or rate than {folders[0]}: one data set "
                "holds one kind; give them vision.width, vision.height and source.rate that are the same"
            )
        old = info["codebase_version"]
        source = pq.ParquetFile(folder / data_path(old, 0))
        path = out / data_path(version, number)
        path.parent.mkdir(parents=True, exist_ok=True)
        with pq.ParquetWriter(path, source.schema_arrow) as writer:
            for group in range(source.num_row_groups):
                writer.write_table(_renumbered(source.read_row_group(group), number, sum(lengths)))
        for eye in videos_of(info["features"]):
            _link(folder / video_path(old, eye, 0), out / video_path(version, eye, number))
        lengths.append(info["total_frames"])
        stats.append(json.loads((folder / "meta/stats.json").read_text(encoding="utf-8")))
    describe(out, version, first["features"], first["fps"], lengths, stats)
    return sum(lengths)


def _link(file: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        target.hardlink_to(file)
    except OSError:  # another disk
        shutil.copyfile(file, target)


def _renumbered(table: pa.Table, episode: int, before: int) -> pa.Table:
    import pyarrow as pa

    count = len(table)
    numbers = {"episode_index": np.full(count, episode), "index": np.asarray(table["index"]) + before}
    for name, values in numbers.items():
        table = table.set_column(table.schema.get_field_index(name), name, pa.array(values, pa.int64()))
    return table


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value
