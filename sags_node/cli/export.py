"""`sags export`: the model at one moment as splats, points, a mesh or a video around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sags_node.cli.launching import (
    as_json,
    check_files,
    file_option,
    force_option,
    open_launched,
    positive,
    split_recording,
)
from sags_node.cli.node_options import endpoint_option, node_options, ns_option
from sags_node.errors import UsageError
from sags_node.terminal import text
from sags_node.terminal.console import progress, show

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress

NO_CAMERAS = "live cameras are exported from the running node; leave out --session"


@click.command()
@click.argument("overrides", nargs=-1, metavar="[key:=value ...]")
@click.option(
    "--session",
    metavar="LAUNCH.yaml",
    help="Play this recording instead, as fast as it goes; key:=value changes it, as for sags run.",
)
@click.option("--at", type=click.FloatRange(min=0), help="Seconds into the session; default: its end.")
@click.option(
    "--fit",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="What sags fit made of that session, in place of the online model.",
)
@file_option("--splats", metavar="F.ply", help="All Gaussians with the fields of 3D Gaussian Splatting.")
@file_option(
    "--points", metavar="F.ply|.pcd", help="The surface that the left camera sees, x y z (m) and rgb."
)
@file_option(
    "--mesh",
    metavar="F.ply|.obj|.stl",
    help="The same surface as triangles; where nothing is known is a hole.",
)
@file_option("--orbit", metavar="F.mp4", help="A video around the tissue.")
@click.option(
    "--sequence",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="All Gaussians of every frame of --session, a .ply each, and a video that plays in a loop. The same "
    "command again goes on where it was ended.",
)
@file_option("--tracks", metavar="F.npz", help="64 points that are followed through all of --session, in 3D.")
@file_option("--render", metavar="F.mp4", help="The model as the left eye sees it, every frame of --session.")
@click.option(
    "--depth",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="The model's depth of every frame of --session, 16-bit PNGs in units of 0.01 mm, 0 unknown.",
)
@click.option(
    "--orbit-degrees",
    type=click.FloatRange(0, 60),
    default=12.0,
    show_default=True,
    help="How far the camera of the video tilts from where it was.",
)
@click.option("--orbit-seconds", type=positive, default=6.0, show_default=True, help="Length of the video.")
@force_option
@endpoint_option
@ns_option
@node_options
@as_json
def export(
    overrides: tuple[str, ...],
    session: str | None,
    at: float | None,
    fit: Path | None,
    splats: Path | None,
    points: Path | None,
    mesh: Path | None,
    orbit: Path | None,
    sequence: Path | None,
    orbit_degrees: float,
    orbit_seconds: float,
    force: bool,
    node: NodeAddress,
    json_out: bool,
    **of_every_frame: Path | None,
) -> None:
    """Write the model at one moment for other programs, in metres.

    Of the running node, its newest frame; or of a recording at any time, with no node running.

    \b
    sags export --mesh now.ply --points now.pcd
    sags export --session launch/d4d_pull.yaml --at 3 --mesh lift.obj --orbit lift.mp4
    sags export --session launch/d4d_pull.yaml --fit out/d4d --at 3 --splats lift.ply
    sags export --session launch/d4d_pull.yaml --sequence out/frames
    sags export --session launch/d4d_pull.yaml --depth out/depth --tracks out/tracks.npz
    """
    from sags_node.export import export as work
    from sags_node.export import scene as source
    from sags_node.export import sequence as many
    from sags_node.export.played import KINDS, new_folder

    played = {kind: path for kind, path in of_every_frame.items() if path is not None}
    asked = {"splats": splats, "points": points, "mesh": mesh, "orbit": orbit}
    targets = {kind: path for kind, path in asked.items() if path is not None}
    if played and (targets or sequence or at is not None or fit is not None or session is None):
        raise UsageError(
            f"--{next(iter(played))} is of every frame: it needs --session LAUNCH.yaml, and no files of one "
            "moment, --sequence, --at or --fit beside it"
        )
    if played and session is not None:
        for kind, target in played.items():
            if KINDS[kind].is_folder:
                new_folder(target)
            else:
                check_files(target, force=force)
        _export_played((session, *overrides), played, json_out)
        return
    if sequence is None:
        work.check_targets(targets, force)
    elif targets or at is not None or session is None:
        raise UsageError("--sequence needs --session LAUNCH.yaml, and neither --at nor other files beside it")
    if session is None and (overrides or at is not None or fit is not None):
        raise UsageError("--at, --fit and key:=value need --session LAUNCH.yaml")
    if session is not None:
        path, changed = split_recording((session, *overrides), NO_CAMERAS)
        opened = open_launched(path, [*changed, "source.loop:=false", "source.pace:=step"])
    if sequence is not None and session is not None:
        fitted = None if fit is None else str(fit.resolve())
        about = {"session": opened.name, "overrides": changed, "fit": fitted}
        many.check_sequence(sequence, about, force)
        with progress("exporting") as advance:
            scenes = (
                source.scenes_of_session(opened)
                if fit is None
                else source.scenes_of_fit(fit, opened, advance)
            )
            rows = many.write_sequence(
                sequence, scenes, opened.source.rate, opened.source.frame_count, advance
            )
        show(rows if json_out else text.rows_table(rows))
        return
    with progress("exporting") as advance:
        if session is None:
            scene = source.from_node(node)
        elif fit is None:
            scene = source.from_session(opened, at, advance)
        else:
            scene = source.from_fit(fit, opened, at, advance)
        rows = work.export(scene, targets, work.Orbit(orbit_degrees, orbit_seconds), advance)
    show(rows if json_out else text.rows_table(rows))


def _export_played(launch: Sequence[str], played: Mapping[str, Path], json_out: bool) -> None:
    from sags_node.export.played import write_played

    path, overrides = split_recording(launch, NO_CAMERAS)
    opened = open_launched(path, [*overrides, "source.loop:=false", "source.pace:=step"])
    with progress("exporting") as advance:
        rows = write_played(opened, played, advance)
    show(rows if json_out else text.rows_table(rows))
