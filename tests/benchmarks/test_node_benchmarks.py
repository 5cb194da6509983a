"""`python -m benchmarks crowd`, `bridges`, `hosts` and `soak` on small nodes: real processes and sockets."""

import os
from pathlib import Path

import pytest

from benchmarks.node import hosts, neighbours
from sags_node.errors import SagsError

pytestmark = [pytest.mark.live, pytest.mark.alone]


@pytest.mark.parametrize(
    ("command", "beside"), [("overlay", neighbours.overlay), ("view", neighbours.viewer)]
)
def test_a_neighbour_that_ends_is_not_measured(command: str, beside: hosts.Beside, tmp_path: Path) -> None:
    """It would cost nothing, and the figures would say so."""
    if command == "view" and neighbours.find_browser() is None:
        pytest.skip("needs Chromium")
    run_dir = tmp_path / "sags"
    run_dir.mkdir(mode=0o700)
    with pytest.raises(SagsError, match=f"sags {command} ended before its time"), beside(run_dir) as process:
        os.kill(process, 9)
        os.waitid(os.P_PID, process, os.WEXITED | os.WNOWAIT)
