"""dVRK sessions as sources: stamps of the sidecar for the pictures of its video."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_files import MS, START, picture
from dvrk_files import frame_record, write_session

from sags_node.cli.launching import split
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import DvrkSource, LaunchConfig
from sags_node.errors import UsageError
from sags_node.sources.replay import Replay


@pytest.mark.parametrize("order", ["LR", "RL"])
def test_a_dvrk_session(order: str, tmp_path: Path) -> None:
    frames = [frame_record(number) for number in range(8)]
    frames[3] = frame_record(3, left_source_ns=None)
    frames[5] = frame_record(5, left_source_ns=None, right_source_ns=None)
    folder = write_session(tmp_path / "session", frames, order=order)
    for given in (folder, folder / "stereo.json"):
        assert isinstance(load_launch(given).source, DvrkSource)
    with Replay(DvrkSource(path=folder, pace="step")) as source:
        played = list(source)
        assert source.rate == pytest.approx(25, rel=0.1)
    stamps = [((f.t_capture_ns - START) // MS, (f.t_capture_right_ns - START) // MS) for f in played]
    assert stamps == [(0, 3), (40, 43), (80, 83), (123, 123), (160, 163), (209, 209), (240, 243), (280, 283)]
    for frame in played:
        assert frame.right is not None and abs(float(frame.right.mean()) - 200) < 8
    assert np.abs(played[6].left.astype(int) - picture(6, 0)).mean() < 15


def test_a_dvrk_video_with_other_frames_than_its_sidecar(tmp_path: Path) -> None:
    """The encoder made 25 Hz of frames of which two never came."""
    frames = [frame_record(number) for number in (0, 1, 2, 5, 6, 7)]
    folder = write_session(tmp_path / "session", frames)
    with Replay(DvrkSource(path=folder, pace="step")) as source:
        stamps = [(frame.t_capture_ns - START) // MS for frame in source]
    assert stamps == [0, 40, 80, 80, 200, 200, 240, 280]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"type": "dvrk_data:sidecar@1.0.0"}, "is of type 'dvrk_data:sidecar@1.0.0'"),
        ({"frames": []}, "lists no frames"),
        ({"frames": [{"cpu": 3}]}, r"not a dvrk_data:video_sidecar@1\.0\.0 file: .*cpu"),
        ({"frames": [frame_record(0), frame_record(0, left_source_ns=-5)]}, "not a dvrk_data"),
        ({"frames": [frame_record(n) for n in (0, 1, 2, 4, 3, 5, 6, 7)]}, "frame 4 lies before"),
        ({"side_by_side": "undefined"}, "set source.side_by_side to LR or RL"),
        ({"video_file": "../../other.mp4"}, "other.mp4 does not exist"),
    ],
)
def test_a_wrong_sidecar(change: dict[str, Any], said: str, tmp_path: Path) -> None:
    folder = write_session(tmp_path / "session", [frame_record(number) for number in range(8)])
    file = folder / "stereo.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    with pytest.raises(UsageError, match=said):
        Replay(DvrkSource(path=file))


def test_a_session_as_users_give_it(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "session", [frame_record(number) for number in range(8)])
    path, overrides = split([str(folder), "source.side_by_side:=RL"])
    config = load_launch(path, overrides)
    assert isinstance(config, LaunchConfig) and isinstance(config.source, DvrkSource)
    assert config.source.side_by_side == "RL"
    with pytest.raises(UsageError, match="one sidecar of a stereo video is needed, there are: none"):
        Replay(DvrkSource(path=tmp_path))
