"""The node live on hosts that have less to give: one core, or neighbours that want the same cores.

Every host is this machine. The node runs in a process of its own, on the recording's clock, sockets
included, and is measured at the full working size whatever its rung. Who reads stands for another machine and
takes only what the node leaves of the cores.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from benchmarks.kernels.contention import burning_core
from benchmarks.node.neighbours import NS, STARTING, STOPPING, find_browser, overlay, reader, viewer
from benchmarks.pareto.full_size import online_at
from sags_node.errors import SagsError
from sags_node.evaluation.measure import MeasureOptions
from sags_node.evaluation.session import measure, run_realtime
from sags_node.evaluation.spool import Spool
from sags_node.pipeline.session import at_best_scale, open_session
from sags_node.pipeline.warm_up import warm_up

MEASURING = 600.0  # s to measure a run beyond its length

Row = dict[str, Any]
Beside = Callable[[Path], AbstractContextManager[Any]]  # a neighbour of the node in that run directory


def measure_hosts(
    launch: str | None, overrides: Sequence[str], seconds: float, progress: Callable[[str], None]
) -> list[Row]:
    """One row for each host, keys as benchmarks/README.md lists them.

    Args:
        seconds: that the recording lasts.

    Raises:
        SagsError: a node or a neighbour does not run.
    """
    rows = []
    for name, beside in neighbours().items():
        progress(f"live: {name}")
        with tempfile.TemporaryDirectory(prefix="sags-hosts-") as folder, ExitStack() as stack:
            run_dir = Path(folder) / "sags"  # where a process with this XDG_RUNTIME_DIR looks for it
            run_dir.mkdir(mode=0o700)
            if beside is not None:
                stack.enter_context(beside(run_dir))
            cores = 1 if name == "one core" else None
            rows.append(
                {"name": name, "part": "hosts", **_played(launch, overrides, run_dir, cores, seconds)}
            )
    return rows


def neighbours() -> dict[str, Beside | None]:
    """By the host's name. Without a browser a viewer takes nothing, so that host is left out."""
    hosts: dict[str, Beside | None] = {
        "alone": None,
        "one core": None,
        "beside a busy process": lambda run_dir: burning_core(),
        "with the overlay": overlay,
        "with a reader of everything": reader,
    }
    if find_browser() is not None:
        hosts["with the viewer"] = viewer
    return hosts


def _played(
    launch: str | None, overrides: Sequence[str], run_dir: Path, cores: int | None, seconds: float
) -> Row:
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    arguments = (launch, list(overrides), str(run_dir), there)
    process = spawn.Process(target=_play, args=arguments, daemon=True)
    mine = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(mine)[:cores])  # the process inherits it before it counts its cores
    try:
        process.start()
    finally:
        os.sched_setaffinity(0, mine)
    there.close()
    try:
        if not here.poll(STARTING + seconds + MEASURING):
            raise SagsError("a run did not end in time")
        row: Row | str = here.recv()
    except EOFError:
        raise SagsError("the process of a run died") from None
    finally:
        process.terminate()
        process.join(STOPPING)
        process.kill()
    if isinstance(row, str):
        raise SagsError(row)
    return row


def _play(launch: str | None, overrides: list[str], run_dir: str, there: Connection) -> None:
    """The process of a run: sends its row, or what went wrong."""
    try:
        there.send(_live(launch, overrides, run_dir))
    except SagsError as error:
        there.send(str(error))


def _live(launch: str | None, overrides: list[str], run_dir: str) -> Row:
    sockets = [
        "publish.data:=[tcp://127.0.0.1:*]",
        "publish.control:=tcp://127.0.0.1:*",
        f"publish.run_dir:={run_dir}",
    ]
    live = ["source.loop:=false", "source.pace:=realtime", "mapping.iterations:=null", f"ns:={NS}"]
    session = open_session(launch, [*overrides, *sockets, *live])
    warm_up(session.config)
    full = session.config.vision.model_copy(update={"scale": 1.0})
    session = at_best_scale(session)
    options = MeasureOptions(hold_out=0)
    with Spool() as spool:
        run_realtime(session, session.config.publish, options, spool, lambda what, frames: None)
        outcome = measure(session, spool, options)
        online = online_at(
            full.working_size(session.rig.left.width, session.rig.left.height),
            session,
            spool,
            options,
            lambda what, frames: None,
        )
    after = outcome.rows[round(session.source.rate) :]
    summary = outcome.summary
    kept = ("first_render_ms", "frame_ms", "latency_ms", "online", "gaussians", "rungs")
    return {
        "share_after_first_second": sum(row.facts is not None for row in after) / max(1, len(after)),
        **{key: summary[key] for key in kept},
        "size": list(session.working_size),
        "online_at_full_size": online,
    }
