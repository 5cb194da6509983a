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
    """Return when images were taken, ns: their header stamps, or their log times if most header stamps
    repeat: then the driver did not stamp each image."""
    both: I64 = np.array(keys, np.int64)
    came, stamps = both[:, 0], both[:, 1]
    distinct = len(np.unique(stamps))
    return stamps if distinct > REPEATED * len(stamps) or distinct == len(np.unique(came)) else came


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
        stamped = [stamp for _, stamp in pictures]
        if not np.array_equal(taken(pictures), stamped):
            count = len(set(stamped))
            what = f"{len(pictures)} {eye} images have {count} stamps: when they were recorded counts instead"
            found.append(Finding("warning", what, "let the driver stamp each image when it is taken"))
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
