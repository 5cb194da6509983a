"""The process that runs a GStreamer pipeline and puts its newest pictures into shared memory.

    python -m sags_node.sources.gst_child '{"launch": ..., "sinks": ["left", "right"]}' FD
    python -m sags_node.sources.gst_child '{"elements": ["rtspsrc", ...]}' FD
    python -m sags_node.sources.gst_child '{"parse": ...}' FD

FD is a SOCK_SEQPACKET socket. Each message to the parent is JSON: `{"sink", "width", ...}` with the memory's
descriptor before the first picture of a sink, `{"sink", "slot", "t_ns", ...}` for a picture, `{"ended"}`,
`{"error", "debug"}`; `{"parsed"}` of a launch string that is right. The parent gives slots back: two bytes,
the sink's index and the slot. START plays a file, which is paused at first. The process ends when the parent
does. It is one of its own because plugins and drivers may crash or hang.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import queue
import socket
import sys
import threading
import time
from typing import Any

from sags_node.sources.gst_library import (
    ASYNC,
    FAILED,
    LIVE,
    NONE,
    PAUSED,
    PLAYING,
    Caps,
    Gst,
    GstError,
    Picture,
)
from sags_node.wall_clock import DRIFT_NS, WallClock

START = b"\xff\xff"
SLOTS = 4  # pictures of a sink that may be on their way
POLL_NS = 100_000_000
LAST_S = 2.0  # for the parent to take the last pictures of a file
BYTES = {"RGB": 3, "ARGB64_LE": 8}  # of a pixel


class Sink:
    """Hands the newest pictures of one appsink over, in a thread of its own."""

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
                slot = self.free.get()  # the newest picture is taken after there is room for it
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
        if t_ns > after_ns + DRIFT_NS:  # no picture is taken after it arrived
            t_ns = after_ns
        address = self._address + slot * self._slot_bytes
        gst.buffer_extract(gst.sample_get_buffer(sample), 0, address, self._slot_bytes)
        age = now - picture.running
        said = {"sink": self._index, "slot": slot, "t_ns": t_ns, "running_ns": picture.running, "age_ns": age}
        tell(self._there, said)

    def show_first(self) -> None:
        """Say of a paused file what kind of pictures come; none is taken away.

        Raises:
            GstError: they are not of a kind that can be handed over.
        """
        sample = self._gst.app_sink_try_pull_preroll(self.element, POLL_NS)
        if sample:
            self._look(sample, self._gst.picture(sample), live=False)
            self._gst.mini_object_unref(sample)

    def _look(self, sample: int, picture: Picture, live: bool) -> None:
        """Refuse what cannot be handed over; of the first picture, say what kind it is."""
        if NONE in (picture.pts, picture.running):
            raise GstError(
                f"the pictures of {self.name} carry no time stamp",
                "add do-timestamp=true to the source, or a parser (h264parse) before the decoder",
            )
        caps = self._gst.caps(sample)
        if self._caps is None:
            self._begin(caps, picture.bytes, live)
        elif caps[:3] != self._caps[:3]:
            was, now_is = (f"{c.width}x{c.height} {c.format}" for c in (self._caps, caps))
            raise GstError(f"the pictures of {self.name} changed from {was} to {now_is}")

    def _begin(self, caps: Caps, size: int, live: bool) -> None:
        if caps.format not in BYTES or size % max(caps.height, 1) or not size:
            raise GstError(f"{self.name} gives {caps.format} pictures of {size} bytes, not RGB")
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
    """Say it and end at once: a pipeline that failed may not let itself be closed."""
    tell(there, {"error": str(error), "debug": error.debug})
    os._exit(1)


def listen(there: socket.socket, sinks: list[Sink], wanted: threading.Event) -> None:
    """Take slots back, until the parent is gone."""
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
    if state == LIVE:  # the newest picture counts, and what is late is left out
        for sink in sinks:
            gst.set(sink.queue, leaky="downstream")
            gst.set(sink.element, drop="true", sync="false", max_buffers="2")
    else:  # a file does not run away while the node gets ready
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
    for thread in threads:  # the last pictures
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
