"""`benchmarks crowd` on a small node: real processes and sockets."""

import pytest

from benchmarks.node import crowd
from sags_node.errors import SagsError

pytestmark = [pytest.mark.live, pytest.mark.alone]

SMALL = ("replay/phantom_pull", "source.pace:=realtime", "mapping.max_gaussians:=2000")


def test_everybody_hears_the_node_and_it_does_not_wait_for_any(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crowd, "WARM_UP", 2.0)
    measured = crowd.measure_crowd(SMALL, 5.0, 7.0, 3, lambda done, of, what: None)
    alone, read, crowded, _ = measured["phases"]
    assert [each["phase"] for each in measured["phases"]] == ["alone", "one reader", "crowd", "alone again"]
    assert read["peers"]["reader"]["messages"] > 3 * 6
    assert set(crowded["peers"]) == {"fast", "slow", "dead", "3 more"} and not alone["peers"]
    fast, slow = crowded["peers"]["fast"], crowded["peers"]["slow"]
    assert slow["rate_hz"] < 1 / crowd.SLOW < fast["rate_hz"]
    # The slow one takes what is new, not what has queued up behind it.
    assert slow["since_sent_ms"]["p50"] < 1e3 * crowd.SLOW
    assert crowded["peers"]["3 more"]["messages"] > 3 * 6
    assert crowded["rate_hz"]["p50"] > 0.5 * alone["rate_hz"]["p50"]
    assert crowd.table(measured).row_count == 4


def test_a_node_that_does_not_start_says_why() -> None:
    with pytest.raises(SagsError, match=r"did not start.*no_such_key"):
        crowd.measure_crowd(("no_such_key:=1",), 1.0, 1.0, 0, lambda done, of, what: None)
