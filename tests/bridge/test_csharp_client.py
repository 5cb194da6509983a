"""The C# client for Unity, compiled and run by Debian's mono: against a real gateway and a false one."""

import json
import re
import shutil
import struct
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bridging import SEEN, anchored, anchored_at, bridged, options_of, sockets
from command_line import killed
from places import ROOT
from synthetic import HEIGHT, WIDTH, at_frame, stream
from waiting import beside

pytest.importorskip("websockets", reason="no gateway without: pip install '.[bridges]'")

from websockets.sync.server import ServerConnection, serve

from sags_node.clients.bridge.web import WebOptions, run_web

pytestmark = [pytest.mark.live, pytest.mark.beside]

SOURCE = ROOT / "examples/unity"
UNITY = """
namespace UnityEngine {
    public class MonoBehaviour { public T GetComponent<T>() where T : class { return null; } }
    public class Texture {}
    public enum TextureFormat { RGBA32 }
    public class Texture2D : Texture {
        public Texture2D(int width, int height, TextureFormat format, bool mipChain) {}
        public int width, height;
        public void LoadRawTextureData(byte[] data) {}
        public void Apply() {}
    }
    public struct Rect { public Rect(float x, float y, float width, float height) {} }
    namespace UI {
        public class RawImage { public bool enabled; public Texture texture; public Rect uvRect; }
    }
}"""
LINE = re.compile(r"stamp_ns=(\d+) shape=(\d+)x(\d+) depth_(?:mm|no_unit)=(\S+) rgba=(\S+) anchors=(\S*)\n")


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    missing = [tool for tool in ("mcs", "mono") if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"no C# client without {', '.join(missing)} (Debian: mono-mcs mono-runtime)")
    if not list(Path("/usr/lib/mono").glob("*/System.Runtime.Serialization.dll")):
        pytest.skip("no C# client without Debian's libmono-system-runtime-serialization4.0-cil")
    built = tmp_path_factory.mktemp("csharp") / "sags.exe"
    compiled(SOURCE / "SagsClient.cs", SOURCE / "Program.cs", f"-out:{built}")
    return built


def compiled(*arguments: Path | str) -> None:
    command = ["mcs", "-warnaserror", "-r:System.Runtime.Serialization.dll", *arguments]
    told = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert told.returncode == 0, told.stdout + told.stderr


def running(program: Path, port: int) -> AbstractContextManager[subprocess.Popen[str]]:
    command = ["mono", program, f"ws://127.0.0.1:{port}/ws"]
    return killed(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))


def until_line(process: subprocess.Popen[str], start: str) -> str:
    guard = threading.Timer(60, process.kill)
    guard.start()
    try:
        while not (line := process.stdout.readline()).startswith(start):
            assert line, f"it ended, or waited in vain for {start}"
        return line
    finally:
        guard.cancel()


@pytest.mark.fault("gateway: the node behind it is started anew")
def test_it_shows_depth_colour_and_anchors_and_nothing_old(program: Path, tmp_path: Path) -> None:
    result = anchored()
    guessed = replace(result.anchors, depth_confidence=np.full(4, 0.25, np.float32))
    result, view = replace(result, anchors=guessed), result.views["left"]
    options = options_of(WebOptions, tmp_path, port=0)
    with bridged(run_web, options) as port, running(program, port) as process:
        with sockets(tmp_path) as node:
            with stream(node, lambda i: at_frame(result, i, time.time_ns())):
                found = LINE.fullmatch(until_line(process, "stamp_ns="))
                until_line(process, "stamp_ns=")
            assert "stale: too old" in until_line(process, "stale")
            with stream(node, anchored_at):  # and comes back
                until_line(process, "stamp_ns=")
        until_line(process, "stale")
        with sockets(tmp_path) as node, stream(node, anchored_at):  # another node
            until_line(process, "stamp_ns=")
    middle = (HEIGHT // 2, WIDTH // 2)
    _, height, width, depth_mm, rgba, anchors = found.groups()
    assert (int(height), int(width)) == (HEIGHT, WIDTH)
    assert float(depth_mm) == pytest.approx(1000 * view.depth[middle], abs=1e-3)
    assert rgba.split(",") == [*map(str, view.rgb[middle]), str(round(255 * view.alpha[middle]))]
    first = anchors.split(";")[0].split(":")
    assert list(map(float, first[2:])) == [1, 0.25], "seen, and its depth a guess"
    assert int(first[0]) == SEEN and float(first[1]) == pytest.approx(0.07) and len(anchors.split(";")) == 3


def test_the_part_for_unity_compiles(program: Path, tmp_path: Path) -> None:
    """Against the signatures that Unity's manual names; Unity itself is not here."""
    (tmp_path / "Unity.cs").write_text(UNITY)
    compiled("-d:UNITY_5_3_OR_NEWER", "-target:library", SOURCE / "SagsClient.cs", tmp_path / "Unity.cs",
             f"-out:{tmp_path / 'unity.dll'}")  # fmt: skip


def message(topic: str, encoding: str, shape: list[int], data: bytes, **changes: object) -> bytes:
    head = {"topic": topic, "encoding": encoding, "shape": shape, "stamp_ns": time.time_ns()}
    text = json.dumps({**head, "parts": [0, len(data)], **changes}).encode()
    return struct.pack("<I", len(text)) + text + data


def frame(stamp: int, columns: str = "x,y,z,id", anchors: bytes = b"", **said: object) -> list[bytes]:
    """All that the program shows of one frame, of 2 x 2 pixels."""
    width = columns.count(",") + 1
    pixels, metres = np.full((2, 2, 4), 9, np.uint8).tobytes(), np.full(4, 0.07, "<f4").tobytes()
    return [
        message("sags/left/render/image", "rgba8", [2, 2, 4], pixels, stamp_ns=stamp),
        message("sags/left/render/depth", "32FC1", [2, 2], metres, stamp_ns=stamp, **said),
        message("sags/anchors", columns, [len(anchors) // (4 * width), width], anchors, stamp_ns=stamp),
    ]


def answer(asked: dict[str, object]) -> dict[str, object]:
    """To a request for the clock."""
    clock = {"received_ns": time.time_ns(), "answered_ns": time.time_ns()}
    return {"id": asked["id"], "ok": True, "result": clock}


def attended(connection: ServerConnection, *before: bytes, **said: Any) -> None:
    """Sends `frame` each time that it is asked for the clock."""
    while True:
        asked = json.loads(connection.recv())
        if "op" in asked:
            connection.send(json.dumps(answer(asked)))
        for each in (*before, *frame(time.time_ns(), **said)):
            connection.send(each)


@contextmanager
def gateway(program: Path, attend: Callable[[ServerConnection], None]) -> Iterator[subprocess.Popen[str]]:
    """The program at a false gateway."""
    with serve(attend, "127.0.0.1", 0) as server, beside(server.serve_forever, server.shutdown):
        with running(program, server.socket.getsockname()[1]) as process:
            yield process


def test_a_false_gateway_does_not_end_it(program: Path) -> None:
    """Broken messages, then a true one over a new connection."""
    attempts: list[int] = []
    broken = [
        b"", b"\x01", b"\xff\xff\xff\xff", b"\x00\x00\x00\x7f", struct.pack("<I", 4) + b"none",
        message("t", "32FC1", [1, 1], bytes(4), parts=[-4, 8]),
        message("t", "32FC1", [1, 1], bytes(4), parts=[2**31 - 1, 2**31 - 1]),
    ]  # fmt: skip

    def attend(connection: ServerConnection) -> None:
        attempts.append(len(attempts))
        if attempts[-1] < len(broken):
            connection.send(broken[attempts[-1]])
            connection.recv()
        else:
            attended(connection, message("sags/left/render/image", "rgba8", [3, 2, 4], bytes(16)))  # left out

    with gateway(program, attend) as process:
        found = LINE.fullmatch(until_line(process, "stamp_ns="))
    assert found is not None and found[4] == "70" and found[5] == "9,9,9,9" and found[6] == ""
    assert len(attempts) > len(broken)


def test_what_an_older_node_does_not_send_is_not_sure(program: Path) -> None:
    """It is not what stands beside it: the last of the row before."""
    columns, rows = "x,y,z,id,u,v,visibility,confidence", np.zeros((2, 8), "<f4")
    rows[:, 3], rows[:, 6:] = np.array([3, 4], "<u4").view("<f4"), 1
    with gateway(program, partial(attended, columns=columns, anchors=rows.tobytes())) as process:
        found = LINE.fullmatch(until_line(process, "stamp_ns="))
    assert found is not None and found[6] == "3:0:1:0;4:0:1:0"


@pytest.mark.fault("gateway: falls silent without closing, to a client in C#")
def test_a_gateway_that_fell_silent_is_connected_to_again(program: Path) -> None:
    connections: list[int] = []

    def attend(connection: ServerConnection) -> None:
        connections.append(len(connections))
        while connections[-1] == 0:
            connection.recv()
        attended(connection)

    with gateway(program, attend) as process:
        until_line(process, "stamp_ns=")


@pytest.mark.fault("link: slow, to a client in C#")
@pytest.mark.parametrize("late", [1.2, 2.2])
def test_pictures_that_come_late_are_old_also_where_the_clock_s_answers_are_as_late(
    program: Path, late: float
) -> None:
    timely: list[int] = []  # ns; when the link has become quick

    def attend(connection: ServerConnection) -> None:
        due: deque[tuple[int, dict[str, object]]] = deque()
        answers = 0
        while True:
            with suppress(TimeoutError):
                asked = json.loads(connection.recv(timeout=0.05))
                if "op" in asked:
                    due.append((time.time_ns(), answer(asked)))
            behind = 0 if timely else int(late * 1e9)
            while due and due[0][0] + behind <= time.time_ns():
                connection.send(json.dumps(due.popleft()[1]))
                answers += 1
            for each in frame(time.time_ns() - behind):
                connection.send(each)
            if answers == 3 and not timely:
                timely.append(time.time_ns())

    with gateway(program, attend) as process:
        found = LINE.fullmatch(until_line(process, "stamp_ns="))
    assert found is not None and timely and int(found[1]) >= timely[0]


def test_lengths_without_a_unit_are_not_said_to_be_millimetres(program: Path) -> None:
    with gateway(program, partial(attended, units="relative")) as process:
        assert " depth_no_unit=0.07 " in until_line(process, "stamp_ns=")
