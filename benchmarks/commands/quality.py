"""Benchmark commands of accuracy: depth, masks, lengths, registration, instruments; and disturbances."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import TYPE_CHECKING

import click

from benchmarks.commands.measuring import (
    Measured,
    each_recording,
    measures,
    recordings_argument,
    seeds_option,
    split,
    step_by_step,
    writes,
)
from sags_node.cli.launching import (
    STEPWISE,
    check_files,
    file_option,
    folder_option,
    force_option,
    launch_argument,
    open_launched,
    positive,
    shown,
)
from sags_node.errors import UsageError
from sags_node.files import whole

if TYPE_CHECKING:
    from benchmarks import Advance
    from benchmarks.quality.disturbances import Shot


@click.command("depth")
@launch_argument
@folder_option("--ct", help="One pair of the Open-CAS set against its CT surface, instead of a recording.")
@click.option("--faults", is_flag=True, help="The phantom with noise, blur, smoke and highlights rising.")
@click.option(
    "--network",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    metavar="FILE.onnx",
    help="A depth network to compare as well.",
)
@file_option("--picture", metavar="FILE.jpg", help="With --ct: draw the left image, the depth and its error.")
@force_option
@measures("measuring", "picture")
def bench_depth(
    launch: tuple[str, ...],
    ct: Path | None,
    faults: bool,
    network: Path | None,
    picture: Path | None,
    advance: Advance,
) -> Measured:
    """How accurate the depth is, and how complete.

    The stereo stage at every scale, beside OpenCV's SGBM in its place and as its own sample sets it up, and a
    network where one is given.
    Median, 90th percentile and median signed error (below 0: too near), the share of the tissue that has a
    depth, the time of one pair, and whether the confidence orders the errors.

    A recording, by default the built-in phantom, is played with one step of the mapper a frame; at
    most every tenth frame is compared with its reference depth, and so is the depth of the drawn model, also
    by region: near and far, at edges, beside instruments, where the right eye does not see.

    \b
    python -m benchmarks depth launch/d4d_pull.yaml --out benchmarks/results/depth_d4d.json
    python -m benchmarks depth --ct $SAGS_DATA/tmi_ct_pair --out benchmarks/results/depth_tmi.json
    python -m benchmarks depth --faults --out benchmarks/results/depth_phantom.json
    python -m benchmarks depth launch/d4d_pull.yaml --network stereo.onnx
    """
    from benchmarks.quality import depth, depth_ct

    if (ct is not None) + faults + bool(launch) > 1:
        raise UsageError("a recording, --ct or --faults: give one of them")
    if picture is not None and ct is None:
        raise UsageError("--picture draws what --ct measures; add --ct FOLDER")
    if ct is not None:
        pair = depth_ct.read_ct_pair(ct)
        measured = depth_ct.measure_ct(pair, advance, network)
        return measured, depth.TABLES, writes(picture, lambda: depth_ct.picture(pair))
    if faults:
        return depth.measure_faults(advance, network), depth.TABLES
    return depth.measure_recording(step_by_step(launch, "depth"), advance, network), depth.TABLES


@click.command("masks")
@recordings_argument
@measures("playing")
def bench_masks(launch: tuple[str, ...], advance: Advance) -> Measured:
    """How accurate the masks are that the node finds, and what they gain.

    Plays recordings that have masks of their own, by default the built-in phantom, once with these, once with
    those found without them (classical), once with none, and with a network's where vision.tissue.path is
    given; one step of the mapper a frame. Intersection over union of the instruments, the share of them that
    is missed, the share of tissue taken for them, what flickers; PSNR and depth error of the model, always
    under the recording's own mask.

    \b
    python -m benchmarks masks launch/d4d_pull.yaml launch/phantom.yaml --out benchmarks/results/masks.json
    """
    from benchmarks.quality import masks

    paths, overrides = each_recording(launch, "masks")
    methods = ["session", "classical", "none"]
    if any(override.startswith("vision.tissue.path:=") for override in overrides):
        methods.append("onnx")
    played = [
        open_launched(path, [*overrides, *STEPWISE, f"vision.tissue.method:={method}"])
        for path in paths
        for method in methods
    ]
    return [masks.measure_masks(session, advance) for session in played], masks.TABLES


@click.command("lengths")
@launch_argument
@measures("measuring")
def bench_lengths(launch: tuple[str, ...], advance: Advance) -> Measured:
    """How accurate lengths and areas between anchors are, and whether their stated errors are true.

    Anchors are pinned at points of the phantom that its first frame shows. Every fifth frame distances, paths
    of four and triangles between them are compared with the true ones; beside it the first frame's value,
    unchanged.

    \b
    python -m benchmarks lengths source.seconds:=8 --out benchmarks/results/lengths.json
    """
    from benchmarks.quality import measuring

    return measuring.measure_lengths(step_by_step(launch, "lengths"), advance), measuring.TABLES


@click.command("strain")
@seeds_option(3, "Phantoms, each pulled once.")
@measures("straining")
def bench_strain(seeds: int, advance: Advance) -> Measured:
    """How accurate the strain of the tissue is, in the columns `strain_max` and `strain_min` of `points`.

    The phantom is pulled. Truth is its grid, by central differences; beside it the value 0, which
    needs no measurement.

    \b
    python -m benchmarks strain --out benchmarks/results/strain.json
    """
    from benchmarks.quality import straining

    return straining.measure_strain(seeds, advance), straining.TABLES


@click.command("registration")
@folder_option("--ct", help="The pair of the Open-CAS set with its CT surface, too.")
@seeds_option(20, "Phantoms, and errors of the picked points.")
@measures("registering")
def bench_registration(ct: Path | None, seeds: int, advance: Advance) -> Measured:
    """How accurately a model is placed on tissue, and whether the stated errors are true.

    A part of the phantom's surface, moved, is registered to what the node measures of it in a second, from
    five pairs of points that are 1 mm off along each axis. Errors of five targets 20 mm below the surface:
    by the pairs alone, after the fit to the surface, by Open3D's ICP from the same start; and how many are
    within the stated error. Cases that must be refused are counted with their remedy.

    \b
    python -m benchmarks registration --ct $SAGS_DATA/tmi_ct_pair --out benchmarks/results/registration.json
    """
    from benchmarks.quality import registration

    return registration.measure_registration(ct, seeds, advance), registration.TABLES


@click.command("deform")
@seeds_option(5, "Phantoms.")
@measures("pulling")
def bench_deform(seeds: int, advance: Advance) -> Measured:
    """How well a registered model follows tissue that is pulled.

    A part of the phantom's surface, and the same 5, 10 and 20 mm below it, is held by anchors while the
    surface is pulled by 10 mm and more: rigid, and bent with it (`deform: true`). Errors of its vertices to
    the truth; below the surface that is an elastic half space, by definition. What the residual check says
    of both.

    \b
    python -m benchmarks deform --out benchmarks/results/deform.json
    """
    from benchmarks.quality import deform

    return deform.measure_deform(seeds, advance), deform.TABLES


@click.command("instruments")
@seeds_option(4, "Phantoms, each with other instruments before it.")
@measures("placing")
def bench_instruments(seeds: int, advance: Advance) -> Measured:
    """How accurate the tips, axes, distances and confidence of the topic `instruments` are.

    Instruments are put before the phantom, 5 to 40 mm from the tissue: one, two, crossing, and leaving the
    image. They are compared with the mask's far end, at the tissue's depth there, and at the depth that
    the node's stereo finds on the instrument.

    \b
    python -m benchmarks instruments --out benchmarks/results/instruments.json
    """
    from benchmarks.quality import instruments, kinematics

    measured = instruments.measure_instruments(seeds, advance)
    measured["kinematics"] = kinematics.measure_kinematics(seeds, advance)
    return measured, instruments.TABLES


@click.command("disturbances")
@launch_argument
@click.option(
    "--only",
    multiple=True,
    metavar="NAME",
    help="These alone; may be given several times. Default: all. The undisturbed run is always played.",
)
@click.option(
    "--from",
    "start",
    type=click.IntRange(0),
    metavar="FRAME",
    help="Where each begins. Default: the launch file's first segment, else 40 % of the recording.",
)
@shown(
    "--seconds",
    type=positive,
    default=1.0,
    help="That each lasts; dark (0.5 s), flash (2 frames) and cut (10 frames) at most so long.",
)
@folder_option(
    "--pictures",
    help="Write a PNG for each: both eyes as they came, the model and its depth, before, amid and after.",
)
@force_option
@measures("playing")
def bench_disturbances(
    launch: tuple[str, ...],
    only: tuple[str, ...],
    start: int | None,
    seconds: float,
    pictures: Path | None,
    force: bool,
    advance: Advance,
) -> Measured:
    """What bad images do to the node.

    Plays a recording with both eyes, by default the built-in phantom, once for each disturbance, frame by
    frame with one step of the mapper: undisturbed, disturbed for a second, undisturbed again. The image is
    compared with what the tissue really looked like at that time; published depth with the recording's
    reference; anchors, pinned before, with true surface points, or with where the undisturbed run has them.
    Tells when the node warns and stops, how soon the image is as before, how many models were made anew.
    Instruments are found, not given (vision.tissue.method:=session gives them).

    \b
    smoke         fills the space, drifts, is sucked off; thicker before what is far
    blood         covers half the image and is sucked off
    fog_right, fog_left, drops      on one lens, on both
    black_right, frozen_right, frozen (both), late_right (3 frames), knocked, swapped, equal
    dark, flicker, flash, blur      the lamp, the exposure, a spark, a shaken scope
    cut           another scene for ten frames
    lost_frames, jpeg               a fifth of the frames; a capture card that compresses too much

    Takes ten to thirty seconds each. Keys: benchmarks/disturbances.md.

    \b
    python -m benchmarks disturbances launch/d4d_pull.yaml --out new.json --pictures out/disturbances
    python -m benchmarks disturbances --only fog_right --only late_right
    """
    from benchmarks.disturbances import DISTURBANCES
    from benchmarks.quality import disturbances

    for name in set(only) - set(DISTURBANCES):
        near = difflib.get_close_matches(name, DISTURBANCES, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(DISTURBANCES)}"
        raise UsageError(f"--only: unknown disturbance '{name}'; {hint}")
    path, overrides = split(launch, "disturbances")
    names = only or tuple(DISTURBANCES)
    if pictures is not None:
        check_files(*(pictures / f"{name}.png" for name in ("clean", *names)), force=force)

    def draw(name: str, shots: list[Shot]) -> None:
        if pictures is not None:
            with whole(pictures / f"{name}.png") as file:
                file.write_bytes(disturbances.strip(shots))

    session = open_launched(path, ["vision.tissue.method:=classical", *overrides, *STEPWISE])
    measured = disturbances.measure_disturbances(session, names, start, seconds, advance, draw)
    return measured, disturbances.TABLES
