"""`sags export --sequence`: whole splat files, one a frame, that an interrupted export goes on with."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import open3d
import pytest

from sags_node.errors import SagsError, UsageError
from sags_node.model.ply import write_ply
from sags_node.tools.export import sequence
from sags_node.tools.export.scene import Scene
from sags_node.types import Camera, Gaussians

CAMERA = Camera(64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), np.eye(4))
FRAMES = 6


def scenes(count: int = FRAMES) -> Iterator[Scene]:
    """A patch that moves to the right, frame by frame; the first shows nothing yet."""
    rng = np.random.default_rng(0)
    places = np.concatenate([rng.uniform(-0.01, 0.01, (400, 2)), np.full((400, 1), 0.06)], 1)
    for frame in range(count):
        size = 0 if frame == 0 else 400
        yield Scene(
            Gaussians(
                (places[:size] + np.array([0.004 * frame, 0, 0])).astype(np.float32),
                np.tile(np.array([1, 0, 0, 0], np.float32), (size, 1)),
                np.full((size, 3), 6e-4, np.float32),
                np.full(size, 0.9, np.float32),
                np.full((size, 3), 0.9, np.float32),
                np.arange(size),
            ),
            CAMERA,
            frame * 33_000_000,
        )


def written(folder: Path, count: int = FRAMES) -> list[dict[str, Any]]:
    return sequence.write_sequence(folder, scenes(count), 30.0, count, lambda *said: None)


def test_every_frame_that_shows_something_is_a_file_and_the_video_comes_back(tmp_path: Path) -> None:
    sequence.check_sequence(tmp_path / "out", {"session": "a"}, force=False)
    frames, loop = written(tmp_path / "out")
    assert frames["holds"] == FRAMES - 1 and loop["holds"] == 2 * (FRAMES - 1) - 2
    for frame in range(1, FRAMES):
        cloud = open3d.io.read_point_cloud(tmp_path / f"out/frame_{frame:05d}.ply")
        assert np.asarray(cloud.points)[:, 0].mean() == pytest.approx(0.004 * frame, abs=1e-3)
    capture, middles = cv2.VideoCapture(str(tmp_path / "out/loop.mp4")), []
    while (read := capture.read())[0]:
        bright = np.argwhere(read[1][..., 0] > 128)
        middles.append(bright[:, 1].mean())
    assert len(middles) == loop["holds"]
    steps = np.diff([*middles, middles[0]])
    assert (steps[: FRAMES - 2] > 0).all() and (steps[FRAMES - 2 :] < 0).all()  # there, and back to the first


@pytest.mark.fault("disk: full while frames are exported")
def test_an_export_that_a_full_disk_ended_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = write_ply
    left = [3]

    def full(path: Path, gaussians: Gaussians) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise SagsError(f"cannot write {path}: No space left on device")
        real(path, gaussians)

    monkeypatch.setattr(sequence, "write_ply", full)
    sequence.check_sequence(tmp_path, {"session": "a"}, force=False)
    with pytest.raises(
        SagsError, match=r"No space left on device.*3 frames are there; the same command goes on"
    ):
        written(tmp_path)
    done = sorted(file.name for file in tmp_path.iterdir())
    assert done == [*(f"frame_{n:05d}.ply" for n in (1, 2, 3)), "sequence.json"]  # nothing half written
    stamps = {name: (tmp_path / name).stat().st_mtime_ns for name in done[:3]}

    monkeypatch.setattr(sequence, "write_ply", real)
    sequence.check_sequence(tmp_path, {"session": "a"}, force=False)
    assert written(tmp_path)[0]["holds"] == FRAMES - 1
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in stamps} == stamps


def test_files_of_something_else_stay_unless_forced(tmp_path: Path) -> None:
    sequence.check_sequence(tmp_path, {"session": "a"}, force=False)
    written(tmp_path)
    with pytest.raises(UsageError, match="another sequence"):
        sequence.check_sequence(tmp_path, {"session": "b"}, force=False)
    assert (tmp_path / "frame_00001.ply").exists()
    sequence.check_sequence(tmp_path, {"session": "b"}, force=True)
    assert not (tmp_path / "frame_00001.ply").exists()
    foreign = tmp_path / "theirs"
    foreign.mkdir()
    (foreign / "note.txt").write_text("mine")
    with pytest.raises(UsageError, match="not empty"):
        sequence.check_sequence(foreign, {"session": "a"}, force=False)


def test_a_recording_that_shows_nothing_is_an_error(tmp_path: Path) -> None:
    sequence.check_sequence(tmp_path, {"session": "a"}, force=False)
    with pytest.raises(SagsError, match="no frame shows anything"):
        written(tmp_path, count=1)
