"""Units of length in which calibrations are kept."""

import shlex
from pathlib import Path

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "inch": 0.0254, "um": 1e-6}  # metres
NAMES = {"m": "metres", "mm": "millimetres", "cm": "centimetres", "inch": "inches", "um": "micrometres"}


def fitting_units(length: float, least: float, most: float, read_in: str = "m") -> list[str]:
    """Return the units, without `read_in`, in which a length lies from `least` to `most`, m."""
    counts = length / UNITS[read_in]
    return [unit for unit, metres in UNITS.items() if unit != read_in and least <= counts * metres <= most]


def in_metres(units: list[str], path: Path | str, read_in: str = "m") -> str:
    """Return how to fix a calibration at `path` whose lengths are in one of `units`, but were read as
    `read_in`."""
    convert = f"sags calib convert {shlex.quote(str(path))} -o FOLDER --unit"
    if read_in != "m":
        ways = " or ".join(f"{convert} {unit}" for unit in units)
        return f"its files do not say their unit, and {NAMES[read_in]} are usual: {ways}"
    each = [f"of {NAMES[unit]} divide it by {1 / UNITS[unit]:.5g}, or {convert} {unit}" for unit in units]
    return f"projection_matrix[3] in right.yaml (or T) is in metres: {'; '.join(each)}"
