"""What C libraries write to stderr by themselves, kept from the terminal for whoever called them.

libpng, libjpeg, RPly and FFmpeg print what they think of a file, without its name and beside our own message.
"""

from __future__ import annotations

import os
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

STDERR = 2
MOST_BYTES = 1 << 16  # of what is kept; a library can say the same for every row of a picture
_LIBRARY = re.compile(
    rb"libpng (error|warning): |RPly: |\[[\w,]+ @ 0x[0-9a-f]+\] |\[ ?[A-Z]+:\d+@[\d.]+\] |OpenCV\([\d.]+\) "
    # libjpeg's warnings have no common beginning
    rb"|Corrupt JPEG data: |Premature end of JPEG file|Invalid SOS parameters|Inconsistent progression "
    rb"|Warning: unknown JFIF revision |Unknown Adobe color transform "
)
_lock = threading.RLock()  # the descriptor is the whole process's


@contextmanager
def native_output() -> Iterator[list[str]]:
    """Keep the lines that libraries write meanwhile; they are in the list when the block has ended.

    Everything else that is written there, by other threads, goes where it should, a moment later.
    """
    lines: list[str] = []
    with _lock:
        if sys.stderr is not None:
            sys.stderr.flush()
        kept = os.memfd_create("stderr", os.MFD_CLOEXEC)
        try:
            terminal = os.dup(STDERR)
        except OSError:  # this process has no stderr: nothing to keep from it
            os.close(kept)
            yield lines
            return
        os.dup2(kept, STDERR)
        try:
            yield lines
        finally:
            os.dup2(terminal, STDERR)
            os.close(terminal)
            _sort(kept, lines)


def _sort(kept: int, lines: list[str]) -> None:
    size = os.lseek(kept, 0, os.SEEK_END)
    if size:
        others, of_library = b"", False
        for line in os.pread(kept, MOST_BYTES, 0).splitlines(keepends=True):
            of_library = _LIBRARY.match(line) is not None or (of_library and not line.strip())
            if not of_library:
                others += line
            elif line.strip():
                lines.append(line.decode("utf-8", "replace").strip())
        if others:
            os.write(STDERR, others)
    os.close(kept)
