"""How a LeRobot data set is laid out and described: v3.0 (lerobot 0.4) and v2.1 (lerobot 0.2 and 0.3).

Source: `lerobot/datasets/utils.py` of lerobot 0.4.4 and 0.3.3. In both forms an episode has files of its own
here, so that episodes made apart are one data set once they lie in one folder.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sags_lab.lerobot.stats import Stats, merged
from sags_node.errors import UsageError, install
from sags_node.tools.export.played import TRACKS

if TYPE_CHECKING:
    import pyarrow as pa

Version = Literal["v3.0", "v2.1"]

PATHS: dict[str, dict[str, str]] = {  # version -> paths of files, as info.json gives them
    "v3.0": {
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    },
    "v2.1": {
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    },
}
FILES_PER_CHUNK = 1000
COARSE = 4  # depth and mask are stored at a fourth of the size: a frame takes 100 kB then, not 1.5 MB
LEFT, RIGHT = "observation.images.endoscope.left", "observation.images.endoscope.right"
DEPTH, TISSUE, POSE = "observation.depth", "observation.tissue", "observation.camera_pose"
POINTS, VISIBILITY = "observation.tracks", "observation.tracks_visibility"
NUMBERS = ("frame_index", "episode_index", "index", "task_index")
TASK = "observe the tissue"


def check_lerobot() -> None:
    """Check before long work that pyarrow is installed.

    Raises:
        UsageError: pyarrow is not installed.
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise UsageError(
            f"LeRobot data sets need pyarrow, which is not installed: {install('lab')}"
        ) from None


def data_path(version: str, episode: int) -> str:
    return PATHS[version]["data_path"].format(**_places(episode))


def video_path(version: str, eye: str, episode: int) -> str:
    return PATHS[version]["video_path"].format(video_key=eye, **_places(episode))


def _places(episode: int) -> dict[str, int]:
    chunk, file = divmod(episode, FILES_PER_CHUNK)
    return {"chunk_index": chunk, "file_index": file, "episode_chunk": chunk, "episode_index": episode}


def features_of(size: tuple[int, int], eyes: Sequence[str], fps: int) -> dict[str, Any]:
    """Return the features as info.json has them, for images of this size; sides of videos are even."""
    width, height = (side - side % 2 for side in size)
    coarse = [height // COARSE, width // COARSE]
    video = {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.fps": fps, "video.height": height, "video.width": width, "video.channels": 3,
            "video.codec": "h264", "video.pix_fmt": "yuv420p", "video.is_depth_map": False,
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
        **dict.fromkeys(NUMBERS, ("int64", [1], None)),
    }
    return {
        **dict.fromkeys(eyes, video),
        **{
            name: {"dtype": dtype, "shape": shape, "names": names}
            for name, (dtype, shape, names) in numbers.items()
        },
    }


def videos_of(features: Mapping[str, Any]) -> list[str]:
    return [name for name, feature in features.items() if feature["dtype"] == "video"]


def schema_of(features: Mapping[str, Any]) -> pa.Schema:
    """Return the schema of the Parquet files, which hold all but the videos."""
    import pyarrow as pa

    fields = []
    for name, feature in features.items():
        if feature["dtype"] != "video":
            kind = pa.type_for_alias(feature["dtype"].replace("float32", "float"))
            for _ in feature["shape"] if feature["shape"] != [1] else ():
                kind = pa.list_(kind)
            fields.append((name, kind))
    return pa.schema(fields)


def describe(
    folder: Path,
    version: str,
    features: Mapping[str, Any],
    fps: int,
    lengths: Sequence[int],
    stats: Sequence[Mapping[str, Stats]],
) -> None:
    """Write `meta/`.

    Args:
        lengths: frames of each episode.
        stats: of each episode, by feature.

    Raises:
        OSError: it cannot be written.
    """
    meta = folder / "meta"
    meta.mkdir()
    info: dict[str, Any] = {
        "codebase_version": version,
        "robot_type": "endoscope",
        "total_episodes": len(lengths),
        "total_frames": sum(lengths),
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK,
        "fps": fps,
        "splits": {"train": f"0:{len(lengths)}"},
        **PATHS[version],
        "features": features,
    }
    if version == "v2.1":
        info["total_videos"] = len(lengths) * len(videos_of(features))
        info["total_chunks"] = -(-len(lengths) // FILES_PER_CHUNK)
        _describe_v21(meta, lengths, stats)
    else:
        info |= {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200}  # LeRobot's defaults
        _describe_v30(meta, features, fps, lengths, stats)
    _write_json(meta / "info.json", info)
    _write_json(meta / "stats.json", {name: merged([each[name] for each in stats]) for name in stats[0]})


def _describe_v21(meta: Path, lengths: Sequence[int], stats: Sequence[Mapping[str, Stats]]) -> None:
    episodes = [{"tasks": [TASK], "length": length} for length in lengths]
    _write_lines(meta / "tasks.jsonl", [{"task_index": 0, "task": TASK}])
    _write_lines(meta / "episodes.jsonl", [{"episode_index": n} | each for n, each in enumerate(episodes)])
    _write_lines(
        meta / "episodes_stats.jsonl", [{"episode_index": n, "stats": each} for n, each in enumerate(stats)]
    )


def _describe_v30(
    meta: Path,
    features: Mapping[str, Any],
    fps: int,
    lengths: Sequence[int],
    stats: Sequence[Mapping[str, Stats]],
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = []
    begin = 0
    for episode, length in enumerate(lengths):
        where = {key: _places(episode)[key] for key in ("chunk_index", "file_index")}
        row: dict[str, Any] = {"episode_index": episode, "tasks": [TASK], "length": length}
        row |= {f"data/{name}": value for name, value in where.items()}
        row |= {"dataset_from_index": begin, "dataset_to_index": begin + length}
        for eye in videos_of(features):
            row |= {f"videos/{eye}/{name}": value for name, value in where.items()}
            row |= {f"videos/{eye}/from_timestamp": 0.0, f"videos/{eye}/to_timestamp": length / fps}
        for name, values in stats[episode].items():
            row |= {f"stats/{name}/{stat}": value for stat, value in values.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        rows.append(row)
        begin += length
    pq.write_table(_tasks(), meta / "tasks.parquet")
    (meta / "episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(rows), meta / "episodes/chunk-000/file-000.parquet")


def _tasks() -> pa.Table:
    """The tasks, as pandas writes a table whose index is the task: LeRobot looks tasks up by it."""
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


def _write_json(file: Path, value: Any) -> None:
    file.write_text(json.dumps(value, indent=4), encoding="utf-8")


def _write_lines(file: Path, values: Sequence[Any]) -> None:
    file.write_text("".join(json.dumps(value) + "\n" for value in values), encoding="utf-8")
