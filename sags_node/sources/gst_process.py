"""The parent's end of `gst_child`: starts it, receives its messages, and explains why it failed."""

import json
import os
import re
import select
import socket
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from sags_node.errors import SagsError
from sags_node.processes import end
from sags_node.sources.gst_child import START

ASK_S = 30.0  # s to list the elements: the first time, GStreamer scans all its plugins
GRACE_S = 1.0  # s for the process to end by itself
LONGEST_MESSAGE = 1 << 16  # bytes
KEPT = 2000  # bytes kept of what plugins print
PLAIN, GOOD, BAD = (f"gstreamer1.0-plugins-{name}" for name in ("base", "good", "bad"))
ELEMENTS = {  # that the launch files use, and the Debian package of each
    "appsink": PLAIN,
    "rawvideoparse": PLAIN,
    "videoconvert": PLAIN,
    "videotestsrc": PLAIN,
    "decodebin": PLAIN,
    "deinterlace": GOOD,
    "videocrop": GOOD,
    "v4l2src": GOOD,
    "rtspsrc": GOOD,
    "h264parse": BAD,
    "decklinkvideosrc": BAD,
    "unixfdsrc": f"{BAD} of GStreamer 1.24",
    "avdec_h264": "gstreamer1.0-libav",
}
SEE_PLACE = "check the path, address or device in the launch string"
SEE_STRING = "try the string with gst-launch-1.0; gst-inspect-1.0 ELEMENT lists what an element takes"
FIXES = (  # pattern in GStreamer's error, and what helps
    (r"no element \"(\w+)\"", "install {package}"),
    (r"not-negotiated|could not link|can't handle caps", "neighbours do not agree on format, size or rate"),
    (r"busy|in use", "another program uses it"),
    (r"No such|not found|Could not (open|connect|resolve|read)|Cannot identify", SEE_PLACE),
    (r"syntax error|unexpected|no property|could not set property|erroneous", SEE_STRING),
    (r"plug-?in|no decoder", "install gstreamer1.0-libav, or the plugin it names"),
)


class GstProcess:
    """A child and its socket.

    Args:
        request: the job, see `gst_child`.
        keep: file descriptors named in `request`, which the child inherits.
    """

    def __init__(self, request: dict[str, Any], keep: Sequence[int] = ()) -> None:
        self._here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [sys.executable, "-P", "-m", "sags_node.sources.gst_child"]
        command += [json.dumps(request), str(there.fileno())]
        self._printed = b""
        try:
            self._process = subprocess.Popen(
                command,
                pass_fds=[there.fileno(), *keep],
                stdin=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                process_group=0,  # Ctrl-C in the terminal reaches the node only, which then ends it
                env={"GST_DEBUG": "1", **os.environ, "GST_DEBUG_NO_COLOR": "1"},  # 1: errors
            )
        finally:
            there.close()
        assert self._process.stderr is not None
        self._stderr = self._process.stderr.fileno()
        os.set_blocking(self._stderr, False)
        self._events = select.poll()
        self._events.register(self._here, select.POLLIN)
        self._events.register(self._stderr, select.POLLIN)

    def hear(self, seconds: float) -> tuple[dict[str, Any], list[int]] | None:
        """Receive the next message and its file descriptors; None when none comes in time.

        Raises:
            SagsError: the child has failed.
        """
        for descriptor, _ in self._events.poll(seconds * 1e3):
            if descriptor == self._stderr:
                self._keep()
            else:
                message, descriptors = self._receive()
                if not message:
                    raise SagsError(self._last_words())
                said = json.loads(message)
                if "error" in said:
                    self._keep()
                    raise SagsError(in_words(said["error"], said["debug"] or self._logged()))
                return said, descriptors
        return None

    def _receive(self) -> tuple[bytes, list[int]]:
        try:
            message, descriptors, _, _ = socket.recv_fds(self._here, LONGEST_MESSAGE, 1)
        except ConnectionResetError:  # it ended before it read all; its own message comes next
            message, descriptors, _, _ = socket.recv_fds(self._here, LONGEST_MESSAGE, 1)
        return message, descriptors

    def start(self) -> None:
        """Start to play a file, which waits at its first image. Live pipelines play anyway."""
        self._tell(START)

    def release(self, sink: int, slot: int) -> None:
        """Give a slot back after its image was copied."""
        self._tell(bytes((sink, slot)))

    def _tell(self, message: bytes) -> None:
        try:
            self._here.send(message)
        except OSError:
            pass  # it has ended; `hear` says why

    def close(self) -> None:
        self._here.close()
        end(self._process, GRACE_S)
        assert self._process.stderr is not None
        self._process.stderr.close()

    def _keep(self) -> None:
        """Read and keep what plugins print: a full pipe would block them."""
        try:
            printed = os.read(self._stderr, LONGEST_MESSAGE)
        except BlockingIOError:
            return
        if not printed:
            self._events.unregister(self._stderr)
        self._printed = (self._printed + printed)[-KEPT:]

    def _logged(self) -> str:
        """The last error in the child's log, as some elements report only there; empty if there is none."""
        found = re.findall(r" ERROR .*?:<(\S+)> (.*)", self._printed.decode(errors="replace"))
        return ": ".join(found[-1]) if found else ""

    def _last_words(self) -> str:
        """An error text for a child that ended without a message: its last line of output."""
        ended = end(self._process, GRACE_S)
        self._keep()
        lines = self._printed.decode(errors="replace").strip().splitlines()
        said = f": {lines[-1].strip()}" if lines else ""
        code = self._process.returncode if ended else None
        how = f"was ended by signal {-code}" if code is not None and code < 0 else "ended"
        return f"GStreamer: its process {how}{said}"


def in_words(message: str, debug: str) -> str:
    """Return one line for the user: what failed, in which element, and what helps.

    Args:
        message: the text of the error.
        debug: its debug text: place in the source, the element's path, and details.
    """
    path = re.search(r"/GstPipeline:\S*?:(\w+):?\s*$", debug, re.MULTILINE)
    detail = debug.strip().splitlines()[-1].strip() if debug.strip() else ""
    is_place = bool(path and path[0].strip() in detail)
    said = message.strip().rstrip(".")
    where = f"{path[1]}: " if path else ""
    more = "" if is_place or not detail or detail in said else f" ({detail.rstrip('.')})"
    for pattern, fix in FIXES:
        found = re.search(pattern, f"{said} {detail}", re.IGNORECASE)
        if found is not None:
            named = found[1] if "{" in fix else ""
            help = fix.format(package=ELEMENTS.get(named, "the plugin that has it"))
            return f"GStreamer: {where}{said}{more}; {help}"
    return f"GStreamer: {where}{said}{more}"


def installed() -> tuple[str, dict[str, str]]:
    """Return GStreamer's version, and those of `ELEMENTS` that are missing, with their packages.

    Raises:
        SagsError: GStreamer is not installed, or does not answer.
    """
    said = _asked({"elements": list(ELEMENTS)})
    return said["version"], {name: ELEMENTS[name] for name in said["missing"]}


def check_launch(launch: str) -> None:
    """Check that GStreamer accepts this launch string; nothing is played.

    Raises:
        SagsError: an element is missing, or the string is wrong.
    """
    _asked({"parse": launch})


def _asked(request: dict[str, Any]) -> dict[str, Any]:
    child = GstProcess(request)
    try:
        heard = None
        for _ in range(10):
            heard = heard or child.hear(ASK_S / 10)
    finally:
        child.close()
    if heard is None:
        raise SagsError(f"GStreamer does not answer within {ASK_S:g} s")
    return heard[0]
