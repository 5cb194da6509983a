"""A child process that runs a GStreamer pipeline and puts its newest images into shared memory.

    python -m sags_node.sources.gst_child '{"launch": ..., "sinks": ["left", "right"]}' FD
    python -m sags_node.sources.gst_child '{"elements": ["rtspsrc", ...]}' FD
    python -m sags_node.sources.gst_child '{"parse": ...}' FD

FD is a SOCK_SEQPACKET socket. Each message to the parent is JSON: `{"sink", "width", ...}` with the memory's
descriptor before the first image of a sink, `{"sink", "slot", "t_ns", ...}` for an image, `{"ended"}`,
`{"error", "debug"}`; `{"parsed"}` for a valid launch string. The parent gives slots back by two bytes: the
sink's index and the slot. START plays a file, which is paused at first. The process ends when the parent
does. It is a separate process because plugins and drivers may crash or hang.
"""

import ctypes
import ctypes.util
import json
import mmap
import os
import queue
import socket
import sys
import threading
import time
from ctypes import POINTER, byref, c_char_p, c_int, c_size_t, c_uint32, c_uint64, c_void_p
from typing import Any, NamedTuple

from sags_node.wall_clock import DRIFT_NS, WallClock

START = b"\xff\xff"
SLOTS = 4  # images of a sink in shared memory
POLL_NS = 100_000_000
LAST_S = 2.0  # s for the parent to take the last images of a file
BYTES = {"RGB": 3, "ARGB64_LE": 8}  # per pixel

NONE = 2**64 - 1  # GST_CLOCK_TIME_NONE: unknown
PAUSED, PLAYING = 3, 4
FAILED, DONE, ASYNC, LIVE = 0, 1, 2, 3  # results of a state change; LIVE: no image while paused
ENDED, ERROR = 1 << 0, 1 << 1  # types of messages
TIME = 3  # the format of segments that count time
# Offsets of public fields, bytes. Behind GstMiniObject (64 on 64 bit) a GstMessage has its type, and a
# GstBuffer its pool (8) and then its stamp.
TYPE, PTS = 64, 72


class _Error(ctypes.Structure):
    _fields_ = [("domain", c_uint32), ("code", c_int), ("message", c_char_p)]


class GstError(Exception):
    """An error that GStreamer reports.

    Attributes:
        debug: its detailed text: the place in the source, the element.
    """

    def __init__(self, message: str, debug: str = "") -> None:
        super().__init__(message)
        self.debug = debug


class Picture(NamedTuple):
    """Stamp and size of a buffer."""

    running: int  # running time, ns; `NONE`: not known
    bytes: int


class Caps(NamedTuple):
    """The format of the images."""

    format: str
    width: int
    height: int
    rate: float  # per second, 0: not known
    interlaced: bool


_P, _PP = c_void_p, POINTER(c_void_p)
_GSTREAMER: dict[str, tuple[Any, ...]] = {  # name: result, arguments
    "gst_init_check": (c_int, _P, _P, POINTER(POINTER(_Error))),
    "gst_version_string": (_P,),
    "gst_element_factory_find": (_P, c_char_p),
    "gst_parse_launch": (_P, c_char_p, POINTER(POINTER(_Error))),
    "gst_bin_get_by_name": (_P, _P, c_char_p),
    "gst_util_set_object_arg": (None, _P, c_char_p, c_char_p),
    "gst_element_set_state": (c_int, _P, c_int),
    "gst_element_get_state": (c_int, _P, _P, _P, c_uint64),
    "gst_element_get_base_time": (c_uint64, _P),
    "gst_element_get_clock": (_P, _P),
    "gst_clock_get_time": (c_uint64, _P),
    "gst_element_get_bus": (_P, _P),
    "gst_bus_timed_pop_filtered": (_P, _P, c_uint64, c_int),
    "gst_message_parse_error": (None, _P, POINTER(POINTER(_Error)), _PP),
    "gst_sample_get_buffer": (_P, _P),
    "gst_sample_get_segment": (_P, _P),
    "gst_sample_get_caps": (_P, _P),
    "gst_segment_to_running_time": (c_uint64, _P, c_int, c_uint64),
    "gst_buffer_get_size": (c_size_t, _P),
    "gst_buffer_extract": (c_size_t, _P, c_size_t, _P, c_size_t),
    "gst_caps_get_structure": (_P, _P, c_int),
    "gst_structure_get_int": (c_int, _P, c_char_p, POINTER(c_int)),
    "gst_structure_get_fraction": (c_int, _P, c_char_p, POINTER(c_int), POINTER(c_int)),
    "gst_structure_get_string": (c_char_p, _P, c_char_p),
    "gst_mini_object_unref": (None, _P),
    "gst_object_unref": (None, _P),
}
_APP: dict[str, tuple[Any, ...]] = {
    "gst_app_sink_try_pull_sample": (_P, _P, c_uint64),
    "gst_app_sink_is_eos": (c_int, _P),
    "gst_app_sink_try_pull_preroll": (_P, _P, c_uint64),
}


class Gst:
    """The functions of GStreamer's C library that are needed, by ctypes, as no bindings are installed.
    They and the public structures are stable in all of 1.x.

    Raises:
        GstError: GStreamer is not installed or does not start.
    """

    def __init__(self) -> None:
        for name, functions in (("gstreamer-1.0", _GSTREAMER), ("gstapp-1.0", _APP)):
            file = ctypes.util.find_library(name)
            if file is None:
                raise GstError(f"the library {name} is not installed")
            library = ctypes.CDLL(file)
            for function, (result, *arguments) in functions.items():
                found = getattr(library, function)
                found.restype, found.argtypes = result, arguments
                setattr(self, function.removeprefix("gst_"), found)
        error = POINTER(_Error)()
        if not self.init_check(None, None, byref(error)):
            raise GstError(_text(error))

    def __getattr__(self, name: str) -> Any:  # the functions above
        raise AttributeError(name)

    @property
    def version(self) -> str:
        """The version, e.g. GStreamer 1.22.0."""
        return ctypes.string_at(self.version_string()).decode()

    def has(self, element: str) -> bool:
        """Tell whether this element is installed."""
        return bool(self.element_factory_find(element.encode()))

    def parse(self, launch: str) -> int:
        """Make a pipeline from its launch string.

        Raises:
            GstError: the string is wrong, or an element is missing.
        """
        error = POINTER(_Error)()
        pipeline = self.parse_launch(launch.encode(), byref(error))
        if error or not pipeline:
            raise GstError(_text(error))
        return int(pipeline)

    def set(self, element: int, **properties: str) -> None:
        for name, value in properties.items():
            self.util_set_object_arg(element, name.replace("_", "-").encode(), value.encode())

    def has_ended(self, bus: int, wait_ns: int = 0) -> bool:
        """Tell whether the pipeline has ended; wait at most `wait_ns` for the message.

        Raises:
            GstError: the bus reports an error instead.
        """
        message = self.bus_timed_pop_filtered(bus, wait_ns, ENDED | ERROR)
        if not message:
            return False
        if c_int.from_address(message + TYPE).value == ENDED:
            self.mini_object_unref(message)
            return True
        error, debug = POINTER(_Error)(), c_void_p()
        self.message_parse_error(message, byref(error), byref(debug))
        said = ctypes.string_at(debug.value).decode(errors="replace") if debug.value else ""
        self.mini_object_unref(message)
        raise GstError(_text(error), said)

    def picture(self, sample: int) -> Picture:
        buffer = self.sample_get_buffer(sample)
        pts = c_uint64.from_address(buffer + PTS).value
        running = NONE
        if pts != NONE:
            running = self.segment_to_running_time(self.sample_get_segment(sample), TIME, pts)
        return Picture(running, self.buffer_get_size(buffer))

    def caps(self, sample: int) -> Caps:
        structure = self.caps_get_structure(self.sample_get_caps(sample), 0)
        width, height, per, seconds = c_int(), c_int(), c_int(), c_int(1)
        self.structure_get_int(structure, b"width", byref(width))
        self.structure_get_int(structure, b"height", byref(height))
        self.structure_get_fraction(structure, b"framerate", byref(per), byref(seconds))
        mode = self.structure_get_string(structure, b"interlace-mode") or b"progressive"
        named = self.structure_get_string(structure, b"format") or b""
        rate = per.value / max(seconds.value, 1)
        return Caps(named.decode(), width.value, height.value, rate, mode != b"progressive")


def _text(error: Any) -> str:
    return error.contents.message.decode(errors="replace") if error else "GStreamer says nothing more"


class Sink:
    """Hands the newest images of one appsink to the parent; `run` has a thread of its own."""

    def __init__(
        self, gst: Gst, pipeline: int, wall: WallClock, name: str, index: int, there: socket.socket
    ) -> None:
        self._gst = gst
        self._wall = wall
        self._pipeline = pipeline
        self._index = index
        self._there = there
        self.name = name
        self.element = gst.bin_get_by_name(pipeline, f"{name}_sink".encode())
        self.queue = gst.bin_get_by_name(pipeline, name.encode())
        self.free: queue.SimpleQueue[int] = queue.SimpleQueue()
        for slot in range(SLOTS):
            self.free.put(slot)
        self._caps: Caps | None = None
        self._memory: mmap.mmap | None = None
        self._address = self._slot_bytes = 0

    def run(self, live: bool) -> None:
        try:
            while True:
                slot = self.free.get()  # first a free slot, then the image that is newest by then
                while not (sample := self._gst.app_sink_try_pull_sample(self.element, POLL_NS)):
                    if self._gst.app_sink_is_eos(self.element):
                        return
                try:
                    self._hand_over(sample, slot, live)
                finally:
                    self._gst.mini_object_unref(sample)
        except GstError as error:
            fail(self._there, error)

    def _hand_over(self, sample: int, slot: int, live: bool) -> None:
        gst, picture = self._gst, self._gst.picture(sample)
        clock = gst.element_get_clock(self._pipeline)
        before_ns = time.time_ns()
        now = gst.clock_get_time(clock) if clock else NONE
        after_ns = time.time_ns()
        if clock:
            gst.object_unref(clock)
        if now == NONE:
            raise GstError("the pipeline has no clock")
        self._look(sample, picture, live)
        now -= gst.element_get_base_time(self._pipeline)
        t_ns = self._wall.at_zero((before_ns + after_ns) // 2 - now, after_ns - before_ns) + picture.running
        if t_ns > after_ns + DRIFT_NS:  # an image cannot be taken after it arrived
            t_ns = after_ns
        address = self._address + slot * self._slot_bytes
        gst.buffer_extract(gst.sample_get_buffer(sample), 0, address, self._slot_bytes)
        age = now - picture.running
        said = {"sink": self._index, "slot": slot, "t_ns": t_ns, "running_ns": picture.running, "age_ns": age}
        tell(self._there, said)

    def show_first(self) -> None:
        """Tell the parent the format of a paused file's images, without consuming one.

        Raises:
            GstError: their format cannot be handed over.
        """
        sample = self._gst.app_sink_try_pull_preroll(self.element, POLL_NS)
        if sample:
            self._look(sample, self._gst.picture(sample), live=False)
            self._gst.mini_object_unref(sample)

    def _look(self, sample: int, picture: Picture, live: bool) -> None:
        """Check that an image can be handed over; for the first one, tell the parent its format."""
        if picture.running == NONE:
            raise GstError(
                f"the images of {self.name} carry no time stamp",
                "add do-timestamp=true to the source, or a parser (h264parse) before the decoder",
            )
        caps = self._gst.caps(sample)
        if self._caps is None:
            self._begin(caps, picture.bytes, live)
        elif caps[:3] != self._caps[:3]:
            was, now_is = (f"{c.width}x{c.height} {c.format}" for c in (self._caps, caps))
            raise GstError(f"the images of {self.name} changed from {was} to {now_is}")

    def _begin(self, caps: Caps, size: int, live: bool) -> None:
        if caps.format not in BYTES or size % max(caps.height, 1) or not size:
            raise GstError(f"{self.name} gives {caps.format} images of {size} bytes, not RGB")
        self._caps, self._slot_bytes = caps, size
        memory = os.memfd_create("pictures", os.MFD_CLOEXEC)
        os.ftruncate(memory, SLOTS * size)
        self._memory = mmap.mmap(memory, SLOTS * size)
        self._address = ctypes.addressof(ctypes.c_char.from_buffer(self._memory))
        said = {**caps._asdict(), "sink": self._index, "row": size // caps.height, "live": live}
        tell(self._there, said, memory)
        os.close(memory)


def tell(there: socket.socket, said: dict[str, Any], descriptor: int | None = None) -> None:
    try:
        message = json.dumps(said).encode()
        if descriptor is None:
            there.send(message)
        else:
            socket.send_fds(there, [message], [descriptor])
    except OSError:  # the parent is gone
        os._exit(0)


def fail(there: socket.socket, error: GstError) -> None:
    """Report the error and exit at once: a pipeline that failed may hang when it is closed."""
    tell(there, {"error": str(error), "debug": error.debug})
    os._exit(1)


def listen(there: socket.socket, sinks: list[Sink], wanted: threading.Event) -> None:
    """Take back free slots and the START command, until the parent is gone."""
    while given := there.recv(2):
        if given == START:
            wanted.set()
        else:
            sinks[given[0]].free.put(given[1])
    os._exit(0)


def play(request: dict[str, Any], there: socket.socket) -> None:
    """Run the pipeline until it ends.

    Raises:
        GstError: it fails.
    """
    gst = Gst()
    pipeline = gst.parse(request["launch"])
    bus = gst.element_get_bus(pipeline)
    wall = WallClock()
    sinks = [Sink(gst, pipeline, wall, name, index, there) for index, name in enumerate(request["sinks"])]
    wanted = threading.Event()
    threading.Thread(target=listen, args=(there, sinks, wanted), daemon=True).start()

    state = gst.element_set_state(pipeline, PAUSED)
    while state == ASYNC:
        state = gst.element_get_state(pipeline, None, None, POLL_NS)
        gst.has_ended(bus)  # or failed
    if state == FAILED:
        gst.has_ended(bus, POLL_NS)
        raise GstError("the pipeline does not start")
    if state == LIVE:  # only the newest image counts; late ones are dropped
        for sink in sinks:
            gst.set(sink.queue, leaky="downstream")
            gst.set(sink.element, drop="true", sync="false", max_buffers="2")
    else:  # a file stays paused until the node is ready
        for sink in sinks:
            sink.show_first()
        while not wanted.wait(POLL_NS * 1e-9):
            gst.has_ended(bus)  # or failed
    gst.element_set_state(pipeline, PLAYING)
    threads = [threading.Thread(target=sink.run, args=(state == LIVE,), daemon=True) for sink in sinks]
    for thread in threads:
        thread.start()
    while not gst.has_ended(bus, POLL_NS):
        pass
    for thread in threads:  # let them hand over the last images
        thread.join(LAST_S)
    tell(there, {"ended": True})


def main() -> None:
    request, descriptor = json.loads(sys.argv[1]), int(sys.argv[2])
    there = socket.socket(fileno=descriptor)
    try:
        if "elements" in request:
            gst = Gst()
            tell(
                there, {"version": gst.version, "missing": [e for e in request["elements"] if not gst.has(e)]}
            )
        elif "parse" in request:
            tell(there, {"parsed": bool(Gst().parse(request["parse"]))})
        else:
            play(request, there)
    except GstError as error:
        fail(there, error)
    os._exit(0)


if __name__ == "__main__":
    main()
