"""Units of length in which calibrations are kept."""

import shlex
from pathlib import Path

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "inch": 0.0254, "um": 1e-6}  # metres
NAMES = {"m": "metres", "mm": "millimetres", "cm": "centimetres", "inch": "inches", "um": "micrometres"}


def fitting_units(length: float, least: float, most: float, read_in: str = "m") -> list[str]:
    """The units but the one it was `read_in` in which a length lies between two others, m."""
    counts = length / UNITS[read_in]
    return [unit for unit, metres in UNITS.items() if unit != read_in and least <= counts * metres <= most]


def in_metres(units: list[str], path: Path | str, read_in: str = "m") -> str:
    """How to fix lengths of the calibration at `path` that are in one of these units, and were `read_in`
    another one."""
    convert = f"sags calib convert {shlex.quote(str(path))} -o FOLDER --unit"
    if read_in != "m":
        ways = " or ".join(f"{convert} {unit}" for unit in units)
        return f"its files do not say their unit, and {NAMES[read_in]} are usual: {ways}"
    each = [f"of {NAMES[unit]} divide it by {1 / UNITS[unit]:.5g}, or {convert} {unit}" for unit in units]
    return f"projection_matrix[3] in right.yaml (or T) is in metres: {'; '.join(each)}"
