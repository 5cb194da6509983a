"""Compare the figures of a run with committed ones, field by field."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

# These differ from machine to machine and from run to run.
TIMING_KEYS = frozenset(
    "rate_hz first_render_ms latency_ms frame_ms cpu_ms stage_ms rss_mb machine threads".split()
)


class Tolerance(BaseModel):
    """How far a number may be from its golden value: by the larger of the two."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    absolute: float = Field(0.0, ge=0)
    relative: float = Field(0.0, ge=0)

    def allows(self, value: Any, golden: Any) -> bool:
        if any(isinstance(each, bool) or not isinstance(each, int | float) for each in (value, golden)):
            return bool(value == golden)
        return bool(abs(value - golden) <= max(self.absolute, self.relative * abs(golden)))


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
    return Golden.model_validate_json(file.read_text(encoding="utf-8"))


def write_golden(file: Path, golden: Golden, summary: Mapping[str, Any]) -> None:
    """Commit the figures of a run under the tolerances and the command of `golden`; timings are left out."""
    figures = {key: value for key, value in summary.items() if key not in TIMING_KEYS}
    text = json.dumps(golden.model_copy(update={"figures": figures}).model_dump(), indent=2, allow_nan=False)
    file.write_text(text + "\n", encoding="utf-8")


def compare(summary: Mapping[str, Any], golden: Golden) -> list[str]:
    """One readable line for each figure that moved too far, is missing, or is new; empty when all is well.

    The last line then names the command that makes new golden figures.
    """
    now, then = _fields(summary), _fields(golden.figures)
    differences = []
    for key in sorted(now.keys() | then.keys()):
        allowed = golden.tolerance(key)
        if key not in now:
            differences.append(f"{key}: missing, golden {then[key]!r}")
        elif key not in then:
            differences.append(f"{key}: {now[key]!r} is new, the golden file has no such figure")
        elif not allowed.allows(now[key], then[key]):
            bound = f"allowed {allowed.absolute:g} or {allowed.relative:.1%}"
            differences.append(f"{key}: {now[key]!r}, golden {then[key]!r}, {bound}")
    if differences:
        differences.append(f"if this is meant, update the golden file: {golden.command}")
    return differences


def _fields(figures: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The leaves of nested maps under their dotted keys, without timings."""
    found: dict[str, Any] = {}
    for key, value in figures.items():
        if key not in TIMING_KEYS:
            nested = isinstance(value, Mapping) and value
            found |= _fields(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return found
