"""Files that others made: only plain ones are opened. A pipe or a device would make the reader wait.

Files that we make: each appears only when it is complete, and replaces nothing but our own results.
"""

import difflib
import errno
import fcntl
import json
import logging
import os
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from sags_node.errors import SagsError, UsageError, brief

SHOWN = "[!.]*"  # no hidden files: macOS puts `._NAME` beside each on foreign disks
NO_TEXT = "holds bytes that are no UTF-8 text, so no other program can be told of it: rename it"
LARGEST_RESULT = 64 << 20  # bytes of figures as JSON
log = logging.getLogger(__name__)
_checked: set[Path] = set()  # checked without --force: `whole` keeps a file that appears there later
_KINDS = (
    (stat.S_ISDIR, "it is a folder"),
    (stat.S_ISFIFO, "it is a pipe, no file"),
    (stat.S_ISSOCK, "it is a socket, no file"),
    (stat.S_ISCHR, "it is a device, no file"),
    (stat.S_ISBLK, "it is a device, no file"),
)


def is_text(name: str) -> bool:
    """Tell whether a name is UTF-8; Python reads others by surrogates, which nothing can write."""
    return not any("\ud800" <= letter <= "\udfff" for letter in name)


def check_name(path: Path) -> None:
    """Refuse a file whose name could not be published.

    Raises:
        UsageError: the name is no text.
    """
    if not is_text(str(path)):
        raise UsageError(f"{brief(str(path))} {NO_TEXT}")


def open_file(path: Path) -> BinaryIO:
    """Open a plain file for reading.

    Raises:
        OSError: it cannot be opened, or is a folder, pipe, socket or device; `strerror` says which.
    """
    _refuse_others(path, path.stat().st_mode)  # before it is opened: that alone wakes some devices
    opened = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _refuse_others(path, os.fstat(opened).st_mode)  # another file may have taken its name since
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


def near(path: Path) -> str:
    """The remedy for a path that cannot be read: where nothing is there, the most similar name beside it."""
    try:
        beside = [] if path.exists() else [each.name for each in path.absolute().parent.iterdir()]
    except OSError:
        return "check the path"
    names = difflib.get_close_matches(path.name, beside, n=1)
    return f"did you mean {path.parent / names[0]}?" if names else "check the path"


def _refuse_others(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        what = next((said for is_kind, said in _KINDS if is_kind(mode)), "it is no file")
        raise OSError(errno.EINVAL, what, str(path))


# ---- writing ---------------------------------------------------------------------------------------------


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """Turn an error of writing (full disk, missing rights) into one message.

    Raises:
        SagsError: the block raised an `OSError`.
    """
    try:
        yield
    except OSError as error:
        raise SagsError(f"cannot write {target}: {error.strerror or error}; name another place") from None


@contextmanager
def whole(path: Path, new: bool = False) -> Iterator[Path]:
    """Give a temporary path on the same disk to write a file or folder to. When the block succeeds, it is
    moved to `path`. Otherwise it is deleted, and what stood at `path` stays.

    Args:
        new: no file is replaced. After `check_file` or `check_results`, only what they allow is replaced.
            Both hold also for a file that appears at `path` meanwhile.

    Raises:
        SagsError: it cannot be written, or another file is there.
    """
    target = Path(os.path.realpath(path))  # through a link, not over it
    if new and os.path.lexists(target):
        raise SagsError(f"{path} exists already; choose another name")
    with writing(path), tempfile.TemporaryDirectory(prefix=".sags-", dir=target.parent) as passing:
        partial = Path(passing) / path.name
        yield partial
        if (new or target in _checked) and not partial.is_dir():  # a folder can only replace an empty folder
            try:
                target.open("xb").close()  # only one program can create it
            except FileExistsError:
                if new or not is_result(target):
                    said = "exists now: another program wrote it meanwhile, and it was left as it is"
                    raise SagsError(f"{path} {said}; choose another name, or remove it") from None
        partial.replace(target)
        _checked.discard(target)  # from now on it is ours


def check_folder(folder: Path) -> None:
    """Make the folder, and check that a file can be created in it.

    Raises:
        SagsError: it cannot.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Lock the folder against other programs that lock it, during the block, where its disk has locks.

    Raises:
        UsageError: another one does.
    """
    opened = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            said = f"another program writes into {folder}; wait for its end, or name another folder"
            raise UsageError(said) from None
        except OSError as error:  # network disks may be unable to lock folders
            log.debug("%s is not locked: %s", folder, error)
        yield
    finally:
        os.close(opened)


def check_file(file: Path, force: bool | None = None) -> None:
    """Check that this file can be written, without changing it.

    Args:
        force: any file may be replaced. Otherwise only an empty one, or earlier figures: JSON that has the
            key `provenance`. None: as False, for a command without an option --force.

    Raises:
        UsageError: another file is there.
        SagsError: it cannot be written.
    """
    check_folder(file.parent)
    _checked.discard(file.resolve())
    if not force:
        _checked.add(file.resolve())
    with writing(file):
        if not file.exists():
            return
        _refuse_others(file, file.stat().st_mode)
        file.open("r+b").close()
        if force or is_result(file):
            return
    remedy = "remove it" if force is None else "add --force"
    raise UsageError(f"{file} exists already; choose another name, or {remedy}")


def check_results(folder: Path, names: Sequence[str], ours: bool) -> None:
    """Check the folder as `check_folder` does, and that results of these names may be written in it.

    Args:
        ours: files of these names are known to come from an earlier run, and may be replaced.

    Raises:
        UsageError: something else is there.
        SagsError: the folder cannot be written to.
    """
    check_folder(folder)
    there = [name for name in names if (folder / name).exists()]
    if there and not ours:
        raise UsageError(
            f"{folder / there[0]} exists already and is no earlier result; choose another folder"
        )
    _checked.update((folder / name).resolve() for name in names if name not in there)


def is_result(file: Path) -> bool:
    """Tell whether this is an empty file, or figures as JSON with the key `provenance`."""
    size = file.stat().st_size
    try:
        return size == 0 or (size <= LARGEST_RESULT and "provenance" in json.loads(file.read_bytes()))
    except (ValueError, TypeError):  # no JSON, or a single number
        return False
