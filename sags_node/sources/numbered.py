"""Reads files of one kind, one per frame, from a folder or a `.tar.gz`, by the number in their names."""

import re
import tarfile
import zlib
from pathlib import Path

from sags_node.errors import SagsError, UsageError
from sags_node.files import open_file, read_file


class NumberedFiles:
    """The files in a folder.

    Args:
        suffix: of the files, with the dot.
        largest: largest size of a file, bytes.
    """

    def __init__(self, folder: Path, suffix: str, largest: int) -> None:
        self._largest = largest
        self._files = {_number(file.name, suffix): file for file in folder.iterdir()}

    def read(self, number: int) -> bytes | None:
        """Return the content of the file with this number, None if there is none.

        Raises:
            SagsError: it cannot be read, or is too large to be right.
        """
        file = self._files.get(number)
        try:
            return None if file is None else read_file(file, self._largest)
        except OSError as error:
            raise SagsError(f"cannot read {file}: {error.strerror}") from None

    def close(self) -> None:
        """Nothing stays open."""


def open_numbered(path: Path, suffix: str, largest: int) -> NumberedFiles | None:
    """Open the files in folder `path`, or else in `path` + `.tar.gz`; None when there is neither.

    Raises:
        UsageError: the archive cannot be read.
    """
    if path.is_dir():
        return NumberedFiles(path, suffix, largest)
    archive = path.with_name(path.name + ".tar.gz")
    return _Packed(archive, suffix, largest) if archive.is_file() else None


class _Packed(NumberedFiles):
    """Files in an archive: reads forward as far as needed; to go back, it unpacks from the start again."""

    def __init__(self, archive: Path, suffix: str, largest: int) -> None:
        self._archive = archive
        self._suffix = suffix
        self._largest = largest
        self._members: dict[int | None, tarfile.TarInfo] = {}
        try:
            self._file = open_file(archive)
            self._tar = tarfile.open(fileobj=self._file, mode="r:gz")
        except (tarfile.TarError, OSError, EOFError, zlib.error) as error:
            raise UsageError(
                f"{archive} is not a readable tar.gz: {error}; unpack or download it again"
            ) from None

    def read(self, number: int) -> bytes | None:
        try:
            while number not in self._members:
                member = self._tar.next()
                if member is None:
                    return None
                if member.isfile():
                    self._members[_number(Path(member.name).name, self._suffix)] = member
            member = self._members[number]
            if member.size > self._largest:
                raise SagsError(
                    f"{self._archive}: {member.name} has {member.size} bytes, more than the "
                    f"{self._largest} it can need; it is not what it seems"
                )
            stream = self._tar.extractfile(member)
            assert stream is not None  # only members that are files are kept
            return stream.read()
        except (tarfile.TarError, OSError, EOFError, zlib.error) as error:
            raise SagsError(f"{self._archive} is cut off or damaged ({error}); download it again") from None

    def close(self) -> None:
        self._tar.close()
        self._file.close()


def _number(name: str, suffix: str) -> int | None:
    """The last number in the name of a file; None for other suffixes and hidden files."""
    found = re.search(rf"(\d+){re.escape(suffix)}$", name)
    return int(found[1]) if found and not name.startswith(".") else None
