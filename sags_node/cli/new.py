"""`sags new`: a launch file for a recording or for cameras, once they have been tried."""

import os
import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
import yaml
from rich.markup import escape

from sags_node.cli.launching import as_json, file_option, force_option
from sags_node.errors import SagsError, UsageError
from sags_node.files import check_file, whole
from sags_node.terminal import text
from sags_node.terminal.console import console, progress, show

SAID_BY_PICTURES = ("source", "calibration")  # checks of sags doctor that are made already


@click.command()
@click.argument("said", nargs=-1, metavar="[FOLDER | VIDEO [VIDEO] | DEVICE [DEVICE]] [key:=value ...]")
@click.option(
    "--from", "also", multiple=True, metavar="PATH", help="What to try, as an option; may be repeated."
)
@file_option("-o", "--out", metavar="FILE.yaml", help="The launch file; default: named after the source.")
@force_option
@as_json
def new(said: tuple[str, ...], also: tuple[str, ...], out: Path | None, force: bool, json_out: bool) -> None:
    """Try a recording or cameras, and write a launch file for it.

    Of two videos, folders or devices the left eye comes first. It is opened, and some of its images are
    looked at: size and rate, how one image shows both eyes, borders, interlacing, whether the eyes are
    exchanged, late, or their rows apart, and whether the calibration fits. What a key can fix is set.
    key:=value are written too. Without arguments it asks, where there is a terminal.

    Exit code 1: it cannot be played; then nothing is written.

    \b
    sags new my_folder -o mine.yaml
    sags new left.mp4 right.mp4 rig:=calib/mine
    sags new /dev/video0 source.width:=1920 source.height:=1080
    """
    from sags_node.checks import is_wrong
    from sags_node.config.launch_file import load_launch, tree_of, written_in
    from sags_node.tools.doctor import examine
    from sags_node.tools.importing.proposal import propose

    words = [*also, *said]
    named = [Path(word) for word in words if ":=" not in word]
    if not named:
        named, out = _asked(out)
    file = out or Path(f"{named[0].resolve().stem}.yaml")
    check_file(file, force)
    with progress("looking it over") as advance:
        found = propose(named, [word for word in words if ":=" in word], advance)
    rows: list[dict[str, Any]] = [asdict(finding) for finding in found.findings]
    wrong = is_wrong(found.findings)
    if not wrong:
        rows += [
            {"level": each.level, "what": f"{name}: {each.what}", "fix": each.fix}
            for name, each in examine(load_launch(named[0], found.launch))
            if each.level != "ok" and name not in SAID_BY_PICTURES
        ]
        tree = written_in(file.parent, tree_of(found.launch))
        with whole(file) as partial:
            partial.write_text(yaml.safe_dump(tree, sort_keys=False, allow_unicode=True), encoding="utf-8")
        load_launch(file)  # an error where the file is not valid as written
    show({"launch": None if wrong else str(file), "found": rows} if json_out else text.findings_table(rows))
    if wrong:
        raise SagsError(f"{named[0]} cannot be played as it is; see the fixes above")
    where = escape(shlex.quote(str(file)))
    console.print(f"launch file: [bold]{where}[/]; play it: sags run {where}", soft_wrap=True)


def _asked(out: Path | None) -> tuple[list[Path], Path | None]:
    """Ask the user for the source and, where it is not given, the launch file."""
    if not sys.stdin.isatty():
        raise UsageError("name a folder, a video or a device, e.g. sags new my_folder -o mine.yaml")
    said = click.prompt("Folder, video or device (two: left and right, with a space between)", err=True)
    named = _paths(said)
    if out is None:
        out = Path(click.prompt("Launch file", default=f"{named[0].resolve().stem}.yaml", err=True))
    return named, out


def _paths(said: str) -> list[Path]:
    """Split paths as a shell does; a single path that exists may have spaces without quotes."""
    try:
        words = [said] if os.path.exists(said) else shlex.split(said)
    except ValueError as error:
        raise UsageError(f"{said}: {error}; close the quotes") from None
    return [Path(word) for word in words]
