"""The state of an archive: how far it is, what failed, and all figures in one table."""

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from sags_lab.archive.inputs import settings_of
from sags_lab.archive.manifest import Recording, parquet, read_manifest
from sags_lab.archive.store import ABOUT, DONE, FAILED, MANIFEST, RESULTS, Store
from sags_node.errors import UsageError

BATCH = 2000  # rows that are read together, and are in memory as Python objects


def listed(store: Store) -> tuple[dict[str, Any], list[Recording]]:
    """Return the settings of the newest run, and its recordings.

    Raises:
        UsageError: there was no run.
    """
    about = store.read_json(ABOUT)
    if about is None:
        raise UsageError(f"{store.url} holds no archive; sags archive run makes one")
    rows = read_manifest(f"{store.url.rstrip('/')}/{MANIFEST}")
    return about, [replace(row, folder=about["folder"]) for row in rows]


def status(store: Store) -> dict[str, Any]:
    """Return counts, and a row for each recording that failed.

    Raises:
        UsageError: there was no run.
    """
    about, recordings = listed(store)
    done = store.done(settings(store))
    failures = [record for record in failed(store) if record["id"] not in done or record["quarantined"]]
    ids = {recording.id for recording in recordings}
    quarantined = [record for record in failures if record["quarantined"] and record["id"] in ids]
    finished = len(ids & done.keys())
    return {
        "job": about["job"],
        "version": about["version"],
        "recordings": len(ids),
        "done": finished,
        "quarantined": len(quarantined),
        "missing": len(ids) - len((ids & done.keys()) | {record["id"] for record in quarantined}),
        "failed": [
            {
                "id": record["id"],
                "attempts": len(record["attempts"]),
                "quarantined": record["quarantined"],
                "reason": record["attempts"][-1]["reason"],
            }
            for record in failures
        ],
    }


def settings(store: Store) -> str:
    """Return the hash of the newest run's settings with which valid keys begin; "" where there was no run."""
    about = store.read_json(ABOUT)
    return "" if about is None else settings_of(about)


def failed(store: Store) -> list[dict[str, Any]]:
    """Return the records of recordings whose last attempt, with the newest run's settings, failed."""
    own = settings(store)
    names = [f"{FAILED}/{name}" for name in store.names(FAILED) if name.endswith(".json")]
    records = store.read_all_json(names)
    return [record for record in records if record is not None and record["key"].startswith(own)]


def of_one(store: Store, id: str) -> dict[str, Any]:
    """Return what is known of one recording: its figures, or its failed attempts, and the log.

    Args:
        id: of the recording, or the beginning of it.

    Raises:
        UsageError: no recording, or several, are named so.
    """
    _, recordings = listed(store)
    ids = [recording.id for recording in recordings if recording.id.startswith(id)]
    if id in ids:
        ids = [id]
    if len(ids) != 1:
        there = ", ".join(ids[:5]) or "none"
        raise UsageError(f"{id}: one recording must be named so, there are: {there}; see results.parquet")
    own = settings(store)
    record, key = store.read_json(f"{FAILED}/{ids[0]}.json"), store.done(own).get(ids[0])
    if record is not None and not record["key"].startswith(own):
        record = None
    row = None if key is None else store.read_json(f"{DONE}/{ids[0]}.{key}.json")
    log = store.read(f"{FAILED}/{ids[0]}.log") or store.read(f"recordings/{ids[0]}/log.txt") or b""
    return {
        "id": ids[0],
        "state": _state(row, record),
        "figures": row,
        "failed": record,
        "log": log.decode("utf-8", errors="replace"),
    }


def _state(row: Mapping[str, Any] | None, record: Mapping[str, Any] | None) -> str:
    if record is not None and record["quarantined"]:
        return "quarantined"
    return "missing" if row is None else "done"


def write_results(store: Store, recordings: Sequence[Recording]) -> int:
    """Write `results.parquet`: a row for each recording, by id; columns are the figures that any of them has.

    Returns:
        How many rows have figures.

    Raises:
        OSError: it cannot be written.
    """
    pq = parquet()
    import pyarrow as pa

    records = {record["id"]: record for record in failed(store)}
    tables, count = [], 0
    for rows in _batches(store, recordings, records):
        count += sum(row["state"] == "done" for row in rows)
        columns = dict.fromkeys(key for row in rows for key in row)
        tables.append(pa.table({key: _column(pa, [row.get(key) for row in rows]) for key in columns}))
    kinds: dict[str, set[str]] = {}
    for field in (field for table in tables for field in table.schema):
        kinds.setdefault(field.name, {"null"}).add(str(field.type))
    mixed = {name for name, those in kinds.items() if len(those) > 2 and those != {"null", "int64", "double"}}
    for number, table in enumerate(tables):  # types that differ between batches become text, as within one
        texts = [field.with_type(pa.string()) if field.name in mixed else field for field in table.schema]
        tables[number] = table.cast(pa.schema(texts))
    file = io.BytesIO()
    pq.write_table(pa.concat_tables(tables, promote_options="permissive"), file)
    store.write(RESULTS, file.getvalue())
    return count


def read_results(store: Store) -> list[dict[str, Any]]:
    """Read the rows of `results.parquet`; none where there is no table."""
    pq = parquet()
    import pyarrow as pa

    data = store.read(RESULTS)
    rows: list[dict[str, Any]] = [] if data is None else pq.read_table(pa.BufferReader(data)).to_pylist()
    return rows


def _batches(
    store: Store, recordings: Sequence[Recording], records: Mapping[str, Mapping[str, Any]]
) -> Iterator[list[dict[str, Any]]]:
    """The rows of all recordings, sorted by id, `BATCH` at a time."""
    done = store.done(settings(store))
    ordered = sorted(recordings, key=lambda each: each.id)
    for begin in range(0, len(ordered), BATCH):
        batch = ordered[begin : begin + BATCH]
        ids = [recording.id for recording in batch if recording.id in done]
        figures = dict(
            zip(ids, store.read_all_json([f"{DONE}/{id}.{done[id]}.json" for id in ids]), strict=True)
        )
        yield [_row(each, figures.get(each.id), records.get(each.id)) for each in batch]


def _row(
    recording: Recording, figures: Mapping[str, Any] | None, record: Mapping[str, Any] | None
) -> dict[str, Any]:
    known = {
        "id": recording.id,
        "recording": recording.name,
        "segment": recording.segment,
        "state": _state(figures, record),
    }
    reason = None if record is None else record["attempts"][-1]["reason"]
    return {**known, "reason": reason, **(figures or {})}


def _column(pa: Any, values: list[Any]) -> Any:
    """A column of a table: int and float together become float, other mixed types text."""
    kinds = {type(value) for value in values if value is not None}
    if kinds == {int, float}:
        return pa.array(values, pa.float64())
    if len(kinds) > 1:
        return pa.array([None if value is None else str(value) for value in values])
    return pa.array(values)
