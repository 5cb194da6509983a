"""What every live input does, 2 x 1280x1024 at 30 Hz: pairs as sent, nothing old, and it comes again.

For cameras of the kernel see `test_v4l2.py` and `test_v4l2_vivid.py`.
"""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import cv2
import pytest
from command_line import RUN_HERE
from gstreamer import BALL, apart, ball_moment, kill_pipelines, need_gstreamer
from places import ROOT, SESSION
from sending import sending, stereo_sender
from stereo_sender import read_number
from waiting import START_SECONDS, until

from sags_node.node.node import Node
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.pipeline.warm_up import warm_up
from sags_node.rig import already_rectified, load_rig, resized_rig, save_rig
from sags_node.sources.push import PushedPictures
from sags_node.types import U8, FrameResult, StereoFrame

pytestmark = pytest.mark.live

DOMAIN = 60 + os.getpid() % 40  # away from nodes of this machine, and from tests of another checkout
SMALL = ["vision.width:=320", "vision.height:=256", "mapping.max_gaussians:=2000"]
SLOW, STALL = 3, 40
PAUSES = [SLOW] * 8 + [STALL]  # of the first frames: each lasts until so many others were left out
CAMERA = f"{BALL} ! video/x-raw,format=RGB,width=1280,height=1024,framerate=30/1"


class Shown(NamedTuple):
    number: int
    stamp_ns: int
    sent_ns: int
    moment: float  # of the sender's second, as the image itself shows it
    right_moment: float
    epoch: int


def painted_moment(picture: U8) -> float:
    """As `stereo_sender.py` with `clock=1` paints it, at a quarter of the size."""
    return read_number(cv2.resize(picture, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)) * 1e-3 % 1


@contextmanager
def running(
    way: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[Node, list[int], list[Shown], Callable[[], AbstractContextManager[object]]]]:
    """A node whose mapper pauses, the frames that it maps (numbers) and shows, and what sends to it."""
    rig = already_rectified(resized_rig(load_rig(SESSION / "calib"), 4))  # so that images stay to the pixel
    save_rig(rig, folder / "rig")
    launch, said, moment = {
        "gst": ("gst_test", [f"source.launch:={CAMERA} ! tee name=t  t. ! left.  t. ! right."], ball_moment),
        "push": ("push", ["source.endpoint:=tcp://127.0.0.1:*"], painted_moment),
        "ros2": ("ros2", [f"source.domain:={DOMAIN}"], painted_moment),
    }[way]
    said = [*said, f"rig:={folder / 'rig'}", f"publish.run_dir:={folder / 'run'}", *RUN_HERE, *SMALL]
    opened = open_session(ROOT / f"launch/{launch}.yaml", said)
    warm_up(opened.config)
    pauses, process = iter(PAUSES), Pipeline.process

    def slowly(pipeline: Pipeline, pair: StereoFrame, *arguments: Any) -> FrameResult:
        mapped.append(pair.frame_id)
        due = node.dropped["capture"] + next(pauses, 0)
        until(lambda: node.dropped["capture"] >= due)
        return process(pipeline, pair, *arguments)

    monkeypatch.setattr(Pipeline, "process", slowly)
    mapped: list[int] = []
    shown: list[Shown] = []

    def note(result: FrameResult, latency_ms: float) -> None:
        pair = result.pair
        moments = moment(pair.left), moment(pair.right)
        shown.append(Shown(pair.frame_id, pair.t_capture_ns, time.time_ns(), *moments, result.epoch))

    def sender() -> AbstractContextManager[object]:
        if way == "gst":
            return nullcontext()  # the node's own pipeline
        where = opened.source.endpoint if isinstance(opened.source, PushedPictures) else DOMAIN
        return sending(stereo_sender("push" if way == "push" else "dds", where, "clock=1"))

    node = Node(opened.config, opened.rig, opened.source, note)
    node.start()
    try:
        yield node, mapped, shown, sender
    finally:
        node.stop()


@pytest.mark.fault("process: what sends images is killed, the mapping is slow and stalls")
@pytest.mark.fault("mapping: stalls for some seconds")
@pytest.mark.fault("process: the camera's pipeline is killed")
@pytest.mark.parametrize("way", ["gst", "push", "ros2"])
def test_a_stalled_mapper_shows_nothing_old_and_a_killed_source_comes_again(
    way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if way == "gst":
        need_gstreamer()
    if way == "ros2":
        pytest.importorskip("cyclonedds", reason="ROS 2 needs: pip install '.[ros2]'")
    with running(way, tmp_path, monkeypatch) as (node, mapped, shown, sender):
        with sender():
            until(lambda: shown, START_SECONDS)
            until(lambda: len(shown) > len(PAUSES) + 10)
            until_killed = list(shown)
            if way == "gst":
                kill_pipelines()
        killed = time.time_ns()
        with sender():
            until(lambda: shown[-1].stamp_ns > killed)
        dropped = sum(node.health().dropped.values())
    # What came meanwhile is left out; an old image keeps its old stamp.
    for pause, (one, other) in zip(PAUSES, pairwise(mapped), strict=False):
        assert other - one > pause
    (stalled,) = (one for one in until_killed if one.number == mapped[len(PAUSES) - 1])
    assert (stalled.sent_ns - stalled.stamp_ns) * 1e-9 > STALL / 30 / 2
    # A stamp is when an image came: of single ones a busy machine makes anything.
    assert median(apart(one.stamp_ns * 1e-9, one.moment) for one in until_killed) < 0.25
    assert all(one.moment == one.right_moment for one in shown)
    assert all(one.stamp_ns < other.stamp_ns for one, other in pairwise(shown))
    assert {one.epoch for one in shown} == {0}
    assert dropped >= sum(PAUSES)  # and that is said
