"""The disk cache of compiled kernels, which cannot load a stale one.

A kernel's folder is named by everything its machine code depends on (`digest`), so it is never out of date.
Several states of the sources and several compile targets lie side by side; those used last are kept.
"""

from __future__ import annotations

import fcntl
import functools
import inspect
import logging
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator

from sags_node.kernels.digest import kernel_name

log = logging.getLogger(__name__)

KEPT = 1500  # folders: a node uses some 45, of 120 KB each, per state of the sources and compile target
_LOCK_SECONDS = 10.0


def cache_for(function: Callable[..., Any]) -> FunctionCache | None:
    """The disk cache of a kernel, or None where every process must compile it."""
    return _KernelCache(function) if _folder(function) else None


def is_cold(function: Callable[..., Any]) -> bool:
    """Tell whether a kernel must be compiled and the machine code can be kept."""
    folder = _folder(inspect.unwrap(function))
    return folder is not None and not folder.exists()


@functools.cache
def cache_root() -> Path | None:
    """Return the first of these that only this user can write to: `$NUMBA_CACHE_DIR/sags`,
    `$XDG_CACHE_HOME/sags/kernels` (default `~/.cache`), `/tmp/sags-kernels-<uid>`. None: no such place."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    parents = [f"{numba.config.CACHE_DIR}/sags"] if numba.config.CACHE_DIR else []
    for parent in (*parents, f"{home}/sags/kernels", f"/tmp/sags-kernels-{os.getuid()}"):
        root = Path(parent)
        try:
            root.mkdir(mode=0o700, parents=True, exist_ok=True)
            info = root.lstat()
            # To load machine code is to run it.
            if stat.S_ISDIR(info.st_mode) and info.st_uid == os.getuid() and not info.st_mode & 0o022:
                tempfile.TemporaryFile(dir=root).close()
                return root
        except OSError:
            continue
    return None


def _folder(function: Callable[..., Any]) -> Path | None:
    name, root = kernel_name(function), cache_root()
    return _used(root / name) if name and root else None


@functools.cache
def _used(folder: Path) -> Path:
    with suppress(OSError):  # it need not be there yet
        os.utime(folder)
    return folder


class _Locator(_CacheLocator):  # type: ignore[misc]  # Numba has no types
    """Tells Numba where a kernel's files are."""

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        self._py_file = function.__code__.co_filename  # named in Numba's warnings
        self._line = function.__code__.co_firstlineno
        self._folder = folder

    @classmethod
    def from_function(cls, function: Callable[..., Any], _file: str) -> _Locator | None:
        folder = _folder(function)
        return cls(function, folder) if folder else None

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Files(CompileResultCacheImpl):  # type: ignore[misc]  # Numba has no types
    _locator_classes: ClassVar = [_Locator]


class _KernelCache(FunctionCache):  # type: ignore[misc]  # Numba has no types
    """Numba's cache of one function, made safe for damaged files, full disks and several processes."""

    _impl_class = _Files

    def load_overload(self, signature: Any, target: Any) -> Any:
        try:
            return super().load_overload(signature, target)
        except Exception as error:  # reading a damaged file may raise anything
            log.warning("%s is damaged (%r): its kernels are compiled anew", self.cache_path, error)
            shutil.rmtree(self.cache_path, ignore_errors=True)
            return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        folder = Path(self.cache_path)
        try:
            # Numba reads a function's index, adds to it and writes it. Two processes at once would lose an
            # entry, or give one file to two signatures: the wrong code for one of them.
            with _lock(folder.parent):
                is_new = not folder.exists()
                super().save_overload(signature, compiled)
                if is_new:
                    clear_old(folder.parent)
        except OSError as error:
            _warn(f"compiled kernels cannot be kept in {folder.parent}: {error.strerror or error}")


@contextmanager
def _lock(root: Path) -> Iterator[None]:
    with open(root / ".lock", "w") as file:
        patience = time.monotonic() + _LOCK_SECONDS
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > patience:
                    raise
                time.sleep(0.01)
        yield


def clear_old(root: Path) -> None:
    """Delete all but the `KEPT` folders that were used last. A process that misses one compiles again."""
    used = {}
    for folder in root.glob("*-*"):
        with suppress(OSError):
            used[folder] = folder.stat().st_mtime
    for folder in sorted(used, key=used.__getitem__, reverse=True)[KEPT:]:
        shutil.rmtree(folder, ignore_errors=True)


@functools.cache
def _warn(message: str) -> None:
    """Log a message, but only once in this process."""
    log.warning(message)
