"""`sags export`: the model at one moment as splats, points, a mesh or a video around it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sags_node.cli.launching import (
    STEPWISE,
    Number,
    as_json,
    check_apart,
    check_files,
    file_option,
    folder_option,
    force_option,
    from_zero,
    launch_argument,
    open_launched,
    played_instead,
    positive,
    session_option,
    show_rows,
    shown,
    split_recording,
)
from sags_node.cli.node_options import data_options
from sags_node.errors import UsageError
from sags_node.terminal.console import progress

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress

NO_CAMERAS = "live cameras are exported from the running node; name no recording"


@click.command()
@launch_argument
@session_option
@click.option("--at", type=from_zero, help="Seconds into the session; default: its last frame taken in.")
@folder_option("--fit", help="What sags fit made of that session, in place of the online model.")
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
@folder_option(
    "--sequence",
    help="All Gaussians of every frame of a recording, a .ply each, and a video that plays in a loop. The "
    "same command again goes on where it was ended.",
)
@file_option("--tracks", metavar="F.npz", help="64 points that are followed through a recording, in 3D.")
@file_option(
    "--render",
    metavar="F.mp4",
    help="The tissue without instruments as the left eye sees it, each frame of a recording: as published in "
    "left/render/image. publish.detail:=false shows the model alone.",
)
@folder_option(
    "--depth",
    help="The model's depth of every frame of a recording, 16-bit PNGs in units of 0.01 mm, 0 unknown.",
)
@shown(
    "--orbit-degrees",
    type=Number(0, 60),
    default=12.0,
    help="How far the camera of the video tilts from where it was.",
)
@shown("--orbit-seconds", type=positive, default=6.0, help="Length of the video.")
@force_option
@data_options
@as_json
def export(
    launch: tuple[str, ...],
    session: str | None,
    at: float | None,
    fit: Path | None,
    sequence: Path | None,
    orbit_degrees: float,
    orbit_seconds: float,
    force: bool,
    node: NodeAddress,
    json_out: bool,
    **files: Path | None,
) -> None:
    """Write the model at one moment for other programs, in metres.

    Without a recording it is the newest frame of the running node. A recording is played as fast as it goes,
    up to any time; then no node need run.

    \b
    sags export --mesh now.ply --points now.pcd
    sags export launch/d4d_pull.yaml --at 3 --mesh lift.obj --orbit lift.mp4
    sags export launch/d4d_pull.yaml --fit out/d4d --at 3 --splats lift.ply
    sags export launch/d4d_pull.yaml --sequence out/frames
    sags export launch/d4d_pull.yaml --depth out/depth --tracks out/tracks.npz
    """
    from sags_node.tools.export import export as work
    from sags_node.tools.export import scene as source
    from sags_node.tools.export import sequence as many
    from sags_node.tools.export.played import KINDS, new_folder, write_played

    played, targets = (
        {kind: file for kind in kinds if (file := files.get(kind)) is not None}
        for kinds in (KINDS, work.KINDS)
    )
    words = played_instead(launch, session)
    if played and (targets or sequence or at is not None or fit is not None or words is None):
        raise UsageError(
            f"--{next(iter(played))} exports all frames: name a recording, and leave out --mesh, --points, "
            "--splats, --orbit, --sequence, --at, --fit"
        )
    for kind, target in played.items():
        if KINDS[kind].is_folder:
            new_folder(target)
        else:
            check_files(target, force=force)
    if sequence is None and not played:
        work.check_targets(targets, force)
    elif sequence is not None and (targets or at is not None or words is None):
        raise UsageError("--sequence exports all frames: name a recording, no --at and no other files")
    if words is None and (launch or at is not None or fit is not None):
        raise UsageError("--at, --fit and key:=value need a recording: sags export RECORDING ...")
    if words is not None:
        path, changed = split_recording(words, NO_CAMERAS)
        opened = open_launched(path, [*changed, *STEPWISE])
        read = [value for _, value in opened.config.source if isinstance(value, Path)]
        check_apart([*played.values(), *targets.values()], [*read, *([] if path is None else [Path(path)])])
    if played:
        with progress("exporting") as advance:
            rows = write_played(opened, played, advance)
        show_rows(rows, json_out)
        return
    if sequence is not None:
        fitted = None if fit is None else str(fit.resolve())
        recording = None if path is None else str(Path(path).resolve())
        about = {"session": opened.name, "recording": recording, "overrides": changed, "fit": fitted}
        many.check_sequence(sequence, about | many.state_of(opened, fit), force)
        with progress("exporting") as advance:
            if fit is None:
                scenes = source.scenes_of_session(opened)
            else:
                scenes = source.scenes_of_fit(fit, opened, advance)
            rate, count = opened.source.rate, opened.source.frame_count
            rows = many.write_sequence(sequence, scenes, rate, count, advance)
        show_rows(rows, json_out)
        return
    with progress("exporting") as advance:
        if words is None:
            scene = source.from_node(node)
        elif fit is None:
            scene = source.from_session(opened, at, advance)
        else:
            scene = source.from_fit(fit, opened, at, advance)
        rows = work.export(scene, targets, work.Orbit(orbit_degrees, orbit_seconds), advance)
    show_rows(rows, json_out)
