"""The C++ examples, written from the documents alone: one sees what the Python subscriber sees, one sends."""

import math
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import zmq
from command_line import killed
from independent_client import zmq_socket
from made_messages import changed, damaged, message_of
from places import ROOT
from running_node import RunningNode
from synthetic import HEIGHT, WIDTH, plane_result

from sags_node.config.schema import PushSource
from sags_node.messaging import content
from sags_node.messaging.control import ControlClient
from sags_node.messaging.received import ReceivedImage, TopicName
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.wire import encode
from sags_node.sources.push import PushedPictures
from sags_node.types import FrameResult

pytestmark = [pytest.mark.live, pytest.mark.beside]

SOURCE = ROOT / "examples/cpp"
HEADERS = "#include <zmq_addon.hpp>\n#include <msgpack.hpp>\n"
IMAGE = TopicName("left/render/image", ReceivedImage)
DEPTH = TopicName("left/render/depth", ReceivedImage)
LINE = re.compile(
    r"stamp_ns=(\d+) age_ms=(-?\d+) shape=(\d+)x(\d+) depth_mm=(\S+) rgba=(\d+),(\d+),(\d+),(\d+)\n"
)


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the programs, freshly built."""
    missing = [tool for tool in ("g++", "cmake", "pkg-config") if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"no C++ example without {', '.join(missing)}")
    compiler = ["g++", "-std=c++17", "-DMSGPACK_NO_BOOST", "-fsyntax-only", "-x", "c++", "-"]
    if subprocess.run(
        compiler, input=HEADERS, text=True, check=False, capture_output=True, timeout=300
    ).returncode:
        pytest.skip("no C++ example without the Debian packages cppzmq-dev and libmsgpack-cxx-dev")
    folder = tmp_path_factory.mktemp("cpp")
    for command in (
        ["cmake", "-S", SOURCE, "-B", folder, "-DCMAKE_CXX_FLAGS=-Werror"],
        ["cmake", "--build", folder],
    ):
        built = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
        assert built.returncode == 0, built.stdout + built.stderr
    return folder


@pytest.fixture(scope="module")
def read_depth(examples: Path) -> Path:
    return examples / "read_depth"


def running(*command: str | Path) -> AbstractContextManager[subprocess.Popen[str]]:
    return killed(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))


@pytest.fixture(scope="module")
def node(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningNode]:
    with RunningNode(phantom_session, tmp_path_factory.mktemp("node")) as one:
        yield one


def test_it_shows_what_the_python_subscriber_shows(read_depth: Path, node: RunningNode) -> None:
    seen: dict[int, tuple[ReceivedImage, ReceivedImage]] = {}
    with Subscriber([IMAGE, DEPTH], run_dir=node.run_dir) as subscriber:
        depth = subscriber.wait(DEPTH, 30)
        with running(read_depth, node.data, "10") as process:
            while process.poll() is None and depth is not None:
                frame = subscriber.aligned([IMAGE, DEPTH], depth.stamp_ns, timeout=1)
                if frame is not None:
                    seen[depth.stamp_ns] = frame[IMAGE], frame[DEPTH]
                depth = subscriber.wait(DEPTH, 30, after=depth)
            assert process.wait(30) == 0
            said, complaints = process.communicate()
    assert complaints == ""
    shown = LINE.findall(said)
    assert len(shown) == 10
    stamps = [int(row[0]) for row in shown]
    assert stamps == sorted(set(stamps))
    both = [row for row in shown if int(row[0]) in seen]
    assert len(both) >= 5
    for stamp, age_ms, height, width, depth_mm, *rgba in both:
        image, depth = seen[int(stamp)]
        assert (int(height), int(width)) == depth.array.shape == (256, 320)
        said_mm = math.nan if depth_mm == "unknown" else float(depth_mm)
        assert said_mm == pytest.approx(1000 * depth.array[128, 160], abs=1e-3, nan_ok=True)
        assert [int(channel) for channel in rgba] == image.array[128, 160].tolist()
        assert int(age_ms) >= 0


def test_it_says_stale_and_shows_nothing_while_no_frames_come(read_depth: Path, node: RunningNode) -> None:
    with ControlClient(run_dir=node.run_dir) as control, running(read_depth, node.data) as process:
        while not LINE.match(process.stdout.readline()):
            assert process.poll() is None
        control.request("pause")
        try:
            while not (line := process.stdout.readline()).startswith("stale: too old"):
                assert LINE.match(line)  # what was fresh still
            paused = time.time_ns()
        finally:
            control.request("resume")
        after = LINE.match(process.stdout.readline())
        while after is None:  # a little late at first, perhaps
            after = LINE.match(process.stdout.readline())
        assert int(after[1]) > paused - 1_000_000_000


def told(read_depth: Path, *messages: list[bytes]) -> tuple[str, str]:
    """What it says of one frame and complains of, when these come."""
    with zmq_socket(zmq.XPUB, "tcp://127.0.0.1:*", bind=True) as socket:
        with running(read_depth, socket.getsockopt_string(zmq.LAST_ENDPOINT), "1") as process:
            for _ in range(2):
                assert socket.poll(60_000) and socket.recv()[:1] == b"\x01"
            for parts in messages:
                socket.send_multipart(parts)
            said = process.communicate(timeout=30)
    assert process.returncode == 0
    return said


def test_hostile_messages_are_left_out(read_depth: Path) -> None:
    result = plane_result()
    depth = result.views["left"].depth.copy()
    depth[32, 48] = 0  # the centre is unknown
    result = replace(result, views={"left": replace(result.views["left"], depth=depth)})
    good = {name: parts_of(name, result) for name in (IMAGE, DEPTH)}
    bad = damaged(good[DEPTH], good[IMAGE][1])
    unasked = [good[DEPTH][0] + b"/more", *good[DEPTH][1:]]  # which the prefix brings; no mistake
    said, complaints = told(read_depth, *bad, unasked, good[IMAGE], good[DEPTH])
    assert complaints.count("left out: ") == len(bad)
    assert [row[4] for row in LINE.findall(said)] == ["unknown"]


def test_lengths_without_a_unit_are_not_said_to_be_millimetres(read_depth: Path) -> None:
    result = plane_result()
    whole = (parts_of(name, result) for name in (IMAGE, DEPTH))
    relative = ([topic, changed(meta, units="relative"), *rest] for topic, meta, *rest in whole)
    said, _ = told(read_depth, *relative)
    assert float(re.search(r" depth_no_unit=(\S+) ", said)[1]) == pytest.approx(
        result.views["left"].depth[HEIGHT // 2, WIDTH // 2], rel=1e-4
    )


def test_pictures_are_handed_in_and_a_wrong_size_is_told(examples: Path) -> None:
    """push_frames, written from docs/inputs.md alone."""
    source = PushedPictures(PushSource(endpoint="tcp://127.0.0.1:*"), (320, 240))
    with source:
        with running(examples / "push_frames", source.endpoint, "30", "320", "240") as process:
            frames = list(islice(source, 3))
            assert process.wait(30) == 0
        with running(examples / "push_frames", source.endpoint, "-1", "64", "48") as process:
            assert process.stdout is not None
            said = list(islice(process.stdout, 2))
        # For a second the eye is the first program's.
        assert "two programs send" in said[0] and "64x48 px, it must be 320x240" in said[-1]
    column, row = np.meshgrid(np.arange(320), np.arange(240))
    drawn = int(frames[0].left[0, 0, 0])
    assert np.array_equal(frames[0].left[..., 0], ((column + drawn) ^ row) & 255)
    assert frames[0].right is not None and frames[0].right[0, 0, 0] == drawn + 12


def parts_of(name: str, result: FrameResult) -> list[bytes]:
    """The parts of a message, with everything that belongs there."""
    said = content.FRAME_CONTENT[name](result)
    stamp_ns = result.pair.t_capture_ns
    return [
        bytes(part) for part in encode(message_of(name, said, stamp_ns=stamp_ns, publish_ns=time.time_ns()))
    ]
