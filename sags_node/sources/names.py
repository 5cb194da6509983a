"""Reads from images' names their order, their times, and which ones of several folders belong together."""

import logging
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from sags_node.errors import UsageError
from sags_node.types import I64

log = logging.getLogger(__name__)

EYE = re.compile(r"(?<![a-z])(left|right|l|r)(?![a-z])", re.IGNORECASE)
_LAST = re.compile(r"(\d+)(?:[.,](\d+))?(?=\D*$)")  # the last number of a name, and possibly its fraction
# Hours, minutes, seconds.
_CLOCK = re.compile(r"(?<!\d)([01]\d|2[0-3])([-_:h]?)([0-5]\d)[-_:m]?([0-5]\d)(?!\d)")
_HEXADECIMAL = re.compile("[0-9a-f]+", re.IGNORECASE)
HALF_DAY = 12 * 3600  # s
CLEARLY = 2.0  # ratio of unevenness from which on the more even order is certain
EPOCH = 10**9, 2 * 10**9  # s since 1970: 2001 to 2033; no date such as 20260101120000 falls between
GAP = 1.5  # times the usual step of the numbers: a larger step is a gap


def in_order(files: Sequence[Path]) -> list[Path]:
    """Sort files by name, with numbers compared as numbers.

    If the length of fractions varies, as in 0.067 and 0.1, they may be decimals or whole numbers (sec.nsec
    without leading zeros). Of the two orders, the one with more even steps is taken.

    Raises:
        UsageError: numbers are negative or hexadecimal, or two files have one.
    """
    if unclear := _unclear(files):
        raise UsageError(f"{files[0].parent}: {unclear}")
    longest = _longest(files)
    plain, times = (sorted(files, key=lambda file: (_natural(file.stem, pad), file)) for pad in (0, longest))
    if plain == times:
        return _over_midnight(plain)
    uneven = [_unevenness(order, longest, pad) for order, pad in ((plain, 0), (times, longest))]
    if max(uneven) <= CLEARLY * min(uneven):
        log.warning(
            "%s: names as %s may be whole numbers or fractions, and their order is a guess; write the same "
            "number of digits behind the point",
            *(plain[0].parent, max(files, key=lambda file: len(file.name)).name),
        )
    return _over_midnight(plain if uneven[0] <= uneven[1] else times)


def _unclear(files: Sequence[Path]) -> str:
    """Say why the order of names is not that of their numbers, with a remedy after a semicolon; "": it is."""
    named: dict[str, Path] = {}
    longest = _longest(files)
    for file in files:
        key = str([_natural(file.stem, pad) for pad in (0, longest)])
        if (other := named.setdefault(key, file)) is not file:
            return f"{other.name} and {file.name} have one name or number; leave one of them there"
    begins = {found.string[: found.start()] for file in files if (found := _LAST.search(file.stem))}
    if len({begin.removesuffix("-").removesuffix("+") for begin in begins}) < len(begins):
        return "numbers in names have signs; count from 0 up"
    stems = [file.stem for file in files]
    start, end = _common(stems), _common([stem[::-1] for stem in stems])
    rests = [stem[start : len(stem) - end] for stem in stems]
    if all(map(_HEXADECIMAL.fullmatch, rests)):
        values = [int(rest, 16) for rest in sorted(rests, key=lambda rest: _natural(rest, 0))]
        if values != sorted(values) and max(values) - min(values) < 2 * len(values):
            return f"names such as {max(files).name} seem to be hexadecimal; use decimal numbers"
    return ""


def _common(names: Sequence[str]) -> int:
    """The number of characters with which all names begin."""
    differ = (at for at, each in enumerate(zip(*names, strict=False)) if len(set(each)) > 1)
    return next(differ, min(map(len, names)))


def _over_midnight(files: list[Path]) -> list[Path]:
    """Files that are named by the time of day, with those after midnight last. Names with a date are not
    affected: it changes at midnight."""
    clocks = [found for file in files if (found := _CLOCK.search(file.stem)) is not None]
    if len(clocks) < max(len(files), 3) or len({found.string[: found.start()] for found in clocks}) > 1:
        return files
    seconds = [3600 * int(found[1]) + 60 * int(found[3]) + int(found[4]) for found in clocks]
    steps = np.diff(seconds)
    if steps.max() <= HALF_DAY:
        return files
    first = int(np.argmax(steps)) + 1
    log.warning(
        "%s: names are taken for times of day, with midnight after %s; are they none, count from 0 up",
        *(files[0].parent, files[-1].name),
    )
    return files[first:] + files[:first]


def numbers(files: Sequence[Path]) -> list[int]:
    """Return the last number in each name of sorted files, fractions in units of their last digit; empty if a
    name has none."""
    longest = _longest(files)
    times, plain = ([_number(file, longest, pad) for file in files] for pad in (longest, 0))
    found = [number for number in times if number is not None]
    if found != sorted(found):
        found = [number for number in plain if number is not None]
    return found if len(found) == len(files) else []


def times_in(files: Sequence[Path]) -> I64 | None:
    """Return the capture times that the names of sorted files tell, ns since 1970; None: they tell none."""
    counts, unit = numbers(files), 10 ** _longest(files)
    for each in (unit, unit * 10**3, unit * 10**6, unit * 10**9):  # per second: names are in s, ms, us or ns
        if counts and all(EPOCH[0] * each <= count < EPOCH[1] * each for count in counts):
            times = np.array([count * 10**9 // each for count in counts], np.int64)
            return times if (np.diff(times) > 0).all() else None
    return None


def gaps_in(files: Sequence[Path], are_times: bool) -> list[str]:
    """Return a warning if the numbers, or times, of sorted files have gaps; else an empty list."""
    steps = np.diff(np.array(numbers(files), np.float64))
    odd = np.flatnonzero(steps > GAP * np.median(steps)) if len(steps) else steps
    if not 0 < 3 * len(odd) <= len(steps):  # so many are no gaps: times of day step from 59 to 100
        return []
    where = f"{files[odd[0]].name} and {files[odd[0] + 1].name}"
    fix = "frames are played evenly: fill the gap or split the recording there"
    if are_times:
        fix = "they are played by these times: were images lost, or was the recording paused?"
    return [f"{files[0].parent}: {len(odd)} gaps in the numbers, first between {where}; {fix}"]


def together(folders: Sequence[Sequence[Path]]) -> list[tuple[Path, ...]]:
    """Match files of several folders by names that differ only in the eye and the suffix, in the order of the
    first folder; empty if most have no partner."""
    named = [{EYE.sub("*", file.stem): file for file in files} for files in folders]
    shared = set(named[0]).intersection(*named)
    twice = any(len(names) < len(files) for names, files in zip(named, folders, strict=True))
    if twice or 2 * len(shared) <= max(map(len, folders)):
        return []
    return [tuple(each[name] for each in named) for name in named[0] if name in shared]


def _longest(files: Sequence[Path]) -> int:
    """The number of digits of the longest fraction."""
    return max((len(found[2] or "") for file in files if (found := _LAST.search(file.stem))), default=0)


def _natural(name: str, pad: int) -> list[str | int]:
    """'a10b' -> ['a', 10, 'b']: text and numbers alternate, so any two names compare. The fraction of the
    last number is padded to `pad` digits."""
    found = _LAST.search(name)
    if pad and found is not None:
        name = f"{name[: found.end(1)]}.{(found[2] or '').ljust(pad, '0')}{name[found.end() :]}"
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def _number(file: Path, longest: int, pad: int) -> int | None:
    found = _LAST.search(file.stem)
    return found and int(found[1]) * 10**longest + int((found[2] or "").ljust(pad, "0") or 0)


def _unevenness(files: Sequence[Path], longest: int, pad: int) -> float:
    """The steps' standard deviation over their mean, for files whose names begin alike."""
    begins = [_LAST.split(file.stem)[0] for file in files]
    counts = [_number(file, longest, pad) or 0 for file in files]
    each = zip(pairwise(begins), pairwise(counts), strict=True)
    steps = [b - a for (one, other), (a, b) in each if one == other]
    return float(np.std(steps)) / max(float(np.mean(steps)), 1e-9) if steps else 0.0
