"""What the overlay remembers of its own speed."""

from __future__ import annotations

from sags_node.overlay.durations import REMEMBERED, Durations


def test_the_newest_are_kept_in_their_order() -> None:
    durations = Durations()
    assert durations.percentiles() == {"p50": None, "p90": None, "p99": None}
    for ms in range(REMEMBERED + 10):
        durations.add(float(ms))
    assert durations.last(3).tolist() == [REMEMBERED + 7, REMEMBERED + 8, REMEMBERED + 9]
    assert durations.last()[0] == 10 and len(durations.last()) == REMEMBERED
    last = REMEMBERED + 9
    assert durations.percentiles(101) == {"p50": last - 50, "p90": last - 10, "p99": last - 1}
