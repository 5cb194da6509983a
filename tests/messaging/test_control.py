"""Requests to the node over a real socket, sane and insane."""

import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import independent_client as client
import msgpack
import pytest
import zmq
from ports import free_port
from synthetic import publisher
from waiting import repeating, until

from sags_node.errors import SagsError, UsageError
from sags_node.messaging.control import MAX_PENDING, ControlClient, Handler
from sags_node.node.operations import Requests

pytestmark = pytest.mark.live

GUARD_MS = 60_000  # against waiting for ever


def refuse(args: dict[str, Any]) -> Any:
    raise SagsError("mapping.nothing cannot be changed")


@contextmanager
def node(run_dir: Path, handlers: dict[str, Handler]) -> Iterator[str]:
    """A publisher that answers from its own thread; gives the control endpoint."""
    with publisher(run_dir, handlers) as running, repeating(lambda _: running.poll(20)):
        yield str(running.connection.control)


def test_results_and_errors_come_back(tmp_path: Path) -> None:
    """Also to a client without our code."""
    handlers: dict[str, Handler] = {
        "double": lambda args: {"twice": args["x"] * 2},
        "refuse": refuse,
        "broken": lambda args: args["missing"],
        "unsendable": lambda args: object(),
    }
    with node(tmp_path / "run", handlers) as endpoint, ControlClient(endpoint) as asker:
        assert asker.request("ping") == "pong"
        assert asker.request("double", {"x": 21}) == {"twice": 42}
        for op, said in (
            ("refuse", r"refuse: mapping\.nothing cannot be changed"),
            ("broken", "KeyError"),
            ("unsendable", "internal error"),
            ("doubel", r"unknown op 'doubel'.*double"),
        ):
            with pytest.raises(SagsError, match=said):
                asker.request(op)
        for unsendable in (2**70, "\udcff", object()):
            with pytest.raises(UsageError, match="ping: what is asked cannot be sent"):
                asker.request("ping", {"x": unsendable})
        assert client.request(endpoint, "ping", {}) == {"v": "1.0", "id": 7, "ok": True, "result": "pong"}
        for op in ("ping", "get_clock"):  # they have no arguments
            assert "unknown field `x`" in client.request(endpoint, op, {"x": 1})["error"]
        with client.zmq_socket(zmq.REQ, endpoint) as plain:
            plain.send(msgpack.packb({"v": "1.0", "id": 1, "op": "ping", "within_s": float("nan")}))
            assert plain.poll(GUARD_MS) and "`$.within_s`" in msgpack.unpackb(plain.recv())["error"]
        reply = client.request(endpoint, "refuse", {})
        assert reply["ok"] is False and "cannot be changed" in reply["error"]


def test_a_future_is_answered_when_it_is_done_and_others_meanwhile(tmp_path: Path) -> None:
    waiting: list[Future[Any]] = []

    def later(args: dict[str, Any]) -> Future[Any]:
        waiting.append(Future())
        waiting[-1].set_running_or_notify_cancel()  # it has begun
        return waiting[-1]

    with (
        node(tmp_path / "run", {"later": later}) as endpoint,
        ControlClient(endpoint) as slow,
        ControlClient(endpoint) as quick,
        ThreadPoolExecutor() as pool,
    ):
        answer = pool.submit(slow.request, "later", timeout=30)
        until(lambda: waiting)
        assert quick.request("ping") == "pong" and not answer.done()
        waiting.pop().set_result({"done": True})
        assert answer.result(30) == {"done": True}
        with pytest.raises(SagsError, match="no answer"):
            slow.request("later", timeout=0.05)
        until(lambda: waiting)
        waiting[0].set_exception(SagsError("too late"))
        assert slow.request("ping") == "pong"  # the late answer is not taken for this one


@pytest.mark.fault("socket: more requests than may wait")
def test_what_is_owed_is_bounded(tmp_path: Path) -> None:
    never = {"never": lambda args: Future()}
    with node(tmp_path / "run", never) as endpoint, client.zmq_socket(zmq.DEALER, endpoint) as asker:
        for i in range(MAX_PENDING + 5):
            asker.send(msgpack.packb({"v": "1.0", "id": i, "op": "never"}))
        refused = [msgpack.unpackb(asker.recv()) for _ in range(5) if asker.poll(GUARD_MS)]
        assert [reply["ok"] for reply in refused] == [False] * 5
        assert "waiting" in refused[0]["error"]


@pytest.mark.fault("socket: a request that nobody waits for any more")
def test_what_has_failed_is_not_done_later(tmp_path: Path) -> None:
    """By a node that comes later, that was stopped, or whose mapping was busy meanwhile."""
    done: list[str] = []
    waiting, posted = Requests(), list[Future[Any]]()
    handlers: dict[str, Handler] = {
        "pause": lambda args: done.append("pause"),
        "reset_model": lambda args: posted.append(waiting.post(lambda: done.append("reset"))) or posted[0],
    }
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    with ControlClient(endpoint) as asker:
        with pytest.raises(SagsError, match="no answer"):
            asker.request("pause", timeout=0.2)
        with publisher(tmp_path / "run", handlers, control=endpoint) as running:
            with repeating(lambda _: running.poll(20)):
                assert asker.request("ping", timeout=60) == "pong"
            with pytest.raises(SagsError, match="no answer"):
                asker.request("pause", timeout=0.2)
            with repeating(lambda _: running.poll(20)):
                assert asker.request("ping", timeout=60) == "pong"
                with pytest.raises(SagsError, match=r"no answer|not begun in the time"):  # whoever is first
                    asker.request("reset_model", timeout=0.2)
                until(posted[0].cancelled)
                waiting.serve()
    assert done == []


# ---- a node that is started anew; one that was killed, or that wants keys then: test_reconnection.py -----


def test_a_node_that_stopped_in_order_is_waited_for(tmp_path: Path) -> None:
    """It leaves no connection file, so nothing is sent before the next one is there."""
    asked: list[str] = []
    with node(tmp_path / "run", {}):
        asker = ControlClient(run_dir=tmp_path / "run")
        assert asker.request("ping") == "pong"
    with asker:
        with pytest.raises(SagsError, match="no node runs as 'sags'"):
            asker.request("ping", timeout=0.3)
        with ThreadPoolExecutor() as pool:
            answer = pool.submit(asker.request, "mark", timeout=30)
            time.sleep(0.3)
            with node(tmp_path / "run", {"mark": lambda args: asked.append("x")}) as endpoint:
                assert answer.result(60) is None and asked == ["x"]  # once
                assert asker.endpoint == endpoint


@pytest.mark.fault("process: the node dies with a request unanswered")
def test_what_may_have_been_done_is_not_asked_for_again(tmp_path: Path) -> None:
    """The node dies with a request unanswered, and another one comes while the client waits."""
    asked: list[str] = []

    def never(args: dict[str, Any]) -> Future[Any]:
        asked.append("first")
        return Future()

    with ThreadPoolExecutor() as pool:
        with node(tmp_path / "run", {"mark": never}):
            asker = ControlClient(run_dir=tmp_path / "run")
            answer = pool.submit(asker.request, "mark", timeout=30)
            until(lambda: asked)
        with asker, node(tmp_path / "run", {"mark": lambda args: asked.append("second")}):
            with pytest.raises(SagsError, match="started anew before it answered; ask again"):
                answer.result(60)
            assert asked == ["first"]
            asker.request("mark", timeout=30)
            assert asked == ["first", "second"]


def test_an_endpoint_that_was_given_is_kept(tmp_path: Path) -> None:
    with node(tmp_path / "run", {}) as endpoint:
        asker = ControlClient(endpoint, run_dir=tmp_path / "run")
        assert asker.request("ping") == "pong"
    with asker, node(tmp_path / "run", {}), pytest.raises(SagsError, match=f"no answer from {endpoint}"):
        asker.request("ping", timeout=0.4)


@pytest.mark.fault("socket: a request is too large")
def test_an_oversized_request_is_cut_off(tmp_path: Path) -> None:
    with node(tmp_path / "run", {"echo": lambda args: len(args["a"])}) as endpoint:
        with ControlClient(endpoint) as asker, pytest.raises(SagsError, match="no answer"):
            asker.request("echo", {"a": "x" * 1_000_000}, timeout=0.3)
        with ControlClient(endpoint) as asker:
            assert asker.request("echo", {"a": "x" * 60_000}) == 60_000
