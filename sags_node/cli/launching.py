"""What commands that open a session or keep figures have in common."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sags_node.errors import SagsError, UsageError
from sags_node.files import check_file, whole
from sags_node.terminal import text
from sags_node.terminal.console import console, json_text, progress, show

if TYPE_CHECKING:
    from sags_node.config.schema import LaunchConfig, Source
    from sags_node.pipeline.session import Guess, Session


Command = Callable[..., Any]


class Number(click.FloatRange):
    """The value of an option, a number in a range; NaN is refused."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if math.isnan(number):
            self.fail(f"{value} is not in the range {self._describe_range()}.", param, ctx)
        return number


positive = Number(0, 1_000_000, min_open=True)
from_zero = Number(0, 1_000_000)

launch_argument = click.argument(
    "launch", nargs=-1, metavar="[FOLDER | VIDEO | LAUNCH.yaml] [key:=value ...]"
)
as_json = click.option("--json", "json_out", is_flag=True, help="Print JSON on stdout, for machines.")
all_figures = click.option("-v", "--verbose", is_flag=True, help="Print all figures, not the verdict alone.")
shown = partial(click.option, show_default=True)  # an option whose help tells its default
path_option = partial(click.option, type=click.Path(path_type=Path))
file_option = partial(click.option, type=click.Path(path_type=Path, dir_okay=False))
folder_option = partial(click.option, metavar="FOLDER", type=click.Path(path_type=Path, file_okay=False))
lpips_option = path_option("--lpips-weights", help="npz of LPIPS SqueezeNet weights.")
figures_option = file_option(
    *("-o", "--out"),
    metavar="FILE.json",
    help="Write the figures as JSON. Earlier ones are replaced, any other file that is there is not.",
)
force_option = click.option("--force", is_flag=True, help="Replace files that exist.")
STEPWISE = ("source.loop:=false", "source.pace:=step")  # every frame of a recording, in turn


def group_of(*options: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Make one decorator of several options; their help is in this order."""

    def decorate(command: Command) -> Command:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


def words_of(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """Return the path among the arguments, or None, and the overrides."""
    overrides = [argument for argument in arguments if ":=" in argument]
    paths = [argument for argument in arguments if ":=" not in argument]
    for path in paths:
        if "=" in path and not Path(path).exists():
            raise UsageError(f"'{path}' is not an override; write {path.replace('=', ':=', 1)}")
        if path == "-" or (path.endswith(".json") and len(paths) > 1):
            raise UsageError(f"'{path}' is no launch file: --json prints on stdout, --out FILE writes a file")
    if len(paths) > 1:
        raise UsageError(f"one launch file or folder, not {', '.join(paths)}; of videos: sags new LEFT RIGHT")
    return (paths[0] if paths else None), overrides


def split(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """Return the launch file, session or recording, or None, and the overrides. First are those that say how
    to play a video, or a folder without a launch file."""
    from sags_node.config.launch_file import is_launch, known_recording

    path, overrides = words_of(arguments)
    if path is None or is_launch(Path(path)) or known_recording(Path(path)) is not None:
        return path, overrides
    from sags_node.tools.importing.check import overrides_of

    return path, [*overrides_of(Path(path)), *overrides]


def launched(path: Path, overrides: Sequence[str]) -> LaunchConfig:
    """Load the configuration that `path` and the overrides say, see `split`."""
    from sags_node.config.launch_file import load_launch

    return load_launch(*split([str(path), *overrides]))


session_option = click.option("--session", metavar="RECORDING", help="The recording, named by an option.")


def played_instead(launch: Sequence[str], session: str | None) -> list[str] | None:
    """Return the arguments for `split` where a recording is named; None where none is, and the command asks
    a running node.

    Args:
        launch: arguments, the recording among them.
        session: the recording, where the option `--session` names it.
    """
    words = [*([] if session is None else [session]), *launch]
    return words if session is not None or any(":=" not in word for word in launch) else None


def split_recording(arguments: Sequence[str], no_cameras: str) -> tuple[str | None, list[str]]:
    """Do as `split`, and refuse live cameras; the message `no_cameras` says what to do instead.

    Raises:
        UsageError: the source is live cameras, or the launch is wrong.
    """
    from sags_node.config.launch_file import load_launch
    from sags_node.config.schema import LiveSource

    path, overrides = split(arguments)
    if isinstance(load_launch(path, overrides).source, LiveSource):
        raise UsageError(no_cameras)
    return path, overrides


def part_of(found: Any, name: str) -> Any:
    """Return the value under a dotted key, e.g. `a.b.0`.

    Raises:
        UsageError: there is none.
    """
    for word in name.split("."):
        keys = range(len(found)) if isinstance(found, list) else found if isinstance(found, dict) else ()
        known = {str(key): key for key in keys}
        if word not in known:
            there = f"; there are {', '.join(known)}" if known else ""
            raise UsageError(f"unknown key '{name}'{there}")
        found = found[known[word]]
    return found


def open_launched(path: str | None, overrides: Sequence[str], guess: Guess | None = None) -> Session:
    """Open a session and make its kernels ready; print what is played, at what size and on which device.

    Args:
        guess: makes a calibration where there is none, see `open_session`.
    """
    from sags_node.mapping.devices import device_of
    from sags_node.pipeline.session import at_best_scale, open_session
    from sags_node.pipeline.warm_up import warm_up

    with progress("rendering the phantom (once)") as advance:
        session = open_session(path, overrides, advance, guess)
    console.print(source_text(session.config.source), markup=False, soft_wrap=True)
    console.print(f"  {_pictures_text(session)}", markup=False, soft_wrap=True)
    with console.status("loading kernels (compiled once per machine, about half a minute)"):
        warm_up(session.config)
    session = at_best_scale(session)
    (width, height), worked = session.published_size, session.working_size
    device = device_of(session.config)
    console.print(
        f"refining on {device.name}{device.reason and f' ({device.reason})'}, images of {width}x{height} px"
        + ("" if worked == (width, height) else f", worked at {worked[0]}x{worked[1]} px"),
        soft_wrap=True,
    )
    return session


def source_text(source: Source) -> str:
    """Return what is played, in a line."""
    from sags_node.config.schema import PhantomSource

    if isinstance(source, PhantomSource):
        return "source: the built-in phantom"
    keys = ("left", "right", "launch", "video", "folder", "path", "endpoint")
    said = [getattr(source, key, None) for key in keys]
    return f"source: {source.kind} {', '.join(str(each) for each in said if isinstance(each, str | Path))}"


def _pictures_text(session: Session) -> str:
    """Size, rate and calibration of what is played."""
    from sags_node.rig import GUESSED_FOV
    from sags_node.sources.rectified import come_rectified
    from sags_node.sources.replay import Replay

    eye, source, config = session.rig.left, session.source, session.config
    count = source.frame_count
    length = "" if count is None else f", {count} frames, {count / source.rate:.1f} s"
    rig = f"calibration {config.rig}" if config.rig is not None else "calibration of the recording"
    if come_rectified(config):
        rig += ", the images are rectified already"
    if not session.rig.metric:
        rig = f"no calibration: {GUESSED_FOV:g} degrees across are guessed, depth has no unit (sags calib)"
    assumed = source.assumed if isinstance(source, Replay) else ""
    return f"{eye.width}x{eye.height} px at {source.rate:g} frames/s{assumed}{length}; {rig}"


def check_files(*files: Path | None, force: bool | None = None) -> None:
    """Check before a long run, with `check_file`, that the files that were asked for can be written."""
    for file in files:
        if file is not None:
            check_file(file, force)


def check_apart(written: Iterable[Path], read: Iterable[Path]) -> None:
    """Check that no file is both written and read: --force is for files that are in the way."""
    kept = {file.resolve() for file in read}
    for file in written:
        if file.resolve() in kept:
            raise UsageError(f"{file} is read by this command; choose another name for what it writes")


def show_outcome(summary: Mapping[str, Any], report: Path | None, verbose: bool, json_out: bool) -> None:
    """Print what a measured run was worth, where its report is, and if asked for all of its figures."""
    from sags_node.tools.evaluation.figures import flat, groups, headings, verdict
    from sags_node.tools.evaluation.provenance import provenance

    if json_out:
        show({"provenance": provenance()} | dict(summary))
        if report is not None:
            console.print(f"report: {report}", markup=False, soft_wrap=True)
        return
    show_verdict([*verdict(flat(summary)), *([] if report is None else [("report", str(report))])])
    for group, rows in groups(summary).items() if verbose else ():
        table = text.table(f"\n{group}", *(f"\n{name}" for name in headings(summary)), "\ncompared with")
        for what, values, compared in rows:
            table.add_row(what, *values, compared)
        show(table)


def show_verdict(lines: Sequence[tuple[str, str]]) -> None:
    """Print a verdict: what was measured and how good it is, a line each."""
    table = text.table()
    for what, said in lines:
        table.add_row(what, said)
    show(table)


def show_findings(rows: list[dict[str, Any]], json_out: bool, wrong: str) -> None:
    """Print findings, each with its fix.

    Raises:
        SagsError: a finding is an error; the message begins with `wrong`.
    """
    show(rows if json_out else text.findings_table(rows))
    if any(row["level"] == "error" for row in rows):
        raise SagsError(f"{wrong}; see the fixes above")


def show_rows(rows: list[dict[str, Any]], json_out: bool) -> None:
    """Print records that share their keys."""
    show(rows if json_out else text.rows_table(rows))


def write_json(file: Path | None, figures: Mapping[str, Any] | list[Any]) -> None:
    """Write figures, if a file was asked for, and under `provenance` where they come from. A list of them
    stands under `rows`.

    Raises:
        SagsError: it cannot be written.
    """
    if file is not None:
        from sags_node.tools.evaluation.provenance import provenance

        rows = {"rows": figures} if isinstance(figures, list) else figures
        with whole(file) as partial:
            partial.write_text(json_text({"provenance": provenance()} | dict(rows), indent=1) + "\n", "utf-8")
