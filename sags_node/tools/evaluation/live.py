"""A live run, seen from outside: the node in a process of its own, as users run it, and a reader of its
sockets that only copies.

What the node alone knows of a frame, such as its Gaussians, is measured frame by frame (`steps.run_step`).
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

from sags_node.errors import SagsError
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.rundir import connection_path
from sags_node.messaging.stream import listen_to
from sags_node.processes import end
from sags_node.tools.evaluation.measure import Progress
from sags_node.tools.evaluation.run import TOPICS, Run

WAITING = 256  # messages that may wait for the reader; what is lost beyond that counts as lost by the node
STARTING = 120.0  # s until the node listens; kernels were compiled before
ENDING = 15.0  # s until it has ended after its last frame


def play(
    arguments: Sequence[str],
    node: NodeAddress,
    run: Run,
    progress: Progress,
    topics: Sequence[str] = TOPICS,
    cores: int | None = None,
) -> dict[str, Any]:
    """Run a node until its recording has ended, and copy what it publishes.

    Args:
        arguments: of `sags run`.
        node: where it listens, by its run directory.
        progress: called with the frames that were shown so far.
        topics: that are read.
        cores: that it may use; None: all.

    Returns:
        The node's own account: `NodeHealth`.

    Raises:
        SagsError: it does not start, or it fails.
    """
    command = [sys.executable, "-m", "sags_node", "run", *arguments, "--json"]
    mine = os.sched_getaffinity(0)
    with (run.folder / "problems").open("w+") as problems:
        os.sched_setaffinity(0, sorted(mine)[:cores])  # the process inherits it before it counts its cores
        try:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=problems)
        finally:
            os.sched_setaffinity(0, mine)
        try:
            _copy(process, node, run, progress, topics)
            said, _ = process.communicate(timeout=ENDING)
        except subprocess.TimeoutExpired:
            raise SagsError("the node did not end after its last frame; try sags run alone") from None
        finally:
            if process.poll() is None:
                end(process, ENDING)
        problems.seek(0)
        if process.returncode != 0:
            raise SagsError(f"the node failed: {problems.read().rpartition('error:')[2].strip()}")
    account: dict[str, Any] = json.loads(said)
    return account


def _copy(
    process: subprocess.Popen[bytes], node: NodeAddress, run: Run, progress: Progress,
    topics: Sequence[str],
) -> None:  # fmt: skip
    """Copy all that the node publishes until it ends."""
    assert node.run_dir is not None
    listening, deadline = connection_path(node.run_dir, node.ns), time.monotonic() + STARTING
    while not listening.exists() and process.poll() is None:
        if time.monotonic() > deadline:
            raise SagsError(f"the node did not listen within {STARTING:.0f} s; try sags run alone")
        time.sleep(0.005)  # the first frame comes soon
    if process.poll() is not None:
        return
    for received in listen_to(node, topics, None, WAITING):
        if received is not None:
            run.copy(received[0])
            progress("playing", len(run))
        elif process.poll() is not None:
            return
