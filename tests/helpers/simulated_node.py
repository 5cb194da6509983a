"""A whole node on a virtual clock: its own threads, slots, requests and messages, with seeded faults.

Real are `Node` with all its loops, `Latest`, `LivePairs` and `SentPictures`, `Operations`, `TimeBudget`
and `Ladder`, `Statistics`, `Publisher`, `ControlServer` and, at the consumer, `decode` and `Freshness`.
Simulated are cameras, the work on a frame (it takes time, and fails now and then), the sockets, and who asks
and listens. Views, thin images and the recorder are there and nobody asks for them.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hostile
import msgpack
import numpy as np
import pytest
import zmq
from simulation import EventFd, World
from synthetic import at_frame, plane_result

from sags_node.config.schema import LaunchConfig, PublishConfig, PushSource
from sags_node.errors import SagsError
from sags_node.mapping.budget import TimeBudget
from sags_node.mapping.ladder import FULL, RUNGS, USED, Ladder, price
from sags_node.messaging import cdr, publisher, topics
from sags_node.messaging.freshness import MAX_CLOCK_AHEAD, STALE_AFTER, STALE_PERIODS, Freshness
from sags_node.messaging.sockets import waiting
from sags_node.messaging.wire import decode
from sags_node.node import health, latest, node, views
from sags_node.node import operations as node_operations
from sags_node.pipeline.pipeline import FrameRequest
from sags_node.sources import pairing
from sags_node.sources.sent import SentPictures
from sags_node.types import FrameResult, StereoFrame

RATE = 30.0
SECONDS = 4.0  # of a run, then it is stopped
MOST_AHEAD = 0.05  # s, by which a camera's stamp may be wrong; 0.1 s is refused
BEHIND, JITTER = 0.4, 0.005  # s, by which it may be too old; 3 s is refused
ANSWER = 3.0  # s: longest hang of the mapping, and what comes before
TOPICS = ("tf", "anchors", "status")  # small ones: what a message holds is tested elsewhere
PLANE = plane_result()
PICTURE = np.zeros((4, 8, 3), np.uint8)


@dataclass
class Asked:
    """A request, and how often it was answered."""

    op: str
    at: float
    answers: int = 0


class Frame:
    """As `zmq.Frame`."""

    def __init__(self, data: bytes, more: bool = False) -> None:
        self.bytes, self.more = data, more

    def __len__(self) -> int:
        return len(self.bytes)

    def get(self, option: int | str) -> int | str:
        return 0 if isinstance(option, int) else "anonymous"


class Socket:
    """What comes in and what was sent, in the place of a bound socket."""

    def __init__(self) -> None:
        self.incoming: deque[list[bytes]] = deque()
        self.sent: deque[list[bytes]] = deque()
        self._rest: list[Frame] = []
        self._endpoint = ""

    def setsockopt(self, *_: object) -> None: ...

    def bind(self, endpoint: str) -> None:
        self._endpoint = endpoint

    def getsockopt_string(self, option: int) -> str:
        return self._endpoint

    def recv(self, flags: int = 0, copy: bool = True) -> Frame:
        if not self._rest:
            if not self.incoming:
                raise zmq.Again
            parts = self.incoming.popleft()
            self._rest = [Frame(part, number < len(parts) - 1) for number, part in enumerate(parts)]
        return self._rest.pop(0)

    def send_multipart(self, parts: list[Any], flags: int = 0, copy: bool = True) -> None:
        self.sent.append([bytes(part) for part in parts])


class Network:
    """The names of `zmq` that the publisher uses."""

    XPUB, ROUTER, XPUB_VERBOSE = zmq.XPUB, zmq.ROUTER, zmq.XPUB_VERBOSE
    POLLIN, NOBLOCK, Again, ZMQError = zmq.POLLIN, zmq.NOBLOCK, zmq.Again, zmq.ZMQError

    def __init__(self, world: World, wake: EventFd) -> None:
        self._world, self._wake = world, wake
        self.sockets: dict[int, Socket] = {}

    def Context(self) -> Any:
        def make(kind: int) -> Socket:
            return self.sockets.setdefault(kind, Socket())

        return SimpleNamespace(socket=make, destroy=lambda linger=0: None)

    def Poller(self) -> Any:
        def ready() -> bool:
            return self._wake.count > 0 or any(socket.incoming for socket in self.sockets.values())

        def poll(ms: float) -> list[tuple[int, int]]:
            self._world.wait(ready, ms * 1e-3)
            return [(1, zmq.POLLIN)] if self._wake.count else []

        return SimpleNamespace(register=lambda *_: None, unregister=lambda _: None, poll=poll)


class Pipeline:
    """Takes the time that a frame would, by the real budget; now and then it hangs, and it may fail."""

    def __init__(self, run: Run, rate: float) -> None:
        self._run, self.rate = run, rate
        self._machine = run.world.random.choice((0.3, 0.8, 1.0, 2.0, 8.0))  # times the prices of the ladder
        self._resets = 0
        self.anchors = SimpleNamespace(remove=self._no_anchor)
        self.warnings: dict[str, Any] = {}
        self.newest: FrameResult | None = None
        self.seen = ()  # nothing lends its detail
        self.rectifier = SimpleNamespace(pictures=self._pictures)

    def _pictures(self, _: StereoFrame) -> None:
        self._run.world.sleep(1e-3 * self._machine * 3.0)

    @staticmethod
    def _no_anchor(_: int) -> None:
        raise SagsError("no such anchor")

    def make_budget(self, speed: float | None = None) -> TimeBudget:
        return TimeBudget(Ladder(RUNGS, FULL, 1 / self.rate, speed or 1.0), self._run.world.monotonic)

    def reconfigure(self, config: LaunchConfig) -> None: ...

    def reset(self) -> None:
        self._resets += 1

    def process(
        self, frame: StereoFrame, budget: TimeBudget, request: FrameRequest, pictures: None
    ) -> FrameResult:
        world, chance = self._run.world, self._run.world.random
        self._run.taken += 1
        rung = budget.start(request.waited).rung
        gaussians = USED * rung.gaussians
        world.sleep(1e-3 * self._machine * price(rung, gaussians, FULL) * chance.uniform(0.8, 1.2))
        while budget.more():
            budget.step()
            world.sleep(1e-3 * self._machine * 2.0)
        budget.end_steps()
        if chance.random() < 0.01:
            world.sleep(chance.uniform(0.1, 2.0))  # another process, a driver, a disk
        if chance.random() < self._run.failing:
            raise SagsError("the mapping failed")
        budget.finish(round(gaussians))
        epoch = frame.epoch + self._resets
        self.newest = at_frame(PLANE, frame.frame_id, frame.t_capture_ns, epoch)
        self._run.processed += 1
        return self.newest


class Source:
    """Two cameras whose images another program sends."""

    rate, frame_count = RATE, None

    def __init__(self, run: Run) -> None:
        self._run = run
        self.sent = SentPictures(PushSource(rate=RATE), None)
        self.refused = 0
        self.filmed: dict[int, tuple[float, float]] = {}  # stamp -> when in truth, and `World.wall_ahead`

    def __enter__(self) -> Source:
        for eye in ("left", "right"):
            self._run.world.spawn(lambda eye=eye: self._film(eye), f"camera {eye}")
        return self

    def __exit__(self, *_: object) -> None: ...

    def __iter__(self) -> Iterator[StereoFrame]:
        for frame in self.sent:
            self._run.given += 1
            yield frame

    @property
    def dropped(self) -> int:
        return self.sent.dropped

    def stop(self) -> None:
        self.sent.stop()

    def _film(self, eye: str) -> None:
        """Lost, late, doubled, outdated and future images, silence, and stamps that go back."""
        world = self._run.world
        chance, offset, number = world.random, 0, 0
        while not self.sent.stopped.is_set():
            number += 1
            world.wait(lambda: False, max(0.0, number / RATE - world.now))
            what = chance.random()
            if what < 0.1:
                continue  # lost
            if what < 0.12:
                world.sleep(chance.uniform(0.01, 1.5))  # silent, or late
            if what > 0.98:
                offset = chance.choice((0, 0, 0, -BEHIND, MOST_AHEAD, 3600.0))
            stamp = world.time_ns() + round(1e9 * (offset - chance.uniform(0, JITTER)))
            if eye == "left":
                self.filmed[stamp] = world.now, world.wall_ahead
            for _ in range(2 if 0.12 < what < 0.14 else 1):
                try:
                    self.sent.put(eye, stamp, world.time_ns(), lambda: PICTURE)  # type: ignore[arg-type]
                except SagsError:
                    self.refused += 1


class Run:
    """One seed: `play` it, and look at what is counted.

    Raises:
        AssertionError: something was not as it must always be.
    """

    def __init__(self, seed: int, folder: Path) -> None:
        self.world = World(seed)
        self.given = self.taken = self.processed = self.published = 0
        chance = self.world.random
        self.failing = chance.choice((0.0, 0.0, 0.0, 0.01))
        self._losing = chance.choice((0.0, 0.0, 0.05, 0.3))  # share of messages that do not come
        self._pausing = chance.random() < 0.3
        self._wake = EventFd()
        self._network = Network(self.world, self._wake)
        self._folder = folder
        self.asked: dict[int, Asked] = {}
        self.fresh = {f"sags/{name}": Freshness(clock=self.world.monotonic) for name in ("tf", "anchors")}
        self.shown = Counter[str]()
        self._seen: dict[str, tuple[int, int, int, int]] = {}
        # As consumers know it, and the frames that they refuse for it.
        self._state, self._refused = "starting", 0
        self._ended = False

    def play(self) -> None:
        with pytest.MonkeyPatch.context() as patch:
            self._replace(patch)
            config = LaunchConfig(
                source=PushSource(rate=RATE), publish=PublishConfig(data=(), ipc=False, run_dir=self._folder)
            )
            self.source = Source(self)
            rig = SimpleNamespace(metric=True)
            self.node = node.Node(config, rig, self.source, self._note)  # type: ignore[arg-type]
            self._data = self._network.sockets[zmq.XPUB]
            self._control = self._network.sockets[zmq.ROUTER]
            self._data.incoming.extend([b"\x01sags/" + name.encode()] for name in TOPICS)
            self.world.spawn(self._live, "the main thread")
            self.world.spawn(self._ask, "who asks")
            self.world.spawn(self._listen, "who listens")
            self.world.run(lambda: self._ended)
        self._check_end()

    def _replace(self, patch: pytest.MonkeyPatch) -> None:
        for module in (node, health, publisher):
            patch.setattr(module, "time", self.world)
        for module in (node, latest, pairing, node_operations):
            patch.setattr(module, "threading", self.world.threading)
        patch.setattr(node, "os", self._wake)
        patch.setattr(node, "Pipeline", lambda *_, rate: Pipeline(self, rate))
        patch.setattr(node, "configure_threads", lambda _: None)
        patch.setattr(publisher, "zmq", self._network)
        patch.setattr(publisher, "Peers", _Peers)
        defaults = self.world.monotonic, self.world.monotonic, lambda: 0.0, "numba", False
        patch.setattr(views.Views.__init__, "__defaults__", defaults)
        patch.setattr(sys.modules["sags_node.messaging.node_clock"], "time", self.world)

    def _note(self, result: FrameResult, latency_ms: float) -> None:
        self.published += 1

    # ---- who takes part --------------------------------------------------------------------------------

    def _live(self) -> None:
        self.node.start()
        if self.world.random.random() < 0.3:  # it may be stopped by an error before
            self.world.sleep(self.world.random.uniform(0, SECONDS))
            self.world.wall_ahead = self.world.random.choice((-3600.0, -2.0, -0.5, 0.5, 3600.0))
        self.world.wait(lambda: self.node.failed, SECONDS - self.world.now)
        self.stopped_at = self.world.now
        self.node.stop()
        self.took_to_stop = self.world.now - self.stopped_at
        try:
            assert self.node.wait(timeout=0), "a thread has not ended"
            self.error = None
        except SagsError as error:
            self.error = error
        self.world.sleep(0.5)  # what is on its way
        self._ended = True

    def _ask(self) -> None:
        """Good requests, wrong ones and noise."""
        world, chance = self.world, self.world.random
        rng = np.random.default_rng(chance.randrange(2**32))
        good: list[tuple[str, dict[str, Any]]] = [
            ("ping", {}), ("get_status", {}), ("get_health", {}), ("reset_model", {}), ("get_clock", {}),
            ("set_parameters", {"mapping.budget_ms": 25}), ("set_parameters", {"source.rate": 3}),
            ("add_anchor", {"u": "x"}), ("remove_anchor", {"id": 3}), ("close_view", {"name": "none"}),
            ("save_model", {"path": 3}), ("make_coffee", {}),
        ]  # fmt: skip
        if self._pausing:
            good += [("pause", {}), ("resume", {}), ("resume", {})]
        while not self._ended:
            world.sleep(chance.expovariate(10.0))
            for _ in range(chance.choice((1,) * 30 + (5, 80))):
                number = len(self.asked)
                op, args = chance.choice(good)
                body = msgpack.packb({"v": "1.0", "id": number, "op": op, "args": args})
                if chance.random() < 0.1:
                    op, body = "", hostile.random_request(rng)
                self.asked[number] = Asked(op, world.now)
                self._control.incoming.append([b"%d" % number, body])

    def _listen(self) -> None:
        chance = self.world.random
        while not self._ended:
            self.world.sleep(chance.choice((0.001, 0.01, 0.05)))
            while self._control.sent:
                envelope, body = self._control.sent.popleft()
                assert hostile.is_reply(body)
                self.asked[int(envelope)].answers += 1
            while self._data.sent:
                parts = self._data.sent.popleft()
                self._hear(parts)
                if chance.random() >= self._losing:
                    self._take(parts)
                    if chance.random() < 0.02:
                        self._take(parts)  # as to another subscriber, who has just come
            self._look()

    def _hear(self, parts: list[bytes]) -> None:
        """After the first frame the state is said at once: until then consumers refuse all frames."""
        message = decode(parts)
        if message.topic == "sags/status":
            self._state = json.loads(cdr.decode(message.parts[0], topics.STRING).data)["state"]
        elif message.topic == "sags/tf" and self._state == "starting":
            self._refused += 1
            assert self._refused == 1, "frames are published, and the node says that it is starting"

    def _take(self, parts: list[bytes]) -> None:
        message = decode(parts)
        meta, name = message.meta, message.topic
        fresh = self.fresh.get(name)
        if fresh is None or not fresh.accept(meta):
            return
        now = meta.epoch, meta.seq, meta.stamp_ns, meta.dropped
        before = self._seen.get(name)
        if before is not None:
            assert now[:2] > before[:2] and now[3] >= before[3], f"{name}: {before} then {now}"
            assert now[0] > before[0] or now[2] > before[2], f"{name}: a stamp does not rise: {before}, {now}"
        self._seen[name] = now

    def _look(self) -> None:
        """What is shown as new is no older than the limit says, by the clock that nobody sets."""
        for name, fresh in self.fresh.items():
            if fresh.problem(self.world.time_ns()) is None:
                self.shown[name] += 1
                taken, wall_ahead = self.source.filmed[fresh.last.stamp_ns]
                age, set_back = self.world.now - taken, wall_ahead - self.world.wall_ahead
                limit = min(STALE_PERIODS * fresh.period, STALE_AFTER)
                limit += MOST_AHEAD + max(0.0, set_back) + 1e-6
                assert age <= limit, f"{name}: {age:.3f} s old is shown as new"
                # By the clock that was set back its stamp is so far ahead, but for what the stamp lags.
                ahead = set_back - age - BEHIND - JITTER
                assert ahead <= MAX_CLOCK_AHEAD, f"{name}: it is of the future"

    # ---- what must be true in the end ------------------------------------------------------------------

    def _check_end(self) -> None:
        assert self.took_to_stop < node.STOP_SECONDS, "a thread was given up"
        assert (self.error is None) or self.failing, self.error
        left_out = self.node.dropped
        in_slots = self.given - self.taken - left_out["capture"]
        assert in_slots >= 0 and (self._pausing or in_slots <= 1)
        assert self.processed - self.published - left_out["publish"] in (0, 1)
        assert all(one.answers <= 1 for one in self.asked.values()), "a request was answered twice"
        if self.error is None:
            due = [one for one in self.asked.values() if one.at < self.stopped_at - ANSWER]
            assert all(one.answers == 1 for one in due), [one for one in due if not one.answers][:3]


class _Peers:
    """Nobody is counted."""

    def __init__(self, socket: Any, *_: object) -> None:
        self.waiting = partial(waiting, socket)

    def counts(self) -> dict[str, int]:
        return {"open": 0, "refused": 0}

    def close(self) -> None: ...


def play(seed: int) -> Run:
    with tempfile.TemporaryDirectory() as folder:
        run = Run(seed, Path(folder))
        run.play()
        return run
