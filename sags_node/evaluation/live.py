"""A live run measured from outside: the node in a process of its own, as users run it, and a reader of its
sockets that only copies. What was read is judged when the node has ended.

What the node alone knows of a frame, such as its Gaussians, is measured in steps (`session.run_step`).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import count, pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np

from sags_node.errors import SagsError
from sags_node.evaluation import metrics
from sags_node.evaluation.gallery import Gallery, Picture
from sags_node.evaluation.lpips import Lpips
from sags_node.evaluation.measure import Figures, FrameRow, MeasureOptions, Progress, quality
from sags_node.evaluation.receipt import Receipt
from sags_node.evaluation.spool import RunFacts
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.received import ReceivedImage, ReceivedText, interpret
from sags_node.messaging.rundir import connection_path
from sags_node.messaging.stream import listen_to
from sags_node.messaging.wire import Message, Meta
from sags_node.processes import end
from sags_node.types import F32, U8, Bool, StereoFrame
from sags_node.vision.rectify import Rectifier

IMAGE, DEPTH, MASK, STATUS = "left/render/image", "left/render/depth", "left/tissue_mask", "status"
TOPICS = (IMAGE, DEPTH, MASK, STATUS)
WAITING = 256  # messages that may wait for the reader; a node that overtakes it counts as the node's loss
STARTING = 120.0  # s until the node listens; kernels were compiled before
ENDING = 15.0  # s until it has ended after its last frame


@dataclass(frozen=True, slots=True)
class Shown:
    """What consumers got of one frame."""

    rgb: U8  # [H, W, 3]
    depth: F32 | None  # [H, W] m, 0 unknown
    tissue: Bool | None  # [H, W]
    facts: RunFacts


class Copies:
    """The messages of a run, in a temporary folder; gone when the `with` block ends."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="sags-eval-")
        self.folder = Path(self._folder.name)
        self.statuses: list[tuple[int, dict[str, Any]]] = []  # when each was published, ns; in order
        self._kept: dict[str, dict[int, _Kept]] = {IMAGE: {}, DEPTH: {}, MASK: {}}  # by frame
        self._numbers = count()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._folder.cleanup()

    def __len__(self) -> int:
        return len(self._kept[IMAGE])

    def add(self, message: Message, received_ns: int) -> None:
        """Copy one message.

        Raises:
            SagsError: the disk is full.
        """
        name = next(name for name in TOPICS if message.topic.endswith(f"/{name}"))  # after the namespace
        if name == STATUS:
            status = interpret(message, received_ns)
            assert isinstance(status, ReceivedText)
            self.statuses.append((message.meta.publish_ns, json.loads(status.text)))
            return
        file = self.folder / f"{next(self._numbers):06d}.frame"
        try:
            with file.open("wb") as sink:
                for part in message.parts:
                    sink.write(part)
        except OSError as error:
            raise SagsError(f"cannot keep pictures in {self.folder}: {error.strerror}; set TMPDIR") from None
        sizes = tuple(memoryview(part).nbytes for part in message.parts)
        self._kept[name][message.meta.frame_id] = _Kept(message.topic, message.meta, file, sizes)

    def size(self) -> tuple[int, int]:
        """Width and height of the pictures, px.

        Raises:
            SagsError: none came.
        """
        for kept in self._kept[IMAGE].values():
            height, width = kept.meta.shape[:2]
            return width, height
        raise SagsError("the node showed no frame; check source.start, source.frames and source.warm_up")

    def read(self, frame_id: int) -> Shown | None:
        """What was shown of that frame; None: nothing."""
        image, depth, mask = (self._kept[name].get(frame_id) for name in (IMAGE, DEPTH, MASK))
        if image is None:
            return None
        return Shown(
            rgb=np.ascontiguousarray(image.array()[..., :3]),
            depth=None if depth is None else np.nan_to_num(depth.array()),
            tissue=None if mask is None else mask.array() > 0,
            facts=self._facts(image.meta),
        )

    def _facts(self, image: Meta) -> RunFacts:
        """Of the frame itself: its stamps. The rest by the status that came before, or the first one."""
        published_ns = image.publish_ns
        told = [status for at_ns, status in self.statuses if at_ns <= published_ns]
        status = told[-1] if told else self.statuses[0][1] if self.statuses else {}
        rung = status.get("rung")
        return RunFacts(
            t_shown_ns=published_ns,
            frame_ms=None,
            latency_ms=(published_ns - image.stamp_ns) * 1e-6,
            rss_mb=status.get("rss_mb", float("nan")),
            timings_ms={},
            skipped={},
            gaussians=status.get("gaussians", 0),
            counts=status.get("last_frame", {}).get("counts", {}),
            rung=None if rung is None else rung["number"],
            warnings=status.get("warning_codes", {}),
        )


@dataclass(frozen=True, slots=True)
class _Kept:
    """A message on disk."""

    topic: str
    meta: Meta
    file: Path
    sizes: tuple[int, ...]  # bytes of its parts

    def array(self) -> Any:
        """Of an image."""
        copied = memoryview(self.file.read_bytes())
        starts = np.cumsum([0, *self.sizes])
        parts = tuple(copied[start:stop] for start, stop in pairwise(starts.tolist()))
        image = interpret(Message(self.topic, self.meta, parts), 0)
        assert isinstance(image, ReceivedImage)
        return image.array


def play(
    arguments: Sequence[str],
    node: NodeAddress,
    copies: Copies,
    progress: Progress,
    topics: Sequence[str] = TOPICS,
    cores: int | None = None,
    root: Path | None = None,
) -> dict[str, Any]:
    """Run a node until its recording has ended, and copy what it publishes.

    Args:
        arguments: of `sags run`.
        node: where it listens, by its run directory.
        progress: called with the frames that were shown so far.
        topics: that are read.
        cores: that it may use; None: all.
        root: of another checkout, whose node is run.

    Returns:
        The node's own account: `NodeHealth`.

    Raises:
        SagsError: it does not start, or it fails.
    """
    command = [sys.executable, "-m", "sags_node", "run", *arguments, "--json"]
    mine = os.sched_getaffinity(0)
    with (copies.folder / "problems").open("w+") as problems:
        os.sched_setaffinity(0, sorted(mine)[:cores])  # the process inherits it before it counts its cores
        try:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=problems, cwd=root)
        finally:
            os.sched_setaffinity(0, mine)
        try:
            _copy(process, node, copies, progress, topics)
            said, _ = process.communicate(timeout=ENDING)
        except subprocess.TimeoutExpired:
            raise SagsError("the node did not end after its last frame; try sags run alone") from None
        finally:
            if process.poll() is None:
                end(process, ENDING)
        problems.seek(0)
        if process.returncode != 0:
            raise SagsError(f"the node failed: {problems.read().rpartition('error:')[2].strip()}")
    account: dict[str, Any] = json.loads(said)
    return account


def _copy(
    process: subprocess.Popen[bytes], node: NodeAddress, copies: Copies, progress: Progress,
    topics: Sequence[str],
) -> None:  # fmt: skip
    """All that it publishes until it ends."""
    assert node.run_dir is not None
    listening, deadline = connection_path(node.run_dir, node.ns), time.monotonic() + STARTING
    while not listening.exists() and process.poll() is None:
        if time.monotonic() > deadline:
            raise SagsError(f"the node did not listen within {STARTING:.0f} s; try sags run alone")
        time.sleep(0.005)  # the first frame comes soon
    if process.poll() is not None:
        return
    for received in listen_to(node, topics, None, WAITING):
        if received is not None:
            copies.add(*received)
            progress("playing", len(copies))
        elif process.poll() is not None:
            return


class Judge:
    """Compares what a live run showed with the recording that it played.

    Attributes:
        rows: one for each frame of the recording.
        gallery: a few frames to look at.
        depth_kind: what the reference depth is; None without one.
    """

    def __init__(
        self, copies: Copies, rectifier: Rectifier, options: MeasureOptions, receipt: Receipt, detail: bool
    ) -> None:
        """
        Args:
            rectifier: pictures are compared at its size; smaller ones are enlarged.
            receipt: takes note of what is compared.
            detail: what was shown has that of camera images: it is not the model's own.
        """
        self.rows: list[FrameRow] = []
        self.gallery = Gallery(len(copies))
        self.depth_kind: str | None = None
        self._copies = copies
        self._receipt = receipt
        self._places = count()
        self._rectifier = rectifier
        self._options = options
        self._shown = "shown" if detail else "online"
        self._before: F32 | None = None  # the camera's picture of the frame before
        self._lpips = Lpips(options.lpips_weights) if options.lpips_weights else None

    def run(self, frames: Iterable[StereoFrame], progress: Progress) -> None:
        """Judge all frames of the recording, but for those of its warm-up."""
        for frame in frames:
            if frame.warm_up:
                continue
            left, shown = self._rectifier(frame).left, self._copies.read(frame.frame_id)
            row = FrameRow(frame.frame_id, frame.t_capture_ns * 1e-9, {})
            if shown is not None:
                figures = self._figures(frame, left, shown)
                row = replace(row, figures=figures, facts=shown.facts)
            self.rows.append(row)
            self._before = metrics.as_float(left)
            progress("measuring", len(self.rows))

    def _figures(self, frame: StereoFrame, left: U8, shown: Shown) -> dict[str, Figures]:
        height, width = left.shape[:2]
        rgb = np.asarray(cv2.resize(shown.rgb, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
        tissue = np.ones((height, width), np.bool_)
        if shown.tissue is not None:
            tissue = metrics.resample_nearest(shown.tissue.astype(np.float32), width, height) > 0
        depth = np.zeros((height, width), np.float32)
        if shown.depth is not None:
            depth = metrics.resample_nearest(shown.depth, width, height)
        self._receipt.add(frame, tissue)
        truth, place = metrics.as_float(left), next(self._places)
        lpips = self._lpips if place % self._options.every == 0 else None
        found = quality(metrics.as_float(rgb), truth, tissue, self._options, lpips)
        self.gallery.offer(place, Picture(frame.frame_id, found["psnr"], left, rgb, depth, tissue))
        figures = {self._shown: found}
        if self._before is not None:
            figures["predict"] = {"copy_psnr": metrics.psnr(self._before, truth, tissue)}
        reference = frame.reference
        if shown.depth is not None and reference is not None and reference.depth is not None:
            self.depth_kind = reference.depth_kind
            known = metrics.resample_nearest(reference.depth, width, height)
            figures["depth"] = asdict(metrics.depth_errors(depth, known, tissue))
        return figures
