"""The list of an archive's recordings: a CSV or Parquet file, a row for each.

Columns: `recording` (a path or URL; relative ones are beside the file), `rig` (the same, of a calibration;
empty where the recording brings one), `overrides` (`key:=value`, separated by spaces, quoted as in a shell),
`weight` (what it costs, in any unit: the dearest begin first) and `segment` (a name for the part of it that
the overrides say; see `segments`). Only `recording` is needed.
"""

import csv
import hashlib
import io
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from fsspec.core import url_to_fs

from sags_node.errors import SagsError, UsageError, brief, install
from sags_node.files import check_file, whole

COLUMNS = ("recording", "rig", "overrides", "weight", "segment")
PARQUET = ".parquet"
SUFFIXES = (".csv", PARQUET)
SEGMENT = re.compile(r"[A-Za-z0-9_-]{1,40}")  # it becomes a part of file names


@dataclass(frozen=True, slots=True)
class Recording:
    """One row.

    Attributes:
        name: path or URL as the manifest says it.
        folder: of the manifest; relative names start there.
        weight: what it costs, relative to the others.
        segment: name of the part that the row stands for; empty: all of it.
    """

    name: str
    folder: str
    rig_name: str | None = None
    overrides: tuple[str, ...] = ()
    weight: float = 1.0
    segment: str = ""

    @property
    def id(self) -> str:
        """Its name in file names: the end of its path, its segment, and a hash of its name and overrides."""
        parts = [part for part in PurePosixPath(self.name).parts if part not in ("/", "..")]
        end = re.sub(r"[^A-Za-z0-9-]+", "_", "_".join(parts[-2:])).strip("_")
        said = "\n".join((self.name, *self.overrides))
        segment = f"-{self.segment}" if self.segment else ""
        return f"{end[-60:]}{segment}-{hashlib.sha256(said.encode()).hexdigest()[:8]}"

    @property
    def place(self) -> str:
        """Its full path or URL."""
        return _from(self.folder, self.name)

    @property
    def rig(self) -> str | None:
        return None if self.rig_name is None else _from(self.folder, self.rig_name)


def is_url(place: str) -> bool:
    return "://" in place


def _from(folder: str, name: str) -> str:
    return name if is_url(name) or name.startswith("/") else f"{folder.rstrip('/')}/{name}"


def read_manifest(url: str) -> list[Recording]:
    """Read all rows, in the file's order.

    Args:
        url: path or URL (fsspec) of a .csv or .parquet file.

    Raises:
        UsageError: it is missing, no CSV or Parquet file, or a row is wrong; the message names the row.
    """
    try:
        fs, path = url_to_fs(url)
        data = fs.cat_file(path)
    except (OSError, ValueError, ImportError) as error:
        raise UsageError(f"{url} cannot be read: {error}") from None
    rows = _parquet_rows(data, url) if path.endswith(PARQUET) else _csv_rows(data, url)
    folder = fs.unstrip_protocol(fs._parent(path)) if is_url(url) else fs._parent(path)
    found = [_recording(row, number, folder, url) for number, row in enumerate(rows, 1)]
    seen: dict[str, int] = {}
    for number, recording in enumerate(found, 1):
        if recording.id in seen:
            raise UsageError(
                f"{url}: row {number} is row {seen[recording.id]} again ({recording.name}); remove one, or "
                "give them different overrides"
            )
        seen[recording.id] = number
    if not found:
        raise UsageError(f"{url} lists no recording; sags archive scan FOLDER makes a manifest")
    return found


def _csv_rows(data: bytes, url: str) -> list[Mapping[str, Any]]:
    try:
        return list(csv.DictReader(io.StringIO(data.decode("utf-8-sig"), newline="")))
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{url} is no CSV file in UTF-8: {error}") from None


def _parquet_rows(data: bytes, url: str) -> list[Mapping[str, Any]]:
    pq = parquet()
    import pyarrow as pa

    try:
        rows: list[Mapping[str, Any]] = pq.read_table(pa.BufferReader(data)).to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise UsageError(f"{url} is no Parquet file: {error}") from None
    return rows


def _recording(row: Mapping[str, Any], number: int, folder: str, url: str) -> Recording:
    unknown = [str(key) for key in row if key not in COLUMNS]
    if unknown or not row.get("recording"):
        raise UsageError(
            f"{url}, row {number}: "
            + (f"unknown column '{unknown[0]}'" if unknown else "no recording")
            + f"; the columns are {', '.join(COLUMNS)}"
        )
    try:
        overrides = tuple(shlex.split(row.get("overrides") or ""))
        weight = float(row.get("weight") or 1.0)
    except ValueError as error:
        raise UsageError(f"{url}, row {number}: {brief(row)}: {error}") from None
    wrong = [override for override in overrides if ":=" not in override]
    if wrong or not weight > 0:
        what = f"'{wrong[0]}' is not key:=value" if wrong else f"weight {weight} should be above 0"
        raise UsageError(f"{url}, row {number}: {what}")
    segment = str(row.get("segment") or "")
    if segment and not SEGMENT.fullmatch(segment):
        raise UsageError(f"{url}, row {number}: segment '{segment}' should be letters, digits, - and _")
    return Recording(str(row["recording"]), folder, row.get("rig") or None, overrides, weight, segment)


def beside(recording: Recording, url: str) -> Recording:
    """Return the row of a recording of this machine for a manifest at `url`. Names below its folder become
    relative to that; others stay absolute."""
    folder = url.rpartition("/")[0] if is_url(url) else str(Path(url).resolve().parent)

    def name(place: str) -> str:
        inside = Path(place).is_relative_to(folder)
        return Path(place).relative_to(folder).as_posix() if inside else place

    rig = None if recording.rig is None else name(recording.rig)
    return replace(recording, name=name(recording.place), folder=folder, rig_name=rig)


def check_manifest(url: str, force: bool) -> None:
    """Check, before any work, that a manifest may be written there.

    Raises:
        UsageError: another suffix than .csv or .parquet, or it exists already and `force` is not given.
    """
    if not url.endswith(SUFFIXES):
        raise UsageError(f"{url}: a manifest is a {' or '.join(SUFFIXES)} file")
    if not is_url(url):
        check_file(Path(url), force)
        return
    try:
        fs, path = url_to_fs(url)
        there = fs.exists(path)
    except (OSError, ValueError, ImportError) as error:
        raise UsageError(f"{url} cannot be looked for: {error}; name another place") from None
    if there and not force:
        raise UsageError(f"{url} exists already; choose another name, or add --force")


def write_manifest(url: str, recordings: Sequence[Recording]) -> None:
    """Write a .csv or .parquet file; an earlier one is replaced.

    Raises:
        SagsError: it cannot be written.
    """
    data = _as_parquet(recordings) if url.endswith(PARQUET) else as_csv(recordings)
    try:
        fs, path = url_to_fs(url)
        fs.makedirs(fs._parent(path), exist_ok=True)
        if is_url(url):
            fs.pipe_file(path, data)  # an object appears when all of it is there
        else:
            with whole(Path(path)) as partial:
                partial.write_bytes(data)
    except (OSError, ValueError, ImportError) as error:
        raise SagsError(f"cannot write {url}: {error}; name another place") from None


def as_csv(recordings: Sequence[Recording]) -> bytes:
    """Return the content of a .csv file."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(map(_row, recordings))
    return text.getvalue().encode()


def _row(recording: Recording) -> dict[str, Any]:
    return {
        "recording": recording.name,
        "rig": recording.rig_name or "",
        "overrides": shlex.join(recording.overrides),
        "weight": recording.weight,
        "segment": recording.segment,
    }


def _as_parquet(recordings: Sequence[Recording]) -> bytes:
    pq = parquet()
    import pyarrow as pa

    rows = [_row(recording) for recording in recordings]
    file = io.BytesIO()
    columns = {name: [row[name] for row in rows] for name in COLUMNS}
    pq.write_table(pa.table(columns), file)
    return file.getvalue()


def parquet() -> Any:
    """Import and return `pyarrow.parquet`.

    Raises:
        UsageError: it is not installed.
    """
    try:
        import pyarrow.parquet as pq
    except ImportError:
        raise UsageError(f"Parquet files need pyarrow, which is not installed: {install('lab')}") from None
    return pq
