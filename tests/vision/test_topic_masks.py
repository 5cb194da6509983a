"""Tissue masks from another process: a real node, and the example that this repository gives."""

import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import RUN_HERE
from places import ROOT
from waiting import START_SECONDS, until

from sags_node.messaging.address import NodeAddress
from sags_node.messaging.control import ControlClient
from sags_node.messaging.received import ReceivedImage, TopicName
from sags_node.messaging.stream import listen_to
from sags_node.messaging.subscriber import Subscriber

pytestmark = pytest.mark.live

EXAMPLE = ROOT / "examples/tissue_masks.py"
SEGMENT = runpy.run_path(str(EXAMPLE))["segment"]
PICTURE, MASK = (TopicName(f"left/{name}", ReceivedImage) for name in ("image_rect_color", "tissue_mask"))
DEPTH = TopicName("left/render/depth", ReceivedImage)
TOLERANCE = 0.25  # s


@contextmanager
def process(home: Path, *command: str) -> Iterator[None]:
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(home)}
    with subprocess.Popen([sys.executable, *command], env=environment, stdout=subprocess.DEVNULL) as running:
        try:
            yield
        finally:
            running.send_signal(signal.SIGINT)
            running.wait(30)


@pytest.fixture(scope="module")
def home(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A running node that takes masks from a topic on which nobody is yet."""
    home = tmp_path_factory.mktemp("masks")
    run = ["-m", "sags_node", "run", str(phantom_session), "source.loop:=true", "mapping.budget_ms:=20"]
    masks = {"method": "topic", "endpoint": f"ipc://{home}/sags/masks.ipc", "tissue_is": "white"}
    masks |= {"tolerance": str(TOLERANCE), "dilate": "0"}
    with process(home, *run, *RUN_HERE, *(f"vision.tissue.{key}:={value}" for key, value in masks.items())):
        until((home / "sags/sags.json").exists, START_SECONDS)
        with Subscriber(["tf"], run_dir=home / "sags") as subscriber:
            assert subscriber.wait("tf", START_SECONDS) is not None
        yield home


def warning(client: ControlClient) -> str:
    return str(client.request("get_status", timeout=30)["warnings"].get("mask", ""))


def masker(home: Path) -> Any:
    return process(home, str(EXAMPLE), "tcp://127.0.0.1:*")


@pytest.mark.fault("process: the one that makes masks ends")
def test_masks_come_and_go_and_the_frames_go_on(home: Path) -> None:
    run_dir = home / "sags"
    with ControlClient(run_dir=run_dir) as client, Subscriber([PICTURE, MASK], run_dir=run_dir) as subscriber:
        assert "no mask has come on masks/left/tissue_mask" in until(lambda: warning(client))
        with masker(home):
            until(lambda: not warning(client))
            until(lambda: fits(subscriber, frames=20) > 10)
        assert "older than the image" in until(lambda: warning(client))
        assert fits(subscriber, frames=10) < 5  # found without: other pixels
        # None waits for its mask: that would take `TOLERANCE` each time, by the node's own clock.
        assert client.request("get_status", timeout=30)["stage_ms"]["mask"] < 1e3 * TOLERANCE
        with masker(home):
            until(lambda: not warning(client))
            until(lambda: fits(subscriber, frames=10) > 5)


def fits(subscriber: Subscriber, frames: int) -> int:
    """In how many of so many frames the node's mask is the example's, made of an image not long before."""
    pictures: list[np.ndarray] = []
    last, count = None, 0
    for _ in range(frames):
        last = subscriber.wait(MASK, 60, after=last)
        picture = subscriber.latest(PICTURE)
        pictures = [*pictures, picture.array][-4:]
        made = [SEGMENT(shown) > 0 for shown in pictures]
        count += any(np.array_equal(mask, last.array > 0) for mask in made)
    return count


def test_the_picture_goes_out_before_its_frame_is_mapped(home: Path) -> None:
    """Once, and every frame's: so that a mask of it is there for the next frame."""
    sent: dict[str, dict[int, int]] = {PICTURE: {}, DEPTH: {}}
    sequence: list[int] = []
    for arrived in listen_to(NodeAddress(run_dir=home / "sags"), [PICTURE, DEPTH], 60.0):
        if len(sent[PICTURE].keys() & sent[DEPTH].keys()) > 20:
            break
        if arrived is not None:
            message, _ = arrived
            name = message.topic.removeprefix("sags/")
            assert message.meta.frame_id not in sent[name]
            sent[name][message.meta.frame_id] = message.meta.publish_ns
            if name == PICTURE:
                sequence.append(message.meta.seq)
    both = sorted(set(sent[PICTURE]) & set(sent[DEPTH]))
    assert np.diff(sequence).max() == 1
    ahead_ms = [(sent[DEPTH][frame] - sent[PICTURE][frame]) * 1e-6 for frame in both]
    assert np.median(ahead_ms) > 5
