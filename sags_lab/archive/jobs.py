"""The jobs: each is a `sags` command for one recording. It fills a folder and prints figures as JSON."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sags_node.tools.evaluation.figures import flat

FIGURES, LOG = "figures.json", "log.txt"  # of a recording's folder: stdout and stderr of the command

Arguments = Callable[[list[str], Path], list[str]]

JOBS: dict[str, Arguments] = {
    "eval": lambda said, out: ["eval", *said, "--pace", "step", "--report", str(out / "report"), "--json"],
    "depth": lambda said, out: ["export", *said, "--depth", str(out / "depth"), "--json"],
    "tracks": lambda said, out: ["export", *said, "--tracks", str(out / "tracks.npz"), "--json"],
    "render": lambda said, out: ["export", *said, "--render", str(out / "model.mp4"), "--json"],
    "lerobot": lambda said, out: ["export", *said, "--lerobot", str(out / "lerobot"), "--json"],
    "record": lambda said, out: [
        *("bag", "record", *said),
        *("-o", str(out / "bag"), "--compression", "jpeg", "--json"),
    ],
    "fit": lambda said, out: ["fit", *said, "--out", str(out / "fit"), "--json"],
}
NEEDS_PLOTS = frozenset({"eval"})


def command(job: str, said: Sequence[str], options: Sequence[str], out: Path) -> list[str]:
    """Return the arguments after `sags`.

    Args:
        said: launch file or session, and overrides, as `launching.arguments`.
        options: further options of that command.
        out: the folder that it fills.
    """
    return [*JOBS[job](list(said), out), *options]


def row_of(figures: Any) -> dict[str, Any]:
    """Return the figures of a job in one row; names of nested ones are joined: `online.psnr`."""
    if isinstance(figures, list):  # of `sags export`: a row for each kind of file
        figures = {each["kind"]: {"holds": each["holds"], "bytes": each["bytes"]} for each in figures}
    return flat(figures)
