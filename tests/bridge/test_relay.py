"""The loop of all bridges, and that of a display, on a virtual clock: how often, and nothing old stays."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made_messages import meta
from simulation import START_NS, World

from sags_node.clients.bridge import gst, relay
from sags_node.clients.bridge.relay import LEAD, LOOK, MAX_AGE, Outlet, Output, Relay, Source
from sags_node.messaging import address
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.freshness import Freshness
from sags_node.messaging.received import Frame

SEEDS = 20
BLANK_WITHIN = 0.5  # s since capture, that are promised
PICTURE, POSE = "left/image_rect_color", "tf"
CAMERA_RATE = 20.0  # Hz: ten periods, after which all is stale, are longer than `MAX_AGE`
DELAY = 0.05  # s, at most, from capture until it comes


class Node:
    """Stands for `Feed` and all before it: what a node sends on one topic of frames, and on another."""

    def __init__(self, world: World) -> None:
        self.fresh = {name: Freshness(clock=world.monotonic) for name in (PICTURE, POSE)}
        self.asked: list[tuple[float, frozenset[str]]] = []
        self.sends = True
        self._world = world

    def make(self, _: Iterable[str], place: NodeAddress, max_age: float, wake: Callable[[], None]) -> Node:
        self._max_age, self._wake = max_age, wake
        self._world.spawn(self._film, "node")
        return self

    def _film(self) -> None:
        number = 0
        while self.sends:
            number += 1
            said = meta(number, self._world.time_ns() * 1e-6)
            self._world.sleep(self._world.random.uniform(0.5, 1.0) * DELAY)
            for fresh in self.fresh.values():
                fresh.accept(said)
            self._wake()
            self._world.sleep(max(0.0, number / CAMERA_RATE - self._world.now))

    def started_anew(self) -> bool:
        return False

    def ask(self, names: Iterable[str]) -> None:
        self.asked.append((self._world.now, frozenset(names)))

    def problem(self, name: str) -> str | None:
        return self.fresh[name].problem(self._world.time_ns(), self._max_age)

    def latest(self, name: str) -> Any:
        last = self.fresh[name].last
        return None if last is None else SimpleNamespace(meta=last, stamp_ns=last.stamp_ns, metric=False)

    def frame(self, names: Iterable[str], stamp_ns: int) -> Frame:
        return Frame({name: self.latest(name) for name in names})

    def close(self) -> None: ...


class Peer(Outlet):
    """What it is shown: when, and captured when; None: nothing."""

    def __init__(self, world: World) -> None:
        self.shown: list[tuple[float, float | None]] = []
        self._world = world

    def send(self, output: Output, frame: Frame) -> bool:
        stamp_ns = frame[output.sources[0].topic].stamp_ns
        self.shown.append((self._world.now, (stamp_ns - START_NS) * 1e-9))
        return True

    def blank(self, output: Output, reason: str) -> None:
        self.shown.append((self._world.now, None))


def bridged(
    monkeypatch: pytest.MonkeyPatch, seed: int, output: Output, stops_at: float, until: float
) -> tuple[Node, Peer]:
    """A bridge beside a node that falls silent."""
    world = World(seed)
    node, peer, stop = Node(world), Peer(world), world.threading.Event()
    monkeypatch.setattr(relay, "Feed", node.make)
    for module in (relay, address):
        monkeypatch.setattr(module, "time", world)
    monkeypatch.setattr(relay, "threading", world.threading)
    loop = Relay((NodeAddress(),), (output,), peer)
    world.spawn(lambda: loop.run(stop), "bridge")
    world.run(lambda: world.now >= stops_at)
    node.sends = False
    world.run(lambda: world.now >= until)
    return node, peer


def test_what_stops_is_taken_back_within_half_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    picture = Output("picture", (Source("sags", PICTURE),))
    for seed in range(SEEDS):
        _, peer = bridged(monkeypatch, seed, picture, stops_at=1.0 + 0.01 * seed, until=2.0)
        *shown, (blanked, nothing) = peer.shown
        ages = [when - captured for when, captured in shown if captured is not None]
        assert nothing is None and len(ages) == len(shown) > 15
        assert max(ages) <= DELAY, "old is sent as new"
        age = blanked - shown[-1][0] + ages[-1]
        assert MAX_AGE < age <= MAX_AGE + LOOK + 1e-6
    assert MAX_AGE + LOOK < BLANK_WITHIN, "there is time left for the way to the peer"


def test_lengths_without_a_unit_are_not_passed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Peers would take them for metres. Images go on."""
    for lengths in (False, True):
        output = Output("pose", (Source("sags", POSE),), lengths=lengths)
        _, peer = bridged(monkeypatch, 1, output, 2.0, 3.0)
        assert bool(peer.shown) != lengths


def test_what_comes_seldom_is_asked_for_when_due(monkeypatch: pytest.MonkeyPatch) -> None:
    seldom = Output("surface", (Source("sags", PICTURE),), period=2.0, pulse=Source("sags", POSE))
    for seed in range(SEEDS):
        node, peer = bridged(monkeypatch, seed, seldom, stops_at=7.0, until=8.0)
        *times, blanked = (when for when, _ in peer.shown)
        assert [captured is None for _, captured in peer.shown] == [False] * 4 + [True] and blanked > 7.0
        late = DELAY + 1 / CAMERA_RATE  # that the next frame may be
        assert np.abs(np.diff(times) - seldom.period).max() < late
        assert all(POSE in asked for _, asked in node.asked), "it tells that the node goes on"
        due = times[0] + seldom.period * np.arange(5)
        for when in (when for when, asked in node.asked if PICTURE in asked):
            assert (np.abs(when - due) < LEAD + late).any()


class Pipe:
    """Stands for a display's pipeline: the other end of its pipe."""

    def __call__(self, _: object, keep: tuple[int]) -> Pipe:
        self._end = os.dup(keep[0])
        return self

    def start(self) -> None: ...

    def close(self) -> None: ...

    def pictures(self, size: int) -> list[bytes]:
        data = os.read(self._end, 1 << 20)
        os.close(self._end)
        return [data[at : at + size] for at in range(0, len(data), size)]


def test_a_display_gets_its_rate_and_nothing_old(monkeypatch: pytest.MonkeyPatch) -> None:
    world, pipe, rate, shape = World(0), Pipe(), 50.0, (8, 8, 3)
    for name, replaced in (("time", world), ("threading", world.threading), ("GstProcess", pipe)):
        monkeypatch.setattr(gst, name, replaced)
    display = gst.Display("", shape[:2], (10, 200, 30), rate)
    world.run(lambda: world.now >= 0.5)
    display.show(np.zeros(shape, np.uint8), 0.4)
    world.run(lambda: world.now >= 2.0)
    display.close()
    key, black = bytes([30, 200, 10, 255] * 64), bytes([0, 0, 0, 255] * 64)
    shown = pipe.pictures(len(key))
    assert shown == [key] * 25 + [black] * 20 + [key] * (len(shown) - 45)
    assert len(shown) == pytest.approx(2.0 * rate, abs=1)
