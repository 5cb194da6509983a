"""`sags calib`: make, check and convert camera calibrations."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.markup import escape

from sags_node.cli.launching import (
    as_json,
    check_files,
    file_option,
    force_option,
    group_of,
    launch_argument,
    launched,
    path_option,
    positive,
    show_findings,
    shown,
    split,
)
from sags_node.config.units import UNITS
from sags_node.errors import SagsError, UsageError
from sags_node.files import check_file, whole
from sags_node.terminal import text
from sags_node.terminal.console import console, progress, show

if TYPE_CHECKING:
    from sags_node.tools.calibration.boards import Board

OUT = ("-o", "--out", "--output")
EYES = Path("eyes.png")

path_argument = click.argument("path", type=click.Path(path_type=Path))
out_option = path_option(*OUT, required=True, metavar="FOLDER", help="Gets left.yaml and right.yaml.")


def _sides(ctx: click.Context, option: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """Two numbers as people write sizes: 720x576."""
    if value is None:
        return None
    found = re.fullmatch(r"([1-9]\d{0,4})[xX×]([1-9]\d{0,4})", value)
    if found is None:
        like = "10x7" if option.name == "squares" else "720x576"
        raise click.BadParameter(f"'{value}' is not like {like}", ctx, option)
    return int(found[1]), int(found[2])


reading_options = group_of(  # for forms of calibration that leave something out
    click.option(
        "--size",
        callback=_sides,
        metavar="WxH",
        help="Image size, for forms that do not say it; default: the images'.",
    ),
    click.option(
        *("--unit", "metres"),
        type=click.Choice(list(UNITS)),
        callback=lambda ctx, option, unit: UNITS.get(unit or ""),
        help="Of lengths in the files; default: mm for text matrices, else m.",
    ),
)
board_options = group_of(  # which board is seen; as `_board` takes them
    shown(
        "--board",
        type=click.Choice(["chessboard", "charuco"]),
        default="chessboard",
        help="What is printed on it.",
    ),
    click.option(
        "--squares", callback=_sides, required=True, metavar="CxR", help="Columns and rows of squares."
    ),
    click.option("--square-mm", type=positive, required=True, help="Side of a square."),
    click.option("--marker-mm", type=positive, help="Side of a marker; charuco only."),
    click.option("--dictionary", metavar="NAME", help="Of the markers, e.g. 4X4_50; charuco only."),
    click.option("--legacy", is_flag=True, help="Printed by an OpenCV before 4.6; charuco only."),
)


@click.group()
def calib() -> None:
    """Make, check and convert camera calibrations."""


@calib.command()
@path_argument
@click.argument("overrides", nargs=-1, metavar="[key:=value ...]")
@path_option("--session", help="Launch file or recording to compare with.")
@click.option(
    "--images",
    type=(click.Path(path_type=Path), click.Path(path_type=Path)),
    multiple=True,
    metavar="LEFT RIGHT",
    help="Images, or folders of them, to compare with; may be repeated.",
)
@reading_options
@as_json
def check(
    path: Path,
    overrides: tuple[str, ...],
    session: Path | None,
    images: tuple[tuple[Path, Path], ...],
    size: tuple[int, int] | None,
    metres: float | None,
    json_out: bool,
) -> None:
    """Look over a calibration for what usually goes wrong.

    PATH is a calibration of any known form, or a session, whose calibration is compared with its own
    images. With images the rows of both eyes are measured, and the check tells which end is wrong, the
    calibration or the images, and whether one eye's scale is off. Where the session knows depths, they
    show whether the principal points differ sideways. docs/calibration.md lists the forms.

    \b
    sags calib check calib/d4d
    sags calib check calib/d4d --session launch/d4d_pull.yaml
    sags calib check /data/pair --images /data/pair/left.png /data/pair/right.png
    sags calib check launch/v4l2.yaml source.left:=/dev/video-left
    """
    from sags_node.tools.calibration.check import check_calibration

    if session is not None and images:
        raise UsageError("--session and --images: one of them is enough")
    stray, overrides_only = split(overrides)
    if stray is not None:
        raise UsageError(f"'{stray}': one calibration at a time; images come after --images or --session")
    with progress("comparing") as advance:
        findings = check_calibration(path, session, images, overrides_only, size, metres, advance, launched)
    rows = [asdict(finding) for finding in findings]
    show_findings(rows, json_out, f"{path} cannot be used as it is")


@calib.command()
@path_argument
@out_option
@reading_options
@click.option("--scale", type=positive, default=1.0, help="Of images that are resized after calibration.")
@force_option
def convert(
    path: Path, out: Path, size: tuple[int, int] | None, metres: float | None, scale: float, force: bool
) -> None:
    """Write any known calibration as left.yaml and right.yaml.

    PATH may be a session, as a bag: its calibration is written.

    \b
    sags calib convert stereo_calib/ -o calib/mine --size 1280x720 --unit mm
    sags calib convert calibrationdata.tar.gz -o calib/mine
    """
    from sags_node.checks import refuse_errors
    from sags_node.rig import check_rig, eye_files, resized_rig, save_rig
    from sags_node.tools.calibration.check import read_calibration

    if path.resolve() in (file.resolve() for file in (out, *eye_files(out))):
        raise UsageError(f"{out} is what is converted, and would be replaced; name another folder")
    rig = resized_rig(read_calibration(path, size, metres, launched), scale)
    refuse_errors(check_rig(rig, metres), path)
    check_files(*eye_files(out), force=force)
    save_rig(rig, out)
    console.print(
        f"calibration: [bold]{escape(str(out))}[/], {rig.left.width}x{rig.left.height} px, baseline "
        f"{rig.baseline * 1e3:.3g} mm",
        soft_wrap=True,
    )


@calib.command("live")
@launch_argument
@shown("--seconds", type=positive, default=2.0, help="To watch.")
@file_option(
    *OUT,
    default=EYES,
    show_default=True,
    metavar="FILE.png",
    help="The image; an older eyes.png is replaced.",
)
@force_option
@as_json
def look_at_eyes(launch: tuple[str, ...], seconds: float, out: Path, force: bool, json_out: bool) -> None:
    """Show what the source gives for each eye.

    Watches cameras, or any other source, and writes an image of both eyes side by side: is each eye whole,
    upright, and on its own side? Lines across both help to compare heights. Also size, rate, skew and age of
    the images. No calibration is needed; where the launch file names one, its size is compared.

    \b
    sags calib live launch/v4l2.yaml
    sags calib live launch/gst_over_under.yaml source.geometry.first:=right -o exchanged.png
    """
    import cv2

    from sags_node.config.launch_file import load_launch
    from sags_node.rig import load_rig
    from sags_node.tools.calibration.eyes import look

    config = load_launch(*split(launch))
    check_file(out, force or out == EYES)
    picture, found = look(config, seconds)
    with whole(out) as partial:
        partial.write_bytes(cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
    show(found if json_out else text.rows_table([found]))
    console.print(f"both eyes: [bold]{escape(str(out))}[/]", soft_wrap=True)
    if config.rig is not None and not config.one_camera:
        eye = load_rig(config.rig).left
        if (eye.width, eye.height) != (found["width"], found["height"]):
            raise SagsError(
                f"the calibration {config.rig} is for {eye.width}x{eye.height} px, the images are "
                f"{found['width']}x{found['height']}; set source.geometry.crop, or calibrate at this size"
            )


@calib.command()
@click.argument("folders", nargs=-1, type=click.Path(path_type=Path), metavar="[LEFT_FOLDER RIGHT_FOLDER]")
@path_option("--live", metavar="LAUNCH", help="Take them from its cameras, or its recording of a board.")
@board_options
@shown(
    "--coefficients",
    type=click.Choice(["2", "3", "6"]),
    default="2",
    help="Of radial distortion: 2 and 3 plumb_bob, 6 rational_polynomial.",
)
@shown("--views", type=click.IntRange(6), default=25, help="To take; --live only.")
@out_option
@force_option
@as_json
def stereo(
    folders: tuple[Path, ...],
    live: Path | None,
    coefficients: str,
    views: int,
    out: Path,
    force: bool,
    json_out: bool,
    **board_of: Any,
) -> None:
    """Calibrate a stereo rig from images of a board.

    Images are paired by sorted name. Views that fit far worse than the rest are left out and named. With
    --live they are taken from a source as the board is moved about, and kept in FOLDER/views.

    \b
    sags calib stereo left/ right/ --squares 10x7 --square-mm 4.5 -o calib/my_rig
    sags calib stereo left/ right/ --board charuco --squares 11x8 --square-mm 5 \\
        --marker-mm 3.7 --dictionary 4X4_50 -o calib/my_rig
    sags calib stereo --live launch/v4l2.yaml --squares 10x7 --square-mm 4.5 -o calib/my_rig
    """
    from sags_node.rig import eye_files, save_rig
    from sags_node.tools.calibration.stereo import calibrate_folders, report_table, summarise

    if (live is None) != (len(folders) == 2) or (live is not None and folders):
        raise UsageError("give two folders, LEFT_FOLDER RIGHT_FOLDER, or --live LAUNCH")
    board = _board(**board_of)
    check_files(*eye_files(out), force=force)
    left, right = folders if live is None else _grab(live, board, out / "views", views)
    with progress("looking for the board") as advance:
        calibrated = calibrate_folders(left, right, board, out.name, int(coefficients), advance)
    save_rig(calibrated.solution.rig, out)
    summary = summarise(calibrated)
    show(summary if json_out else report_table(summary))
    console.print(f"calibration: [bold]{escape(str(out))}[/]", soft_wrap=True)


@calib.command("hand-eye")
@launch_argument
@board_options
@shown("--views", type=click.IntRange(10, 1000), default=80, help="Spread over the recording.")
@path_option(*OUT, required=True, metavar="FOLDER", help="The rig's folder; gets hand_eye.yaml.")
@force_option
@as_json
def hand_eye(
    launch: tuple[str, ...], views: int, out: Path, force: bool, json_out: bool, **board_of: Any
) -> None:
    """Find how the camera sits on the robot.

    From a recording of a board and of the robot's poses.

    The board lies still. The robot moves and turns the scope about, at different speeds: from that the offset
    between the robot's clock and the images' is found, too. docs/inputs.md says more.

    \b
    sags calib hand-eye case.mcap rig:=calib/my_rig robot.kind:=bag robot.topic:=/ECM/measured_cp \\
        --squares 10x7 --square-mm 4.5 -o calib/my_rig
    """  # fmt: skip
    from sags_node.config.launch_file import load_launch
    from sags_node.pipeline.session import rig_of
    from sags_node.rig.hand_eye import FILE, save_hand_eye
    from sags_node.tools.calibration.hand_eye import calibrate_hand_eye, hand_eye_table, summarise_hand_eye

    path, overrides = split(launch)
    config = load_launch(path, overrides)
    board = _board(**board_of)
    check_files(out / FILE, force=force)
    with progress("looking for the board") as advance:
        solution = calibrate_hand_eye(config, rig_of(config), board, views, advance)
    summary = summarise_hand_eye(solution)
    save_hand_eye(solution.hand_eye, out, summary)
    show(summary if json_out else hand_eye_table(summary))
    console.print(f"hand-eye calibration: [bold]{escape(str(out / FILE))}[/]", soft_wrap=True)


def _board(
    squares: tuple[int, int],
    board: str,
    square_mm: float,
    marker_mm: float | None,
    dictionary: str | None,
    legacy: bool,
) -> Board:
    from sags_node.tools.calibration.boards import Charuco, Chessboard

    if min(squares) < 4:
        raise UsageError(f"--squares {squares[0]}x{squares[1]}: a board needs 4 squares along each side")
    if board == "chessboard":
        if marker_mm is not None or dictionary is not None or legacy:
            raise UsageError("--marker-mm, --dictionary and --legacy belong to --board charuco")
        return Chessboard(squares, square_mm * 1e-3)
    if marker_mm is None or dictionary is None:
        raise UsageError("--board charuco needs --marker-mm and --dictionary")
    if marker_mm >= square_mm:
        raise UsageError(f"--marker-mm {marker_mm:g} must be below --square-mm {square_mm:g}")
    return Charuco(squares, square_mm * 1e-3, marker_mm * 1e-3, dictionary, legacy)


def _grab(live: Path, board: Board, folder: Path, count: int) -> tuple[Path, Path]:
    from sags_node.config.launch_file import load_launch
    from sags_node.tools.calibration.live import grab_views

    with console.status("starting the source (Ctrl-C: enough views)") as status:

        def tell(taken: int, what: str) -> None:
            status.update(f"{taken} of {count} views: {what}  (Ctrl-C: enough)")

        return grab_views(load_launch(live), board, folder, count, tell)
