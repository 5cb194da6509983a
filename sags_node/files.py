"""Files that others made: only plain ones are opened. A pipe or a device would make the reader wait."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

_KINDS = (
    (stat.S_ISDIR, "it is a folder"),
    (stat.S_ISFIFO, "it is a pipe, no file"),
    (stat.S_ISSOCK, "it is a socket, no file"),
    (stat.S_ISCHR, "it is a device, no file"),
    (stat.S_ISBLK, "it is a device, no file"),
)


def open_file(path: Path) -> BinaryIO:
    """Open a plain file for reading.

    Raises:
        OSError: it cannot be opened, or is a folder, pipe, socket or device; `strerror` says which.
    """
    _refuse_others(path, path.stat().st_mode)  # before it is opened: that alone wakes some devices
    opened = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _refuse_others(path, os.fstat(opened).st_mode)  # it may have been another one before
    except OSError:
        os.close(opened)
        raise
    return os.fdopen(opened, "rb")


def read_file(path: Path, largest: int) -> bytes:
    """The content of a plain file.

    Raises:
        OSError: as `open_file`, or it has more than `largest` bytes; nothing is read then.
    """
    with open_file(path) as opened:
        size = os.fstat(opened.fileno()).st_size
        if size > largest:
            raise OSError(errno.EFBIG, f"it has {size} bytes, {largest} at most are read", str(path))
        return opened.read(largest)


def _refuse_others(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        what = next((said for is_kind, said in _KINDS if is_kind(mode)), "it is no file")
        raise OSError(errno.EINVAL, what, str(path))
