"""`benchmarks soak`: whether a live node lasts beside all that runs with it in an operating room.

The node, the overlay, the viewer with a browser, a recorder and three subscribers, each a process of its own.
The recorder and the subscribers come and go. Every frame is timed by its own stamps; sizes are the system's.
"""

import json
import os
import random
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import Advance
from benchmarks.node import neighbours
from benchmarks.node.crowd import is_over, node_beside, peers_of
from benchmarks.node.endurance import slope
from benchmarks.node.processes import STARTING, listed, own_run_dir, sags
from sags_node.errors import SagsError
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.freezes import Freezes
from sags_node.messaging.received import ReceivedImage, TopicName
from sags_node.messaging.stream import listen_to
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.wire import Message, Meta
from sags_node.processes import resident_mb
from sags_node.quality.metrics import psnr
from sags_node.tools.evaluation.provenance import machine_name

EACH_FRAME = "tf"  # the smallest topic that is sent with every frame
HIGH_WATER = 1000  # frames that may wait while an image is compared
SHOWN = TopicName("left/render/image", ReceivedImage)
TRUTH = TopicName("left/image_rect_color", ReceivedImage)
TISSUE = TopicName("left/tissue_mask", ReceivedImage)
TAKEN = (SHOWN, "left/render/depth")  # by each subscriber
RECORDED = ("left/image_rect_color", SHOWN, "anchors", EACH_FRAME, "status")
WARM_UP = 10.0  # s before frames count
COMPARED = 3  # images of each window
SUBSCRIBERS = 3
NO_VISITS = {"visits": 0, "pictures": 0}
STAY, AWAY = (2.0, 20.0), (1.0, 5.0)  # s that a subscriber stays and is away: least and most
RECORDING = 60.0  # s of one recording
SILENCE = 30.0  # s without a frame: the node hangs
NODE = ("frames_per_s", "latency_p50_ms", "latency_p99_ms", "psnr", "rss_mb", "descriptors", "threads")
FIGURES = (*NODE, "overlay_mb", "viewer_mb")
TABLES = (
    f"frames {' '.join(FIGURES)}",
    "slope standard_error",
    "frames published dropped missed latency_ms.p50 latency_ms.p99 latency_ms.p99.9 latency_ms.max"
    " freezes.count freezes.seconds visits.visits visits.pictures",
    "recordings failed messages dropped lost",
)
SIGNIFICANT = 3.0  # standard errors: a smaller slope is no trend
WORSE_WHEN_LESS = ("frames_per_s", "psnr")  # of `FIGURES`; the others are worse when they grow
AN_HOUR = 108_000  # frames of the camera
TOLERATED = 0.1  # change per hour, as a share of a figure's mean


@dataclass(frozen=True, slots=True)
class Window:
    """Some thousand frames of the camera in a row."""

    frames: int  # of the camera up to its end
    frames_per_s: float  # published
    latency_p50_ms: float
    latency_p99_ms: float
    psnr: float  # dB over tissue, median of the images that were compared; NaN: none
    rss_mb: float  # of the node at its end
    descriptors: int  # likewise
    threads: int  # likewise
    overlay_mb: float  # at its end
    viewer_mb: float | None  # likewise; None: no browser here, so it does not run


@dataclass
class _Heard:
    """The figures that came with each frame."""

    latency_ms: list[float] = field(default_factory=list)
    published: list[float] = field(default_factory=list)  # s
    missed: int = 0  # messages lost on their way here
    dropped: int = 0  # frames that the node left out
    freezes: Freezes = field(default_factory=Freezes)
    _first: Meta | None = None
    _last: Meta | None = None

    @property
    def taken(self) -> int:
        """Frames of the camera: those that were published, and those that the node left out."""
        return len(self.latency_ms) + self.dropped

    def add(self, message: Message) -> None:
        meta = message.meta
        self._first = self._first or meta
        if self._last is not None:
            self.missed += meta.seq - self._last.seq - 1
        self._last = meta
        self.dropped = meta.dropped - self._first.dropped
        self.latency_ms.append((meta.publish_ns - meta.stamp_ns) * 1e-6)
        self.published.append(meta.publish_ns * 1e-9)
        self.freezes.add(meta.publish_ns * 1e-9)


def measure_soak(launch: Sequence[str], frames: int, per_window: int, advance: Advance) -> dict[str, Any]:
    """Run a node live for `frames` frames of its camera, published or left out, after the first seconds; keys
    as benchmarks/README.md lists them. Ctrl-C ends it with what is known by then."""
    heard, windows = _Heard(), list[Window]()
    interrupted = False
    with own_run_dir() as run_dir, ExitStack() as stack:
        node = stack.enter_context(node_beside(launch, run_dir))
        overlay = stack.enter_context(neighbours.overlay(run_dir))
        viewer = stack.enter_context(neighbours.viewer(run_dir)) if neighbours.find_browser() else None
        visitors = stack.enter_context(peers_of(run_dir, {"visits": (_visit, 0.0)}))
        recordings = stack.enter_context(_recordings(run_dir))
        quality: list[float] = []
        shown = 0  # up to the last window
        try:
            for _ in _frames(run_dir, node, heard):
                taken = min(heard.taken, frames)
                advance(taken, frames, "running")
                in_window = taken - per_window * len(windows)
                if in_window * COMPARED >= per_window * (len(quality) + 1):
                    quality.append(_compared(run_dir))
                if in_window >= per_window:
                    windows.append(_window(heard, shown, quality, node.pid, overlay, viewer))
                    shown = len(heard.latency_ms)
                    quality.clear()
                if taken == frames:
                    break
        except KeyboardInterrupt:
            interrupted = True
        came = {"visits": NO_VISITS, **visitors(), "recordings": recordings()}
    return {
        "machine": machine_name(),
        "launch": list(launch),
        "per_window": per_window,
        "interrupted": interrupted,
        **_overall(heard),
        **came,
        "windows": [asdict(window) for window in windows],
        "per_1000_frames": {
            figure: slope(windows, figure) for figure in FIGURES if viewer or figure != "viewer_mb"
        },
    }


def _frames(run_dir: Path, node: subprocess.Popen[str], heard: _Heard) -> Iterator[None]:
    """Add each published frame after the first seconds to `heard`."""
    begun = last = time.monotonic()
    messages = listen_to(NodeAddress(neighbours.NS, run_dir=run_dir), (EACH_FRAME,), None, HIGH_WATER)
    with closing(messages):
        for arrived in messages:
            now = time.monotonic()
            if node.poll() is not None:
                raise SagsError("the node ended before its time")
            if now - last > SILENCE:
                raise SagsError(f"the node published nothing for {SILENCE:g} s")
            if arrived is None:
                continue
            last = now
            if now - begun < WARM_UP:
                continue
            heard.add(arrived[0])
            yield


def _compared(run_dir: Path) -> float:
    """PSNR (dB) over tissue of the image now shown; NaN if no complete frame came."""
    names = (SHOWN, TRUTH, TISSUE)
    with Subscriber(names, run_dir=run_dir) as subscriber:
        newest = subscriber.wait(SHOWN, timeout=1.0)
        if newest is None or (frame := subscriber.aligned(names, newest.stamp_ns, timeout=1.0)) is None:
            return float("nan")
        shown, truth = (
            frame[each].array[..., :3].astype(np.float32) / np.float32(255) for each in (SHOWN, TRUTH)
        )
        return psnr(shown, truth, frame[TISSUE].array > 0)


def _window(
    heard: _Heard, since: int, quality: Sequence[float], node: int, overlay: int, viewer: int | None
) -> Window:
    """The window of the frames that were published after the first `since`."""
    p50, p99 = np.percentile(heard.latency_ms[since:], [50, 99])
    known = [each for each in quality if not np.isnan(each)]
    moments = heard.published[max(0, since - 1) :]
    return Window(
        frames=heard.taken,
        frames_per_s=(len(moments) - 1) / (moments[-1] - moments[0]),
        latency_p50_ms=float(p50),
        latency_p99_ms=float(p99),
        psnr=float(np.median(known)) if known else float("nan"),
        rss_mb=resident_mb(node),
        descriptors=listed(node, "fd"),
        threads=listed(node, "task"),
        overlay_mb=resident_mb(overlay),
        viewer_mb=None if viewer is None else resident_mb(viewer),
    )


def _overall(heard: _Heard) -> dict[str, Any]:
    if not heard.latency_ms:
        raise SagsError("stopped before the first frame that counts")
    p50, p99, p999 = map(float, np.percentile(heard.latency_ms, [50, 99, 99.9]))
    return {
        "frames": heard.taken,
        "published": len(heard.latency_ms),
        "seconds": heard.published[-1] - heard.published[0],
        "latency_ms": {"p50": p50, "p99": p99, "p99.9": p999, "max": max(heard.latency_ms)},
        "freezes": heard.freezes.status(),
        "missed": heard.missed,
        "dropped": heard.dropped,
    }


# ---- who comes and goes ----------------------------------------------------------------------------------


def _visit(run_dir: Path, _: float, ending: Event, there: Connection) -> None:
    """Run subscribers that come, take images for a while, and leave; count visits and images."""
    counted = [NO_VISITS.copy() for _ in range(SUBSCRIBERS)]
    working = [
        threading.Thread(target=_come_and_go, args=(run_dir, ending, random.Random(seed), counts))
        for seed, counts in enumerate(counted)
    ]
    for thread in working:
        thread.start()
    for thread in working:
        thread.join()
    there.send({key: sum(counts[key] for counts in counted) for key in counted[0]})


def _come_and_go(run_dir: Path, ending: Event, chance: random.Random, counts: dict[str, int]) -> None:
    while not is_over(ending):
        leaves = time.monotonic() + chance.uniform(*STAY)
        with Subscriber(TAKEN, run_dir=run_dir) as subscriber:
            counts["visits"] += 1
            newest = None
            while time.monotonic() < leaves and not ending.is_set():
                came = subscriber.wait(SHOWN, timeout=0.5, after=newest)
                counts["pictures"] += came is not None
                newest = came or newest
        ending.wait(chance.uniform(*AWAY))


@contextmanager
def _recordings(run_dir: Path) -> Iterator[Callable[[], dict[str, int]]]:
    """Make one recording after another, each removed once closed. The function given ends and counts them."""
    counts = {"recordings": 0, "failed": 0, "messages": 0, "dropped": 0, "lost": 0}
    ending, running = threading.Event(), list[subprocess.Popen[str]]()
    thread = threading.Thread(target=_record, args=(run_dir, ending, running, counts), daemon=True)
    thread.start()

    def stop() -> dict[str, int]:
        ending.set()
        for recorder in running:
            recorder.terminate()
        thread.join(STARTING)
        return counts

    try:
        yield stop
    finally:
        stop()


def _record(
    run_dir: Path, ending: threading.Event, running: list[subprocess.Popen[str]], counts: dict[str, int]
) -> None:
    folder = run_dir.parent / "recording"
    topics = [word for name in RECORDED for word in ("--topics", name)]
    command = ("bag", "record", "-o", str(folder), *topics, "--compression", "jpeg", "--json")
    environment = os.environ | {"XDG_RUNTIME_DIR": str(run_dir.parent)}
    while not ending.is_set():
        said = ""
        with sags(
            *command, "--seconds", f"{RECORDING:g}", env=environment, stdout=subprocess.PIPE
        ) as recorder:
            running[:] = [recorder]
            if ending.is_set():
                recorder.terminate()
            with suppress(subprocess.TimeoutExpired):
                said, _ = recorder.communicate(timeout=STARTING + RECORDING)
        if recorder.returncode == 0 and said:
            counts["recordings"] += 1
            summary: Mapping[str, int] = json.loads(said.splitlines()[-1])
            for key in ("messages", "dropped", "lost"):
                counts[key] += summary[key]
        else:
            counts["failed"] += 1
        shutil.rmtree(folder, ignore_errors=True)


def worsening(measured: Mapping[str, Any]) -> list[str]:
    """Return the names of `FIGURES` that get worse beyond their scatter, by more than `TOLERATED`.

    Raises:
        SagsError: there are too few windows to tell.
    """
    found = []
    for figure, trend in measured["per_1000_frames"].items():
        if trend is None:
            raise SagsError("too few windows to tell a trend: at least four are needed")
        worse = -trend["slope"] if figure in WORSE_WHEN_LESS else trend["slope"]
        mean = np.nanmean([window[figure] for window in measured["windows"]])
        if worse > SIGNIFICANT * trend["standard_error"] and worse * AN_HOUR / 1000 > TOLERATED * mean:
            found.append(figure)
    return found
