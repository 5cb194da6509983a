"""Where an archive's results lie: a folder, or a URL that fsspec knows. Whatever appears there is whole.

archive.json      the job, its settings, and where the recordings lie
manifest.csv      the recordings
recordings/ID/    what the job left of one, and log.txt
done/ID.KEY.json  its figures, written after all of recordings/ID; KEY is the hash of what it was made of
failed/ID.json    the attempts that failed, and why; failed/ID.log: what the last one said
partial/          what is being written
results.parquet   one row for each recording; report.html shows them
"""

import fcntl
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from sags_node.errors import SagsError, UsageError

DONE, FAILED, RECORDINGS, PARTIAL = "done", "failed", "recordings", "partial"
ABOUT, MANIFEST, RESULTS, REPORT = "archive.json", "manifest.csv", "results.parquet", "report.html"
LOCK = ".lock"


class Store:
    """Reads and writes under one folder or URL.

    Attributes:
        local: the folder; None: it is a URL of something else.

    Raises:
        UsageError: fsspec does not know such a URL, or a package for it is missing.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        try:
            self._fs, self._root = url_to_fs(url, use_listings_cache=False)
        except (ValueError, ImportError) as error:
            raise UsageError(f"{url}: {error}") from None
        self.local = Path(self._root) if isinstance(self._fs, LocalFileSystem) else None

    def read(self, name: str) -> bytes | None:
        """Read a file; None where there is none."""
        try:
            data: bytes = self._fs.cat_file(f"{self._root}/{name}")
        except FileNotFoundError:
            return None
        return data

    def read_many(self, names: Sequence[str]) -> list[bytes | None]:
        """Read files, as `read`; from a URL many at the same time.

        Raises:
            OSError: one is there and cannot be read.
        """
        if self.local is not None:
            return [self.read(name) for name in names]
        paths = [f"{self._root}/{name}" for name in names]
        found = self._fs.cat(paths, on_error="return") if paths else {}
        for data in found.values():
            if isinstance(data, Exception) and not isinstance(data, FileNotFoundError):
                raise OSError(f"{self.url} cannot be read: {data}")
        return [data if isinstance(data := found.get(path), bytes) else None for path in paths]

    def read_json(self, name: str) -> Any:
        """Read a JSON file; see `read_all_json`."""
        return self.read_all_json([name])[0]

    def read_all_json(self, names: Sequence[str]) -> list[Any]:
        """Read JSON files, as `read_many`.

        Raises:
            SagsError: one is damaged.
        """
        found: list[Any] = []
        for name, data in zip(names, self.read_many(names), strict=True):
            try:
                found.append(None if data is None else json.loads(data))
            except ValueError:
                what = f"{self.url}/{name} is damaged; remove it"
                raise SagsError(f"{what}, then sags archive run does again what it told of") from None
        return found

    def write(self, name: str, data: bytes) -> None:
        """Write a file, whole or not at all; an earlier one is replaced.

        Raises:
            OSError: it cannot be written.
        """
        if self.local is None:
            self._fs.pipe_file(f"{self._root}/{name}", data)  # an object appears when all of it is there
            return
        target = self.local / name
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f".{target.name}.{os.getpid()}")
        try:
            with partial.open("wb") as file:
                file.write(data)
                os.fsync(file.fileno())
            partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)

    def write_json(self, name: str, value: Any) -> None:
        self.write(name, json.dumps(value, indent=1).encode() + b"\n")

    def remove(self, name: str) -> None:
        """Remove a file or folder, where there is one."""
        with suppress(FileNotFoundError):
            self._fs.rm(f"{self._root}/{name}", recursive=True)

    def names(self, folder: str) -> list[str]:
        """Return the names of files and folders in a folder, sorted, without those still being written."""
        try:
            found = self._fs.ls(f"{self._root}/{folder}", detail=False)
        except FileNotFoundError:
            return []
        names = sorted(path.rstrip("/").rpartition("/")[2] for path in found)
        return [name for name in names if not name.startswith(".")]

    def done(self, settings: str = "") -> dict[str, str]:
        """Return the keys, by id, of recordings done with these settings (of `settings_of`; "": with any)."""
        found = (name.split(".")[:2] for name in self.names(DONE))
        return {id: key for id, key in found if key.startswith(settings)}

    @contextmanager
    def partial(self, name: str) -> Iterator[Path]:
        """Make an empty folder of this machine to write in; it is removed at the end."""
        parent = None if self.local is None else self.local / PARTIAL
        if parent is not None:
            parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f"{name}.", dir=parent))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def finish(self, id: str, key: str, folder: Path, row: dict[str, Any]) -> None:
        """Put a recording's results in their place, then say that it is done.

        Raises:
            OSError: something cannot be written; then it does not count as done.
        """
        marker = f"{DONE}/{id}.{key}.json"
        if self.read(marker) is not None:
            return  # done already, by a worker that was believed lost
        self.remove(f"{RECORDINGS}/{id}")  # of an attempt that was cut off, or from before something changed
        if self.local is None:
            self._fs.put(f"{folder}/", f"{self._root}/{RECORDINGS}/{id}/", recursive=True)
        else:
            for file in folder.rglob("*"):
                _sync(file)
            target = self.local / RECORDINGS / id
            target.parent.mkdir(parents=True, exist_ok=True)
            folder.rename(target)
        self.write_json(marker, row)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Only one run at a time, where the folder is local.

        Raises:
            UsageError: another one is running.
            SagsError: the folder cannot be written to.
        """
        if self.local is None:
            yield
            return
        try:
            self.local.mkdir(parents=True, exist_ok=True)
            lock = (self.local / LOCK).open("w")
        except OSError as error:
            raise SagsError(f"cannot write {self.local}: {error.strerror}; name another place") from None
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UsageError(f"another sags archive run works on {self.url}; wait for its end") from None
            self.remove(PARTIAL)  # of a run that was killed
            try:
                yield
            finally:
                self.remove(PARTIAL)  # of workers that were killed


def _sync(file: Path) -> None:
    opened = os.open(file, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
