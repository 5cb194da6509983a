"""A recording that nobody has calibrated plays, and nothing of it passes for metres."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import figures_of, ran, refused, sags
from running_node import RunningNode

from sags_node.client import ControlClient, ReceivedCloud, ReceivedImage, ReceivedText, Subscriber, TopicName
from sags_node.confidence import SURE
from sags_node.config.launch_file import load_launch
from sags_node.sources.source import recorded_rig

pytestmark = [pytest.mark.live, pytest.mark.usefixtures("run_dir")]
DEPTH, CONFIDENCE = (
    TopicName(f"left/render/{name}", ReceivedImage) for name in ("depth", "depth_confidence")
)
CLOUDS = [TopicName(name, ReceivedCloud) for name in ("points", "splats", "anchors")]
STATUS = TopicName("status", ReceivedText)


@pytest.fixture
def two_videos(user_files: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "two"
    folder.mkdir()
    for name in ("left.mp4", "right.mp4"):
        shutil.copy(user_files / name, folder)
    return folder


def test_every_message_says_that_lengths_have_no_unit_and_none_is_sure(
    two_videos: Path, tmp_path: Path
) -> None:
    with (
        RunningNode(two_videos, tmp_path) as node,
        ControlClient(run_dir=node.run_dir) as control,
        Subscriber([DEPTH, CONFIDENCE, *CLOUDS], run_dir=node.run_dir) as subscriber,
    ):
        assert subscriber.wait(DEPTH, 60) is not None
        pinned = control.request("add_anchor", {"u": 160, "v": 128})
        assert 0 < pinned["depth_confidence"] < SURE
        assert control.request("get_health")["warnings"].count("uncalibrated") == 1
        anchors = subscriber.wait(CLOUDS[2], 20)
        while anchors is not None and not len(anchors.points):
            anchors = subscriber.wait(CLOUDS[2], 20, after=anchors)
        shown = [subscriber.wait(name, 20) for name in (DEPTH, CONFIDENCE, *CLOUDS[:2])]
        assert anchors is not None and not any(each is None or each.metric for each in (anchors, *shown))
        depth, confidence, points, splats = shown
        assert isinstance(depth, ReceivedImage) and np.isfinite(depth.array).mean() > 0.5
        assert isinstance(confidence, ReceivedImage) and 0 < confidence.array.max() < SURE
        assert isinstance(points, ReceivedCloud) and isinstance(splats, ReceivedCloud)
        for cloud in (points, splats):
            assert 0 < np.nanmax(cloud.points["confidence"]) < SURE
        assert (anchors.points["depth_confidence"] < SURE).all()
        status = subscriber.wait(STATUS, 20)
        assert status is not None and "no unit" in status.warnings()["uncalibrated"]
        ipc = ("--endpoint", f"ipc://{node.run_dir}/sags.ipc")
        listed = figures_of("anchor", "list", *ipc, "--json")
        assert [row["unit"] for row in listed] == [None]
        assert "x y z have no unit" in sags("anchor", "list", *ipc).stdout
        assert figures_of("topic", "echo", str(DEPTH), "--once", *ipc, "--json")["units"] == "relative"
        refused(1, "export", "--mesh", tmp_path / "now.ply", *ipc, said=("no calibration", "no unit"))
        bag = tmp_path / "bag"
        assert figures_of("bag", "record", "-o", bag, *ipc, "--seconds", "3", "--json")["messages"] > 0
    assert recorded_rig(load_launch(bag).source) is None  # as ROS says it of cameras that nobody calibrated


def test_it_is_said_at_the_start_and_what_promises_metres_is_refused(two_videos: Path) -> None:
    code, _, said = ran("run", two_videos, "source.pace:=fast", "publish.data:=[]", "publish.control:=null")
    assert code == 0
    assert "no calibration: 60 degrees across are guessed, depth has no unit" in said
    refused(2, "eval", two_videos, said=("no calibration: set rig",))
    played = sags("run", two_videos / "left.mp4")
    assert played.exit_code == 2 and "one eye is shown" in played.stderr
