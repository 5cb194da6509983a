"""The few functions of GStreamer's C library that `gst_child` needs, by ctypes: no bindings are installed.

GStreamer promises that functions and the public fields of its structures stay the same in all of 1.x.
"""

from __future__ import annotations

import ctypes
import ctypes.util
from ctypes import POINTER, byref, c_char_p, c_int, c_size_t, c_uint32, c_uint64, c_void_p
from typing import Any, NamedTuple

NONE = 2**64 - 1  # a time that is not known
PAUSED, PLAYING = 3, 4
FAILED, DONE, ASYNC, LIVE = 0, 1, 2, 3  # what a change of state answers; LIVE: no picture while paused
ENDED, ERROR = 1 << 0, 1 << 1  # messages
TIME = 3  # the format of segments that count time
# Places of public fields, bytes: behind GstMiniObject (64 on 64 bit) lies the type of a GstMessage, and in a
# GstBuffer its pool (8), then its stamp.
TYPE, PTS = 64, 72


class _Error(ctypes.Structure):
    _fields_ = [("domain", c_uint32), ("code", c_int), ("message", c_char_p)]


class GstError(Exception):
    """What GStreamer says.

    Attributes:
        debug: where, for its developers.
    """

    def __init__(self, message: str, debug: str = "") -> None:
        super().__init__(message)
        self.debug = debug


class Picture(NamedTuple):
    """What is known of a buffer."""

    pts: int  # ns, `NONE` where it has no stamp
    running: int  # ns since the pipeline's base time, `NONE` where that cannot be said
    bytes: int


class Caps(NamedTuple):
    """What kind of pictures come."""

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
    """GStreamer, initialised.

    Raises:
        GstError: it is not installed or does not start.
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
        """E.g. GStreamer 1.22.0."""
        return ctypes.string_at(self.version_string()).decode()

    def has(self, element: str) -> bool:
        """Tell whether a plugin is installed that brings this element."""
        return bool(self.element_factory_find(element.encode()))

    def parse(self, launch: str) -> int:
        """A pipeline from its launch string.

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
        """Tell whether the bus says so, waited for at most so long.

        Raises:
            GstError: it tells of an error instead.
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
        return Picture(pts, running, self.buffer_get_size(buffer))

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
