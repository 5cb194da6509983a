"""Pairs the messages of a bag's two eyes by their stamps, and checks whether the stamps can be trusted."""

from collections.abc import Sequence

import numpy as np

from sags_node.checks import Finding
from sags_node.config.schema import BagSource
from sags_node.errors import UsageError
from sags_node.sources.pairing import nearest, pair
from sags_node.types import I64

Key = tuple[int, int]  # log time and header stamp of a message, ns: identify it within its topic

REPEATED = 0.3  # share of distinct stamps; less is not trusted (messages recorded three times leave 1/3)
REORDERED = 2  # images in a row that are older than one recorded before: a network exchanges single ones
WALL = 10**18  # ns since 1970 (2001): clocks below are a simulator's or a camera's, and may begin at 0
LONGEST_PAUSE = 600.0  # s, as of a video
FEW_PAIRS = 0.9  # share of the left images; fewer pairs are worth a warning
SYNCHRONISED_MS = 5.0  # ms between the eyes of a pair: the tolerance of live pairs, too
LATE_STEPS = 1.5  # periods: the delays of both eyes to the recorder do not differ by more
LONG = 3.0  # times the usual step between images: longer ones are gaps
OFTEN = 0.1  # share of all steps: more gaps than that are no pauses
DIFFER_FIX = (
    "set source.clocks:=two, which sets one by the other by when images were recorded; better, set both "
    "machines' clocks (chrony, PTP) before recording"
)


def pair_messages(
    config: BagSource, left: Sequence[Key], right: Sequence[Key]
) -> tuple[list[tuple[Key, Key]], I64]:
    """Pair the messages; return the keys of each pair, and their stamps [N, 2] ns on one clock.

    Raises:
        UsageError: there is no pair.
    """
    stamps, others = map(taken, (left, right))
    ahead = came_later(right) - came_later(left)  # by which the left clock is ahead of the right one, ns
    if config.clocks == "two":
        others = others + ahead
    pairs = pair(stamps, others, config.tolerance)
    if not len(pairs):
        count = f"{config.path}: left {len(left)} images, right {len(right)} images, pairs 0"
        if config.clocks == "one" and len(pair(stamps, others + ahead, config.tolerance)):
            raise UsageError(f"{count}: the eyes' clocks differ by {abs(ahead) * 1e-9:.3g} s; {DIFFER_FIX}")
        skew = float(np.median(np.abs(stamps - others[nearest(stamps, others)]))) * 1e-6
        raise UsageError(
            f"{count}: the median skew is {skew:.3g} ms, source.tolerance {config.tolerance * 1e3:g} ms; if "
            f"that is right, set source.tolerance:={skew * 1.5e-3:.3g}"
        )
    keys = [(left[i], right[j]) for i, j in pairs]
    return keys, np.stack([stamps[pairs[:, 0]], others[pairs[:, 1]]], axis=1)


def taken(keys: Sequence[Key]) -> I64:
    """Return when images were taken, ns: their header stamps, or their log times where `_distrusted`."""
    came, stamps = _said(keys)
    return came if _distrusted(keys) else stamps


def _said(keys: Sequence[Key]) -> tuple[I64, I64]:
    """Log times and header stamps, ns; the log time where the driver left the stamp zero."""
    came, stamps = np.array(keys, np.int64).T
    zero = stamps == 0
    none = zero & (stamps.max() > WALL or np.count_nonzero(zero) > 1)
    return came, np.where(none, came, stamps)


def _distrusted(keys: Sequence[Key]) -> str:
    """Return what is wrong with most header stamps, so that the driver cannot have stamped each image when
    it was taken: they repeat, or go back; "": nothing."""
    came, stamps = _said(sorted(keys))
    distinct = len(np.unique(stamps))
    if distinct <= REPEATED * len(stamps) and distinct < len(np.unique(came)):
        return f"{len(stamps)} {{}} images have {distinct} stamps"
    older = stamps < np.maximum.accumulate(stamps)
    if np.convolve(older, np.ones(REORDERED), "valid").max(initial=0) < REORDERED:
        return ""
    back = float((np.maximum.accumulate(stamps) - stamps)[older].max()) * 1e-9
    return f"the stamps of {{}} images go back by up to {back:.3g} s: a clock was set, or a bag played again"


def came_later(keys: Sequence[Key]) -> int:
    """Return the median delay from capture to recording, ns."""
    return int(np.median([log_ns for log_ns, _ in keys] - taken(keys)))


def judge_stamps(
    keys: Sequence[tuple[Key, Key]],
    stamps: I64,
    rate: float | None,
    eyes: tuple[Sequence[Key], Sequence[Key]],
) -> tuple[Finding, ...]:
    """Return warnings about the pairs of both `eyes`' images: too few, or not of one clock or one moment;
    repeated or uneven stamps."""
    found = []
    for eye, pictures in zip(("left", "right"), eyes, strict=True):
        if wrong := _distrusted(pictures):
            what = f"{wrong.format(eye)}: when they were recorded counts instead"
            found.append(Finding("warning", what, "let the driver stamp each image when it is taken"))
        if (np.diff([log_ns for log_ns, _ in pictures]) < 0).any():
            what = f"{eye} images are not in the order of the times at which they were recorded, which counts"
            fix = "was the clock set back, or were recordings joined? Then play each part alone"
            found.append(Finding("warning", what, fix))
    came = np.array([[each[0] for each in pair] for pair in keys], np.int64)
    later = float(np.median((came - stamps) @ [-1, 1])) * 1e-6
    if rate is not None and abs(later) > LATE_STEPS * 1e3 / rate:
        eye, other = ("right", "left") if later > 0 else ("left", "right")
        what = (
            f"{eye} images were recorded {abs(later):.0f} ms later than the {other} ones of the same "
            "stamps: if they did not come so late, the eyes' clocks differ, and pairs are of other moments"
        )
        found.append(Finding("warning", what, DIFFER_FIX, {"clocks_differ_ms": round(later, 1)}))
    else:
        found += judge_skew(stamps)
    steps = np.diff(stamps[:, 0]) * 1e-6
    usual = float(np.median(steps)) if len(steps) else 0.0
    if np.count_nonzero(steps > LONG * usual) > OFTEN * len(steps):
        what = (
            f"stamps come in bursts, or images are missing: mostly {usual:.3g} ms from one to the next, "
            f"{float(steps.mean()):.3g} ms on the average"
        )
        fix = "let the driver stamp each image when it is taken, and record without losses"
        found.append(Finding("warning", what, fix))
    if steps.max(initial=0) > LONGEST_PAUSE * 1e3:
        what = f"stamps jump by {steps.max() * 1e-3:.0f} s after pair {int(np.argmax(steps))}"
        found.append(
            Finding("warning", what, "was the clock set? source.rate plays evenly, without the pause")
        )
    counts = [len(set(pictures)) for pictures in eyes]
    if len(keys) < FEW_PAIRS * counts[0]:
        what = f"{len(keys)} pairs of {counts[0]} left and {counts[1]} right images"
        found.append(Finding("warning", what, "what has no partner in time is left out"))
    return tuple(found)


def judge_skew(stamps: I64) -> tuple[Finding, ...]:
    """Return a warning if the stamps [N, 2] (ns) of pairs differ too much: the eyes are not synchronised."""
    skew = float(np.median(stamps @ [-1, 1])) * 1e-6
    if abs(skew) <= SYNCHRONISED_MS:
        return ()
    what = (
        f"right images were taken {abs(skew):.1f} ms {'after' if skew > 0 else 'before'} the left ones "
        "(median): the cameras are not synchronised"
    )
    fix = "depth is wrong where tissue moves: trigger both cameras together, or use genlock"
    return (Finding("warning", what, fix, {"skew_ms": round(skew, 2)}),)
