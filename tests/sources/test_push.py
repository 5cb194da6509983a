"""Images handed in over ZeroMQ, by processes and by hand."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import cv2
import msgpack
import numpy as np
import pytest
import zmq
from independent_client import zmq_socket
from live_taking import Taker
from made_messages import MS, meta
from places import ROOT
from sending import sending
from stereo_sender import paint_number
from waiting import until

from sags_node.client import ClientKeys, FrameSender, PoseSender
from sags_node.config.schema import PushSource
from sags_node.errors import UsageError
from sags_node.messaging import cdr
from sags_node.messaging.security import read_key_pair, write_key_pair
from sags_node.messaging.wire import Message, encode
from sags_node.sources.push import PushedPictures
from sags_node.types import U8

pytestmark = pytest.mark.live

ANYWHERE = "tcp://127.0.0.1:*"


@pytest.fixture
def source() -> Iterator[PushedPictures]:
    made = PushedPictures(PushSource(endpoint=ANYWHERE), (160, 120))
    with made:
        yield made


@pytest.fixture
def short_silence(monkeypatch: pytest.MonkeyPatch) -> float:
    """s: a little more than between two receipts."""
    monkeypatch.setattr("sags_node.messaging.sender.SILENT", 1.2)
    return 1.2


def numbered(number: int, width: int = 160) -> U8:
    picture = np.full((120, width, 3), 90, np.uint8)
    for half in np.split(picture, width // 160, axis=1):
        paint_number(half, number)
    return picture


def send_until_told(sender: FrameSender, words: str, *pictures: U8 | bytes) -> None:
    """Send pairs until the node says so of them; that they are old is said first where all stood still."""

    def told() -> bool:
        sender.send(*pictures)
        time.sleep(0.05)
        return sender.problem is not None and words in sender.problem

    until(told)


def test_one_eye_by_one_and_side_by_side_make_pairs() -> None:
    source = PushedPictures(PushSource(endpoint=ANYWHERE, rate=1), (160, 120))
    with Taker(source) as taker, FrameSender(source.endpoint) as one, FrameSender(source.endpoint) as other:
        stamp = time.time_ns()
        one.send_eye("left", numbered(5), stamp)
        other.send_eye("right", numbered(5), stamp)
        until(lambda: len(taker.numbers) == 1)
        until(lambda: one.send_side_by_side(numbered(6, 320)) and (6, 6) in taker.numbers)  # a second later
        files = [cv2.imencode(".png", numbered(7))[1].tobytes()] * 2
        one.send(*files)
        until(lambda: (7, 7) in taker.numbers)
        one.send(*[cv2.cvtColor(numbered(8), cv2.COLOR_RGB2BGRA)] * 2, encoding="bgra8")
        until(lambda: (8, 8) in taker.numbers)
        assert list(dict.fromkeys(taker.numbers)) == [(n, n) for n in (5, 6, 7, 8)]


@pytest.mark.fault("network: two programs send images of one eye")
def test_pictures_of_two_senders_are_not_mixed(source: PushedPictures) -> None:
    with Taker(source) as taker, FrameSender(source.endpoint) as second:
        with FrameSender(source.endpoint) as first:
            until(lambda: first.send(numbered(1), numbered(1)) and taker.numbers)

            def told() -> bool:
                first.send(numbered(1), numbered(1))
                second.send_side_by_side(numbered(2, 320))
                return all("two programs send the" in str(one.problem) for one in (first, second))

            until(told)
            assert [finding.code for finding in source.findings] == ["two_senders"]
        assert set(taker.numbers) == {(1, 1)}
        until(lambda: second.send(numbered(2), numbered(2)) and (2, 2) in taker.numbers)
        until(lambda: not source.findings)
    assert set(taker.numbers) == {(1, 1), (2, 2)}


def test_each_sender_is_told_what_is_no_picture_of_an_eye(source: PushedPictures) -> None:
    wrong = {
        "images come on NAME/left/image_raw": ("middle/image_raw", numbered(1), "rgb8"),
        "'32FC1' is not read; known encodings": ("left/image_raw", np.zeros((120, 160), np.float32), "32FC1"),
        "159 px wide, which is odd": ("stereo/image_raw", numbered(1)[:, :159].copy(), "rgb8"),
    }
    with ExitStack() as stack:  # of plain sockets: `FrameSender` would refuse to send it
        senders = {words: stack.enter_context(zmq_socket(zmq.DEALER, source.endpoint)) for words in wrong}
        told: dict[str, str] = {}

        def send() -> bool:
            now = time.time_ns()
            for words, (name, array, encoding) in wrong.items():
                body, socket = cdr.image(array, encoding, now), senders[words]
                about = meta(1, now / MS, encoding=encoding, shape=list(body.shape), dtype=body.dtype)
                socket.send_multipart(encode(Message(f"camera/{name}", about, body.parts)))
                while socket.poll(50):
                    problem = msgpack.unpackb(socket.recv())["problem"]
                    told.update({words: problem} if problem else {})
            return told.keys() == wrong.keys()

        until(send)
        for words, problem in told.items():
            assert words in problem and "\n" not in problem


@pytest.mark.fault("image: a sender's has the wrong size")
def test_wrong_sizes_damaged_files_and_messages_are_told_and_do_no_harm(source: PushedPictures) -> None:
    with zmq_socket(zmq.DEALER, source.endpoint) as stranger, FrameSender(source.endpoint) as sender:
        for parts in ([b""], [b"x"] * 9, [b"a/left/image_raw", b"\xc1", b"data"], [b"t"] * 100):
            stranger.send_multipart(parts)
        send_until_told(sender, "damaged", b"\xff\xd8 no JPEG", b"\xff\xd8 no JPEG")
        send_until_told(sender, "320x120 px, it must be 160x120", *[numbered(1, 320)] * 2)
        assert sender.receipt is not None and sender.receipt.refused > 0 and sender.receipt.taken == 0
        until(lambda: [finding.code for finding in source.findings] == ["sent_refused"])
        assert stranger.poll(60_000)


def test_only_listed_keys_get_in_and_other_machines_need_keys(tmp_path: Path) -> None:
    for name in ("node", "friend", "stranger"):
        write_key_pair(tmp_path, name)
    said = {"key": tmp_path / "node.key", "allow": (tmp_path / "friend.pub",)}
    source = PushedPictures(PushSource(endpoint=ANYWHERE, **said), (160, 120))

    node = read_key_pair(tmp_path / "node.key").public

    def sender(name: str) -> FrameSender:
        return FrameSender(source.endpoint, keys=ClientKeys(read_key_pair(tmp_path / f"{name}.key"), node))

    with Taker(source) as taker:
        with sender("stranger") as stranger:
            send_until_told(stranger, "refuses this key", numbered(1), numbered(1))
        with FrameSender(source.endpoint) as keyless:
            send_until_told(keyless, "", numbered(1), numbered(1))
            assert "wants a key" in str(keyless.problem) or keyless.receipt is None
        assert taker.numbers == []
        with sender("friend") as friend:
            friend.send(numbered(3), numbered(3))
            until(lambda: taker.numbers == [(3, 3)])
    with pytest.raises(UsageError, match=r"source\.key and source\.allow"):
        PushedPictures(PushSource(endpoint="tcp://*:5558"))


def test_a_sender_never_waits_for_a_node_that_is_away() -> None:
    with FrameSender("tcp://127.0.0.1:1") as sender:
        for _ in range(100):
            sender.send(numbered(1), numbered(1))
        assert sender.left_out >= 200 - 4


@pytest.mark.fault("network: the node that images are sent to is not there, or has gone")
def test_a_node_that_does_not_answer_is_told_and_gets_nothing_old(short_silence: float) -> None:
    with PushedPictures(PushSource(endpoint=ANYWHERE), (160, 120)) as source:
        endpoint = source.endpoint
    with FrameSender(endpoint) as sender, PoseSender(endpoint) as poses:
        send_until_told(sender, "no answer", numbered(1), numbered(1))
        assert "source.kind:=push" in str(sender.problem) and sender.left_out > 0
        until(lambda: poses.send(np.eye(4)) or "robot.kind:=push" in str(poses.problem))
        came = PushedPictures(PushSource(endpoint=endpoint), (160, 120))
        with Taker(came) as taker:

            def answered() -> bool:
                sender.send(numbered(2), numbered(2))
                return sender.problem is None and bool(taker.numbers)

            until(answered)
        assert set(taker.numbers) == {(2, 2)}
        assert sender.receipt is not None and sender.receipt.refused == 0
        send_until_told(sender, "no answer", numbered(3), numbered(3))


def test_a_sender_that_sends_nothing_misses_no_answer(source: PushedPictures, short_silence: float) -> None:
    with FrameSender(source.endpoint) as sender:
        assert sender.send(numbered(1), numbered(1))  # the first pair, too
        until(lambda: sender.problem is None and sender.receipt)
        time.sleep(short_silence + 0.5)
        assert sender.problem is None


def test_the_sender_of_the_phantom_ends_with_ctrl_c_and_explains_itself(tmp_path: Path) -> None:
    script = [sys.executable, ROOT / "examples/send_phantom.py"]
    said = subprocess.run([*script, "--help"], capture_output=True, text=True, check=True, timeout=60).stdout
    assert "\n    python examples/send_phantom.py push\n" in said
    command = [*script, "push", "--size", "160", "128", "--endpoint", f"ipc://{tmp_path}/in"]
    with sending(command, stderr=subprocess.PIPE) as process:
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=30)[1] == b"" and process.returncode == 130
