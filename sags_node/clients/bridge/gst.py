"""`sags bridge gst`: the overlay on its key colour into GStreamer pipelines, for displays with chroma keying.

Each eye is a pipeline in a process of its own, which gets BGRx images at the display's rate, new or not. An
image is replaced by the key colour alone, which displays show as nothing, as soon as it is too old.
"""

import fcntl
import json
import os
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.clients.bridge.relay import MAX_AGE, Outlet, Output, Relay, Source
from sags_node.errors import SagsError, UsageError
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.received import Frame, ReceivedImage, ReceivedText
from sags_node.sources.gst_process import GstProcess
from sags_node.types import U8

PIPE_BYTES = 1 << 20  # the most that Linux gives without privileges; a smaller pipe takes more writes
STOPPING = 5.0  # s for a writer to end


@dataclass(frozen=True, slots=True)
class GstOptions:
    """How `sags bridge gst` runs; the defaults are those of the command."""

    overlay: NodeAddress
    left: str | None = None  # the pipeline behind that eye's images, as for gst-launch-1.0
    right: str | None = None
    rate: float = 60.0  # Hz of the display
    max_age: float = MAX_AGE


def run_gst(options: GstOptions, ready: Callable[[], None], stop: threading.Event) -> None:
    """Write until `stop` is set. The overlay may come later and be restarted.

    Args:
        ready: called once it waits for an overlay.

    Raises:
        UsageError: no eye is to be written.
        SagsError: a pipeline fails.
    """
    eyes = {"left": options.left, "right": options.right}
    launches = {eye: launch for eye, launch in eyes.items() if launch is not None}
    if not launches:
        raise UsageError("give --left, --right or both: what comes behind the images of that eye")
    ns = options.overlay.ns
    outputs = [Output(eye, (Source(ns, f"{eye}/overlay/color_key"),)) for eye in launches]
    outputs.append(Output("key", (Source(ns, "status"),)))
    with (
        closing(_Displays(launches, options)) as displays,
        closing(Relay((options.overlay,), outputs, displays, options.max_age)) as relay,
    ):
        ready()
        while not stop.is_set():
            relay.step()
            displays.look()
            relay.wait()


class _Displays(Outlet):
    """The outlet: one pipeline for each eye, from its first image on."""

    def __init__(self, launches: Mapping[str, str], options: GstOptions) -> None:
        self._launches, self._options = launches, options
        self._key: tuple[int, int, int] | None = None  # RGB
        self._displays: dict[str, Display] = {}

    def send(self, output: Output, frame: Frame) -> bool:
        received = frame[output.sources[0].topic]
        if isinstance(received, ReceivedText):
            red, green, blue = json.loads(received.text)["color_key"]
            self._key = (red, green, blue)
            return True
        assert isinstance(received, ReceivedImage)  # so are the topics of the eyes
        if self._key is None:  # it comes once a second
            return False
        eye, size = output.name, received.array.shape[:2]
        display = self._displays.get(eye)
        if display is None or (display.size, display.key) != (size, self._key):
            if display is not None:
                display.close()
            display = Display(self._launches[eye], size, self._key, self._options.rate)
            self._displays[eye] = display
        age = (self._options.overlay.now_ns() - received.stamp_ns) * 1e-9
        display.show(received.array, self._options.max_age - age)
        return True

    def blank(self, output: Output, reason: str) -> None:
        if output.name in self._displays:
            self._displays[output.name].blank()

    def look(self) -> None:
        """Raises: SagsError: a pipeline has failed."""
        for display in self._displays.values():
            display.look()

    def close(self) -> None:
        for display in self._displays.values():
            display.close()


class Display:
    """One eye's pipeline, and the thread that writes to it.

    Args:
        launch: the pipeline behind the images, as for gst-launch-1.0.
        size: height and width of an image, px.
        key: RGB, what the display shows as nothing.
        rate: Hz.

    Raises:
        SagsError: GStreamer is not there.
    """

    def __init__(self, launch: str, size: tuple[int, int], key: tuple[int, int, int], rate: float) -> None:
        self.size, self.key = size, key
        height, width = size
        self._empty = _bgrx(np.broadcast_to(np.array(key, np.uint8), (height, width, 3)))
        self._shown = (self._empty, float("inf"))  # and until when, monotonic s
        self._period = 1 / rate
        self._stop = threading.Event()
        end, self._pipe = os.pipe()
        fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        source = (
            f"fdsrc fd={end} do-timestamp=true blocksize={len(self._empty)} "
            f"! rawvideoparse format=bgrx width={width} height={height} framerate={round(1000 * rate)}/1000"
        )
        try:
            self._process = GstProcess({"launch": f"{source} ! {launch}", "sinks": []}, keep=(end,))
        finally:
            os.close(end)
        self._process.start()
        self._thread = threading.Thread(target=self._write, name="sags-display", daemon=True)
        self._thread.start()

    def show(self, picture: U8, seconds: float) -> None:
        """Show an image [H, W, 3] for at most `seconds`."""
        self._shown = (_bgrx(picture), time.monotonic() + seconds)

    def blank(self) -> None:
        self._shown = (self._empty, float("inf"))

    def look(self) -> None:
        """Raises: SagsError: the pipeline has failed or ended."""
        said = self._process.hear(0)
        if said is not None and "ended" in said[0]:
            raise SagsError("GStreamer: the pipeline of a display has ended")

    def close(self) -> None:
        self._stop.set()
        self._process.close()  # a write that waits for it fails then
        self._thread.join(STOPPING)

    def _write(self) -> None:
        due = time.monotonic()
        try:
            while not self._stop.is_set():
                picture, until = self._shown
                rest = memoryview(picture if time.monotonic() < until else self._empty)
                while rest:
                    rest = rest[os.write(self._pipe, rest) :]
                due = max(due + self._period, time.monotonic())  # what was missed is not made up for
                self._stop.wait(due - time.monotonic())
        except BrokenPipeError:
            return  # the pipeline has ended; `look` says why
        finally:
            os.close(self._pipe)


def _bgrx(rgb: U8) -> bytes:
    of_display: U8 = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2BGRA)
    return of_display.tobytes()
