"""What a run showed, kept on disk while it runs, so that measuring it later cannot slow it down.

One file for each frame of a pipeline, or for each message of a live node. Only frame numbers and statuses
stay in memory.
"""

import json
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np

from sags_node.errors import SagsError
from sags_node.findings import NOTHING, Findings, by_code
from sags_node.messaging import published
from sags_node.messaging.received import ReceivedImage, ReceivedText, interpret
from sags_node.messaging.wire import Message, Meta
from sags_node.processes import resident_mb
from sags_node.types import F32, U8, Bool, FrameResult, Snapshot, StereoFrame

IMAGE, DEPTH, MASK, STATUS = "left/render/image", "left/render/depth", "left/tissue_mask", "status"
TOPICS = (IMAGE, DEPTH, MASK, STATUS)
_MAPPED, _RECORDED = "mapped", "recorded"


@dataclass(frozen=True, slots=True)
class RunFacts:
    """What the run itself says of one processed frame."""

    t_shown_ns: int  # when its result was done or published; monotonic clock
    frame_ms: float | None  # wall time of all stages; None: the node alone knows
    latency_ms: float | None  # capture stamp to publish; None when nothing was published
    rss_mb: float
    timings_ms: dict[str, float]  # stage -> ms
    skipped: dict[str, str]
    gaussians: int
    counts: dict[str, int]  # inserted, removed, iterations, ...
    rung: int | None = None  # of the ladder of quality; None: fixed steps
    warnings: dict[str, str] = field(default_factory=dict)  # code -> what is wrong and how to fix it
    cpu_ms: float | None = None  # processor time of all threads for the frame; None: not measured


@dataclass(frozen=True, slots=True)
class ShownFrame:
    """What consumers got of one frame."""

    facts: RunFacts
    rgb: U8  # [H, W, 3] the left view, drawn after this frame's update
    depth: F32 | None  # [H, W] m, of the same view, 0 unknown; None: it did not come
    tissue: Bool  # [H, W]


@dataclass(frozen=True, slots=True)
class MappedFrame(ShownFrame):
    """One frame as it was shown, with the model that showed it."""

    depth: F32
    snapshot: Snapshot  # stamped on the clock of the run
    baseline: float  # m
    measured_depth: F32  # [H, W] m, the stereo stage's own, 0 unknown
    confidence: F32 | None  # [H, W] 0..1, of `depth`; None: unknown
    right_rgb: U8 | None  # [H, W, 3] the right view; None: the run showed none


class Run:
    """A temporary folder of what was shown; gone when the `with` block ends, for whatever reason.

    Attributes:
        folder: where it is.
        frame_ids: of the frames that were shown, in order.
    """

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="sags-eval-")
        self.folder = Path(self._folder.name)
        self.frame_ids: list[int] = []
        self._statuses: list[tuple[int, dict[str, Any]]] = []  # when each was published, ns; in order

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()

    def __len__(self) -> int:
        return len(self.frame_ids)

    def add(
        self,
        result: FrameResult,
        frame_ms: float,
        t_shown_ns: int,
        latency_ms: float | None = None,
        warnings: Findings = NOTHING,
        cpu_ms: float | None = None,
    ) -> None:
        """Keep one frame of a pipeline: about 6 MB and 2 to 3 ms at 640x512 with 30,000 Gaussians.

        Raises:
            SagsError: the disk is full.
        """
        snapshot, seen, view = result.snapshot, result.observation, result.views["left"]
        right = result.views.get("right")
        facts = RunFacts(
            t_shown_ns,
            frame_ms,
            latency_ms,
            resident_mb(),
            dict(result.timings_ms),
            dict(result.skipped),
            len(snapshot.gaussians),
            dict(snapshot.counts),
            None if result.rung is None else result.rung.number,
            by_code(warnings),
            cpu_ms,
        )
        mapped = MappedFrame(
            facts=facts,
            rgb=view.rgb,
            depth=view.depth,
            tissue=seen.tissue,
            snapshot=snapshot,
            baseline=result.pair.baseline,
            measured_depth=seen.depth,
            confidence=view.confidence,
            right_rgb=published.colours(right, published.size_of(result.pair)) if right is not None else None,
        )
        self._keep(snapshot.frame_id, _MAPPED, mapped)
        self.frame_ids.append(snapshot.frame_id)

    def copy(self, message: Message) -> None:
        """Keep one message of a live node, on one of `TOPICS`.

        Raises:
            SagsError: the disk is full.
        """
        name = next(name for name in TOPICS if message.topic.endswith(f"/{name}"))  # after the namespace
        if name == STATUS:
            status = interpret(message, 0)
            assert isinstance(status, ReceivedText)
            self._statuses.append((message.meta.publish_ns, json.loads(status.text)))
            return
        self._keep(message.meta.frame_id, name, (message.topic, message.meta, message.parts))
        if name == IMAGE:
            self.frame_ids.append(message.meta.frame_id)

    def keep(self, frame: StereoFrame) -> None:
        """Keep a recorded frame, without its ground truth.

        Raises:
            SagsError: the disk is full.
        """
        self._keep(frame.frame_id, _RECORDED, replace(frame, reference=None))

    def frame(self, frame_id: int) -> StereoFrame:
        """Read a recorded frame that `keep` was given."""
        frame: StereoFrame = _RECORDS.decode(self._file(frame_id, _RECORDED).read_bytes())
        return frame

    def size(self) -> tuple[int, int]:
        """The width and height of what consumers got, px.

        Raises:
            SagsError: nothing was shown.
        """
        shown = self.read(self.frame_ids[0]) if self.frame_ids else None
        if shown is None:
            raise SagsError("the node showed no frame; check source.start, source.frames and source.warm_up")
        height, width = shown.rgb.shape[:2]
        return width, height

    def read(self, frame_id: int) -> ShownFrame | None:
        """Return what was shown of that frame; None: nothing."""
        file = self._file(frame_id, _MAPPED)
        if file.exists():
            mapped: MappedFrame = _FRAMES.decode(file.read_bytes())
            return mapped
        image, depth, mask = (self._image(frame_id, name) for name in (IMAGE, DEPTH, MASK))
        if image is None:
            return None
        rgb = np.ascontiguousarray(image.array[..., :3])
        return ShownFrame(
            facts=self._facts(image.meta),
            rgb=rgb,
            depth=None if depth is None else np.nan_to_num(depth.array),
            tissue=np.ones(rgb.shape[:2], np.bool_) if mask is None else mask.array > 0,
        )

    def _facts(self, image: Meta) -> RunFacts:
        """The facts of a live node's frame: its own stamps, and the rest from the last status before it, or
        from the first one."""
        published_ns = image.publish_ns
        told = [status for at_ns, status in self._statuses if at_ns <= published_ns]
        status = told[-1] if told else self._statuses[0][1] if self._statuses else {}
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

    def _image(self, frame_id: int, name: str) -> ReceivedImage | None:
        file = self._file(frame_id, name)
        if not file.exists():
            return None
        image = interpret(Message(*_MESSAGES.decode(file.read_bytes())), 0)
        assert isinstance(image, ReceivedImage)
        return image

    def _keep(self, frame_id: int, name: str, value: Any) -> None:
        try:
            self._file(frame_id, name).write_bytes(msgspec.msgpack.encode(value, enc_hook=_plain))
        except OSError as error:
            raise SagsError(
                f"cannot keep frame {frame_id} in {self.folder}: {error.strerror}; "
                "set TMPDIR to a folder with room (about 6 MB per frame) or play fewer frames"
            ) from None

    def _file(self, frame_id: int, name: str) -> Path:
        return self.folder / f"{frame_id:06d}.{name.replace('/', '-')}"


def _plain(value: Any) -> Any:
    """An array, or a number of numpy, for msgpack."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, np.ascontiguousarray(value).data
    return value.item()


def _array(kind: type, plain: Any) -> Any:
    dtype, shape, data = plain
    return np.frombuffer(bytearray(data), dtype).reshape(shape)  # writable, as kernels are compiled for it


_FRAMES = msgspec.msgpack.Decoder(MappedFrame, dec_hook=_array)
_RECORDS = msgspec.msgpack.Decoder(StereoFrame, dec_hook=_array)
_MESSAGES = msgspec.msgpack.Decoder(tuple[str, Meta, tuple[bytes, ...]])
