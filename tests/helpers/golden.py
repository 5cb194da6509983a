"""Compare the figures of a run with committed ones, field by field."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sags_node.errors import UsageError

# These differ from machine to machine and from run to run.
TIMING_KEYS = frozenset(
    "rate_hz first_render_ms latency_ms frame_ms cpu_ms stage_ms rss_mb machine threads".split()
)


class Tolerance(BaseModel):
    """How far a number may be from its golden value: by the larger of the two."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    absolute: float = Field(0.0, ge=0)
    relative: float = Field(0.0, ge=0)

    def allows(self, value: float, golden: float) -> bool:
        return abs(value - golden) <= max(self.absolute, self.relative * abs(golden))


class Golden(BaseModel):
    """A committed result: the figures, how far each may move, and the command that makes them.

    A tolerance is looked up by the dotted key of a figure (`online.psnr`), then by the keys above it
    (`online`), then by `""`; without any, figures must be equal.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    command: str
    tolerances: dict[str, Tolerance] = {}
    figures: dict[str, Any]

    def tolerance(self, key: str) -> Tolerance:
        while key and key not in self.tolerances:
            key = key.rpartition(".")[0]
        return self.tolerances.get(key, Tolerance())


def read_golden(file: Path) -> Golden:
    """Read a golden file.

    Raises:
        UsageError: it is missing or not what `write_golden` writes.
    """
    try:
        return Golden.model_validate_json(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"cannot read golden file {file}: {error.strerror}; check the path") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "file"
        raise UsageError(f"{file} is not a golden file: {where}: {first['msg']}") from None


def write_golden(file: Path, golden: Golden, summary: Mapping[str, Any]) -> None:
    """Commit the figures of a run under the tolerances and the command of `golden`; timings are left out."""
    figures = {key: value for key, value in summary.items() if key not in TIMING_KEYS}
    text = json.dumps(golden.model_copy(update={"figures": figures}).model_dump(), indent=2, allow_nan=False)
    file.write_text(text + "\n", encoding="utf-8")


def compare(summary: Mapping[str, Any], golden: Golden) -> list[str]:
    """One readable line for each figure that moved too far, is missing, or is new; empty when all is well.

    The last line then names the command that makes new golden figures.
    """
    now, then = dict(_fields(summary)), dict(_fields(golden.figures))
    differences = []
    for key in sorted(now.keys() | then.keys()):
        if key not in now:
            differences.append(f"{key}: missing, golden {then[key]!r}")
        elif key not in then:
            differences.append(f"{key}: {now[key]!r} is new, the golden file has no such figure")
        elif not _same(now[key], then[key], golden.tolerance(key)):
            differences.append(f"{key}: {now[key]!r}, golden {then[key]!r}{_allowed(golden.tolerance(key))}")
    if differences:
        differences.append(f"if this is meant, update the golden file: {golden.command}")
    return differences


def _fields(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of nested maps under their dotted keys, without timings."""
    for key, value in tree.items():
        if key in TIMING_KEYS:
            continue
        if isinstance(value, Mapping) and value:
            yield from _fields(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _same(value: Any, golden: Any, tolerance: Tolerance) -> bool:
    if _is_number(value) and _is_number(golden):
        return tolerance.allows(value, golden)
    return bool(value == golden)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _allowed(tolerance: Tolerance) -> str:
    if tolerance == Tolerance():
        return ", must be equal"
    return f", allowed {tolerance.absolute:g} or {tolerance.relative:.1%}"
