"""Data sets in the form of LeRobot v3.0: Parquet, MP4 and their description, an episode for each recording.

The form is that of lerobot 0.4 (`lerobot/datasets/utils.py`). Each episode has files of its own, so that
episodes made apart are one data set once they lie in one folder (`merge`).
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from sags_node.errors import SagsError, UsageError
from sags_node.export.played import TRACKS, depth_of, new_folder, points_of
from sags_node.terminal.console import writing
from sags_node.types import F64, AnchorStates, FrameResult, RectifiedPair
from sags_node.video_file import VideoFile

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = "v3.0"
FILES_PER_CHUNK = 1000
COARSE = 4  # depth and mask are stored at a fourth of the size: a frame takes 100 kB then, not 1.5 MB
ROWS = 64  # frames that are in memory
LEFT, RIGHT = "observation.images.endoscope.left", "observation.images.endoscope.right"
DEPTH, TISSUE, POSE = "observation.depth", "observation.tissue", "observation.camera_pose"
POINTS, VISIBILITY = "observation.tracks", "observation.tracks_visibility"
PICTURES_LOOKED_AT = 10  # one frame in so many, for the statistics
TASK = "observe the tissue"

Stats = dict[str, dict[str, list[Any]]]


def check_lerobot() -> None:
    """To be asked before long work.

    Raises:
        UsageError: pyarrow is not installed.
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise UsageError(
            "LeRobot data sets need pyarrow, which is not installed: pip install 'sags-node[archive]'"
        ) from None


class LeRobot:
    """A data set of one episode.

    Observations: pictures of both eyes (`observation.images.endoscope.left` and `right`), the model's depth
    (m, 0 unknown) and the tissue mask at a fourth of the size, the camera's pose T_world_cam [4, 4] (m), and
    64 points that are followed ([64, 3] m, world; NaN: lost) with their visibility 0..1.

    Args:
        folder: new or empty.
        rate: frames per second; LeRobot takes whole ones.
    """

    def __init__(self, folder: Path, rate: float) -> None:
        check_lerobot()
        new_folder(folder)
        self._folder = folder
        self._fps = max(1, round(rate))
        self._features: dict[str, Any] = {}
        self._videos: dict[str, VideoFile] = {}
        self._sums: dict[str, _Sums] = {}
        self._rows: list[dict[str, Any]] = []
        self._count = 0
        self._table: Any = None  # a ParquetWriter

    def _open(self, pair: RectifiedPair) -> None:
        """The files of a recording that begins so."""
        size = pair.camera.width, pair.camera.height
        eyes = (LEFT,) if pair.right is None else (LEFT, RIGHT)
        self._features = _features(size, eyes, self._fps)
        self._sums = {name: _Sums() for name in self._features if not name.endswith("index")}
        for eye in eyes:
            path = self._folder / _video_path(eye, 0)
            path.parent.mkdir(parents=True)
            self._videos[eye] = VideoFile(path, self._fps, size)

    def add(self, result: FrameResult, anchors: AnchorStates) -> None:
        if self._count == 0:
            self._open(result.pair)
        points, visibility = points_of(anchors)
        width, height = result.pair.camera.width // COARSE, result.pair.camera.height // COARSE
        small = (width, height)
        row = {
            DEPTH: cv2.resize(depth_of(result), small, interpolation=cv2.INTER_NEAREST),
            TISSUE: cv2.resize(
                result.observation.tissue.astype(np.uint8), small, interpolation=cv2.INTER_NEAREST
            ),
            POSE: result.pair.camera.T_world_cam.astype(np.float32),
            POINTS: points,
            VISIBILITY: visibility,
            "timestamp": np.float32(self._count / self._fps),
            **dict.fromkeys(("frame_index", "index"), self._count),
            **dict.fromkeys(("episode_index", "task_index"), 0),
        }
        for eye, picture in ((LEFT, result.pair.left), (RIGHT, result.pair.right)):
            if eye in self._videos:
                assert picture is not None  # a session has a right eye in all frames, or in none
                self._videos[eye].add(picture)
                if self._count % PICTURES_LOOKED_AT == 0:
                    self._sums[eye].add(picture[::COARSE, ::COARSE].reshape(-1, 3) / 255.0)
        for name in (DEPTH, TISSUE, POSE, POINTS, VISIBILITY, "timestamp"):
            self._sums[name].add(np.asarray(row[name], np.float64).reshape(-1, 1))
        self._rows.append(row)
        self._count += 1
        if len(self._rows) == ROWS:
            self._write_rows()

    def finish(self) -> dict[str, Any]:
        if self._count == 0:
            raise SagsError("no frame was played; check source.start and source.frames")
        with writing(self._folder):
            self._write_rows()
            self.close()
            for eye in self._videos:
                if (self._folder / _video_path(eye, 0)).stat().st_size == 0:
                    raise SagsError(f"cannot write {self._folder}: is the disk full?")
            stats = {name: sums.stats(name in self._videos) for name, sums in self._sums.items()}
            _describe(self._folder, self._features, self._fps, [self._count], [stats])
        size = sum(file.stat().st_size for file in self._folder.rglob("*") if file.is_file())
        return {"file": str(self._folder), "holds": self._count, "bytes": size}

    def close(self) -> None:
        for video in self._videos.values():
            video.close()
        if self._table is not None:
            self._table.close()

    def _write_rows(self) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        if not self._rows:
            return
        schema = _schema(self._features)
        columns = {name: [_plain(row[name]) for row in self._rows] for name in schema.names}
        if self._table is None:
            path = self._folder / _data_path(0)
            path.parent.mkdir(parents=True)
            self._table = pq.ParquetWriter(path, schema)
        self._table.write_table(pa.table(columns, schema))
        self._rows = []


def merge(folders: Sequence[Path], out: Path) -> int:
    """One data set of several, in this order; files are linked where that is possible.

    Args:
        folders: data sets of one episode each.
        out: new or empty.

    Returns:
        How many frames it has.

    Raises:
        UsageError: they differ in rate, size or what is in them, or `out` holds something.
        SagsError: one cannot be read, or it cannot be written.
    """
    import pyarrow.parquet as pq

    new_folder(out)
    infos = [json.loads((folder / "meta/info.json").read_text()) for folder in folders]
    lengths: list[int] = []
    stats: list[Stats] = []
    with writing(out):
        for number, (folder, info) in enumerate(zip(folders, infos, strict=True)):
            if (info["features"], info["fps"]) != (infos[0]["features"], infos[0]["fps"]):
                raise UsageError(
                    f"{folder} has pictures of another size or rate than {folders[0]}: one data set "
                    "holds one kind; give them vision.width, vision.height and source.rate that are the same"
                )
            source = pq.ParquetFile(folder / _data_path(0))
            path = out / _data_path(number)
            path.parent.mkdir(parents=True, exist_ok=True)
            with pq.ParquetWriter(path, source.schema_arrow) as writer:
                for group in range(source.num_row_groups):
                    writer.write_table(_renumbered(source.read_row_group(group), number, sum(lengths)))
            for eye in _videos_of(info["features"]):
                target = out / _video_path(eye, number)
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    target.hardlink_to(folder / _video_path(eye, 0))
                except OSError:
                    shutil.copyfile(folder / _video_path(eye, 0), target)
            lengths.append(info["total_frames"])
            stats.append(json.loads((folder / "meta/stats.json").read_text()))
        _describe(out, infos[0]["features"], infos[0]["fps"], lengths, stats)
    return sum(lengths)


def _renumbered(table: pa.Table, episode: int, before: int) -> pa.Table:
    import pyarrow as pa

    numbers = {"episode_index": 0, "index": before}
    for name, first in numbers.items():
        at = table.schema.get_field_index(name)
        old = np.asarray(table[name])
        new = old + first if name == "index" else np.full(len(old), episode)
        table = table.set_column(at, name, pa.array(new, pa.int64()))
    return table


# ---- what describes it -----------------------------------------------------------------------------------


def _features(size: tuple[int, int], eyes: Sequence[str], fps: int) -> dict[str, Any]:
    width, height = size
    coarse = [height // COARSE, width // COARSE]
    video = {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.fps": fps, "video.height": height, "video.width": width, "video.channels": 3,
            "video.codec": "mpeg4", "video.pix_fmt": "yuv420p", "video.is_depth_map": False,
            "has_audio": False,
        },
    }  # fmt: skip
    numbers = {
        DEPTH: ("float32", coarse, ["height", "width"]),
        TISSUE: ("uint8", coarse, ["height", "width"]),
        POSE: ("float32", [4, 4], None),
        POINTS: ("float32", [TRACKS, 3], None),
        VISIBILITY: ("float32", [TRACKS], None),
        "timestamp": ("float32", [1], None),
        **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), ("int64", [1], None)),
    }
    return {
        **dict.fromkeys(eyes, video),
        **{
            name: {"dtype": dtype, "shape": shape, "names": names}
            for name, (dtype, shape, names) in numbers.items()
        },
    }


def _videos_of(features: Mapping[str, Any]) -> list[str]:
    return [name for name, feature in features.items() if feature["dtype"] == "video"]


def _schema(features: Mapping[str, Any]) -> pa.Schema:
    import pyarrow as pa

    fields = []
    for name, feature in features.items():
        if feature["dtype"] != "video":
            kind = pa.type_for_alias(feature["dtype"].replace("float32", "float"))
            for _ in feature["shape"] if feature["shape"] != [1] else ():
                kind = pa.list_(kind)
            fields.append((name, kind))
    return pa.schema(fields)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _data_path(episode: int) -> str:
    return f"data/{_file(episode)}.parquet"


def _video_path(eye: str, episode: int) -> str:
    return f"videos/{eye}/{_file(episode)}.mp4"


def _file(episode: int) -> str:
    return f"chunk-{episode // FILES_PER_CHUNK:03d}/file-{episode % FILES_PER_CHUNK:03d}"


def _describe(
    folder: Path, features: Mapping[str, Any], fps: int, lengths: Sequence[int], stats: Sequence[Stats]
) -> None:
    """Write `meta/`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    meta = folder / "meta"
    (meta / "episodes/chunk-000").mkdir(parents=True)
    info = {
        "codebase_version": VERSION,
        "robot_type": "endoscope",
        "total_episodes": len(lengths),
        "total_frames": sum(lengths),
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features,
    }
    (meta / "info.json").write_text(json.dumps(info, indent=4), encoding="utf-8")
    merged = {name: _merged([each[name] for each in stats]) for name in stats[0]}
    (meta / "stats.json").write_text(json.dumps(merged, indent=4), encoding="utf-8")
    pq.write_table(_tasks(), meta / "tasks.parquet")
    rows = []
    begin = 0
    for episode, length in enumerate(lengths):
        where = {"chunk_index": episode // FILES_PER_CHUNK, "file_index": episode % FILES_PER_CHUNK}
        row: dict[str, Any] = {"episode_index": episode, "tasks": [TASK], "length": length}
        row |= {f"data/{name}": value for name, value in where.items()}
        row |= {"dataset_from_index": begin, "dataset_to_index": begin + length}
        for eye in _videos_of(features):
            row |= {f"videos/{eye}/{name}": value for name, value in where.items()}
            row |= {f"videos/{eye}/from_timestamp": 0.0, f"videos/{eye}/to_timestamp": length / fps}
        for name, values in stats[episode].items():
            row |= {f"stats/{name}/{stat}": value for stat, value in values.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        rows.append(row)
        begin += length
    pq.write_table(pa.Table.from_pylist(rows), meta / "episodes/chunk-000/file-000.parquet")


def _tasks() -> pa.Table:
    """As pandas writes a table whose index says the task: LeRobot looks tasks up by it."""
    import pyarrow as pa

    index = "__index_level_0__"
    columns = [
        {"name": name, "field_name": field, "pandas_type": kind, "numpy_type": stored, "metadata": None}
        for name, field, kind, stored in (
            ("task_index", "task_index", "int64", "int64"),
            (None, index, "unicode", "object"),
        )
    ]
    about = {"index_columns": [index], "columns": columns, "column_indexes": [], "pandas_version": "2.0"}
    tasks = pa.table({"task_index": pa.array([0]), index: pa.array([TASK])})
    return tasks.replace_schema_metadata({"pandas": json.dumps(about)})


class _Sums:
    """What the mean and spread of numbers [N, C] are made of; NaN is left out."""

    def __init__(self) -> None:
        self._count: F64 | float = 0.0
        self._sum: F64 | float = 0.0
        self._squares: F64 | float = 0.0
        self._least: F64 | float = np.inf
        self._most: F64 | float = -np.inf

    def add(self, values: F64) -> None:
        known = np.isfinite(values)
        self._count = self._count + known.sum(0)
        self._sum = self._sum + np.where(known, values, 0).sum(0)
        self._squares = self._squares + np.where(known, values**2, 0).sum(0)
        self._least = np.minimum(self._least, np.where(known, values, np.inf).min(0))
        self._most = np.maximum(self._most, np.where(known, values, -np.inf).max(0))

    def stats(self, picture: bool) -> dict[str, list[Any]]:
        """As LeRobot keeps them: of pictures [3, 1, 1], of all else [1]; 0 where nothing is known."""
        count = np.maximum(self._count, 1)
        mean = self._sum / count
        std = np.sqrt(np.maximum(self._squares / count - mean**2, 0))
        found = {"min": self._least, "max": self._most, "mean": mean, "std": std}
        shape = (3, 1, 1) if picture else (1,)
        plain = {
            name: np.where(np.isfinite(value), value, 0).reshape(shape).tolist()
            for name, value in found.items()
        }
        return plain | {"count": [int(np.max(self._count))]}


def _merged(stats: Sequence[dict[str, list[Any]]]) -> dict[str, list[Any]]:
    """Of several episodes, each weighed by its count."""
    values = {name: np.array([each[name] for each in stats], np.float64) for name in stats[0]}
    counts = values["count"].reshape(-1, *[1] * (values["mean"].ndim - 1))
    share = counts / max(1.0, float(counts.sum()))
    mean = (share * values["mean"]).sum(0)
    spread = (share * (values["std"] ** 2 + (values["mean"] - mean) ** 2)).sum(0)
    return {
        "min": values["min"].min(0).tolist(),
        "max": values["max"].max(0).tolist(),
        "mean": mean.tolist(),
        "std": np.sqrt(spread).tolist(),
        "count": [int(counts.sum())],
    }
