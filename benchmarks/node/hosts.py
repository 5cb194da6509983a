"""Runs the node live on hosts with less to give: one core, or neighbours that want the same cores.

Every host is this machine. The node is run as users run it, on the recording's clock, and measured from
outside: what a subscriber gets, enlarged to the full working size. The subscriber stands for another machine
and takes only what the node leaves of the cores.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from benchmarks.kernels.contention import burning_core
from benchmarks.node.neighbours import NS, OWN_PORTS, find_browser, overlay, reader, updates_per_s, viewer
from benchmarks.node.processes import own_run_dir
from sags_node.messaging.address import NodeAddress
from sags_node.pipeline.session import open_session
from sags_node.pipeline.warm_up import warm_up
from sags_node.tools.evaluation import live
from sags_node.tools.evaluation.measure import MeasureOptions, Measurer
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.tools.evaluation.run import STATUS, TOPICS, Run
from sags_node.tools.evaluation.steps import again
from sags_node.tools.evaluation.summary import summarise
from sags_node.vision.rectify import Rectifier

Row = dict[str, Any]
Beside = Callable[[Path], AbstractContextManager[Any]]  # a neighbour of the node in that run directory


def measure_hosts(launch: str | None, overrides: Sequence[str], progress: Callable[[str], None]) -> list[Row]:
    """Measure one row for each host, keys as benchmarks/README.md lists them.

    Raises:
        SagsError: a node or a neighbour does not run.
    """
    rows = []
    for name, beside in neighbours().items():
        progress(f"live: {name}")
        with own_run_dir() as run_dir, nullcontext() if beside is None else beside(run_dir):
            cores = 1 if name == "one core" else None
            row = {"name": name, "part": "hosts", **_played(launch, overrides, run_dir, cores)}
            if beside is viewer:
                row["updates_per_s"] = updates_per_s(run_dir)
        if name == "alone":  # played again without a reader, to see what reading costs
            with own_run_dir() as run_dir:
                row["unread"] = _played(launch, overrides, run_dir, cores, read=False)
        rows.append(row)
    return rows


def neighbours() -> dict[str, Beside | None]:
    """Return the node's neighbour on each host, by name. Without a browser the viewer's host is left out."""
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
    launch: str | None, overrides: Sequence[str], run_dir: Path, cores: int | None, read: bool = True
) -> Row:
    """One run, seen from outside; images are compared at the full working size."""
    played = ["source.loop:=false", "source.pace:=realtime", "mapping.iterations:=null", f"ns:={NS}"]
    alone = "publish.detail:=false"  # the model is looked at, not the camera's images
    forced = [*OWN_PORTS, *played, alone, f"publish.run_dir:={run_dir}"]
    session = open_session(launch, [*overrides, *forced])
    warm_up(session.config)
    arguments = [*([] if launch is None else [launch]), *overrides, *forced]
    options, node = MeasureOptions(hold_out=0), NodeAddress(NS, run_dir=run_dir)
    with Run() as run:
        topics = TOPICS if read else [STATUS]
        account = live.play(arguments, node, run, lambda what, frames: None, topics, cores)
        own = {key: account[key] for key in ("frame_ms", "latency_ms", "gaussians", "dropped")}
        if not read:
            return own
        full = session.working_size
        receipt = Receipt(session.rig, full, None)
        judge = Measurer(run, Rectifier(session.rig, *full), session.config, options, receipt)
        with again(session) as frames:
            judge.run(frames, lambda what, frames: None)
        size = list(run.size())
    after = judge.rows[round(session.source.rate) :]
    summary = summarise(session.name, judge.rows, options, session.config.played_segments, None)
    kept = ("first_render_ms", "latency_ms", "gaussians", "rungs", "depth")
    return {
        "share_after_first_second": sum(row.facts is not None for row in after) / max(1, len(after)),
        **{key: summary[key] for key in kept},
        "frame_ms": own["frame_ms"],
        "dropped": own["dropped"],
        "size": size,
        "receipt": receipt.as_json(),
        "online_at_full_size": summary["online"],
    }
