"""Benchmark commands of the engine and the offline model."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from benchmarks.commands.measuring import Measured, measures, split, step_by_step, writes
from benchmarks.tables import tables
from sags_node.cli.launching import (
    as_json,
    check_files,
    figures_option,
    file_option,
    force_option,
    launch_argument,
    shown,
    write_json,
)
from sags_node.errors import SagsError, UsageError
from sags_node.terminal.console import progress, show
from sags_node.tools.evaluation.plots import check_plots

if TYPE_CHECKING:
    from benchmarks import Advance


@click.command("kernels")
@click.option("--quick", is_flag=True, help="A tiny scene and few runs: does it work, not how fast is it.")
@click.option("--contention", is_flag=True, help="Also beside another process that burns one core.")
@figures_option
@file_option(
    "--check",
    metavar="FILE.json",
    help="Compare with a table written by --out; fail if a kernel has become slower.",
)
@shown(
    "--tolerance",
    type=click.FloatRange(min=1.0),
    default=1.3,
    help="How many times slower than in --check's table is too slow.",
)
@as_json
def bench_kernels(
    quick: bool, contention: bool, out: Path | None, check: Path | None, tolerance: float, json_out: bool
) -> None:
    """Time every kernel of the engine beside the machine's peak.

    --out also writes a plot of the same name, .svg, beside the figures.

    Milliseconds per stage, pixel-Gaussian pairs per second, the share of the machine's peak (multiply-adds or
    memory, whichever binds; both measured in the same run), the gain over the plain torch twin (10 GB), how
    it scales with threads, and what idle pauses cost. Takes two minutes, in which the machine should do
    nothing else.

    --check is the guard against kernels that became slow without an error. It compares each kernel's time in
    units of the machine's own peak, so a table from another machine works, too, less exactly. Exit code 1 and
    the kernel's name if one is slower than the tolerance.

    \b
    python -m benchmarks kernels --out benchmarks/results/kernels.json
    python -m benchmarks kernels --check benchmarks/results/kernels.json
    """
    from benchmarks.kernels import check as guard
    from benchmarks.kernels import measure as kernels
    from benchmarks.kernels.plot import plot

    if check is not None and out is not None:
        raise UsageError("give --out or --check: a check measures up to three times and keeps no table")
    settings = kernels.QUICK if quick else kernels.Settings()
    if check is not None:
        kept, settings = guard.read_table(check), replace(settings, twin=False, rhythm=False)
        with progress("measuring") as advance:
            compared = guard.check(lambda: kernels.measure_kernels(settings, advance), kept, tolerance)
        rows = [asdict(each) for each in compared]
        for part in [rows] if json_out else tables(rows, "kernel ms kept_ms ratio"):
            show(part)
        slower = [f"{each.kernel} {each.ratio:.2f} times" for each in compared if each.ratio > tolerance]
        if slower:
            raise SagsError(f"slower than in {check}, three times in a row: {'; '.join(slower)}")
        return
    drawn = None if out is None else out.with_suffix(".svg")
    if out is not None:
        check_plots()
        check_files(out, *() if out.exists() else (drawn,))  # else it is the earlier figures' plot
    with progress("measuring") as advance:
        measured = kernels.measure_kernels(replace(settings, contention=contention), advance)
    for table in [measured] if json_out else tables(measured, *kernels.TABLES):
        show(table)
    write_json(out, measured)
    writes(drawn, lambda: plot(measured))()


@click.command("alias")
@click.option("--quick", is_flag=True, help="A tiny scene and few steps: does it work, not how good is it.")
@file_option("--picture", metavar="FILE.png", help="Draw the truth, both filters and none side by side.")
@force_option
@measures("measuring", "picture")
def bench_alias(quick: bool, picture: Path | None, advance: Advance) -> Measured:
    """What both anti-aliasing filters gain at other sizes and distances.

    Four models of one instant of the phantom, with each choice of filters, are drawn at 1/4 to 4 times the
    size and from 1/2 to 4 times the distance, and compared with the ray-cast truth: PSNR, the brightness of
    thin vessels, flicker in a slow motion. Takes about two minutes.

    \b
    python -m benchmarks alias --out benchmarks/results/alias.json --picture docs/alias.png
    """
    from benchmarks.quality import alias

    measured = alias.measure_alias(alias.QUICK if quick else alias.Settings(), advance)
    draw = writes(picture, lambda: alias.picture(measured.truth, measured.models))
    return measured.table, alias.TABLES, draw


@click.command("methods")
@launch_argument
@measures("measuring")
def bench_methods(launch: tuple[str, ...], advance: Advance) -> Measured:
    """Compare control nodes and the paper's field (mapping.method nodes, sags) on a recording, at two sizes.

    Live: rate, latency and PSNR. Step by step: PSNR of the newest frame, the next and held-out ones, depth,
    tracks, and of all frames of the last two seconds when the stream has ended. Takes some minutes.

    \b
    python -m benchmarks methods launch/d4d_pull.yaml --out methods.json
    """
    from benchmarks.quality import methods

    return methods.measure_methods(*split(launch, "methods"), advance), methods.TABLES


@click.command("ablation")
@launch_argument
@shown("--warm-up", type=click.IntRange(0), default=300, help="Of the paper's schedule.")
@shown("--iterations", type=click.IntRange(1), default=1500, help="With deformation.")
@shown("--seeds", type=click.IntRange(1), default=3, help="Fits of each variant.")
@click.option("--variant", "only", multiple=True, metavar="NAME", help="Only this one; may be given again.")
@click.option(
    "--set", "changes", multiple=True, metavar="KEY=VALUE", help="A setting of every variant, as in sags fit."
)
@measures("fitting")
def bench_ablation(
    launch: tuple[str, ...],
    warm_up: int,
    iterations: int,
    seeds: int,
    only: tuple[str, ...],
    changes: tuple[str, ...],
    advance: Advance,
) -> Measured:
    """What each part of the SAGS model brings, offline.

    Fits a recording, by default the built-in phantom, with and without the self-adaptive decoder (an MLP of
    its size in its place), the alias-free filters and the online start, and with each choice of tokens, each
    from several seeds. Measures every eighth frame and the last three, from which nothing is learnt, training
    frames, and smaller images. Takes some fifteen minutes for each seed.

    \b
    python -m benchmarks ablation launch/d4d_pull.yaml --out benchmarks/results/ablation_d4d.json
    """
    from benchmarks.quality import ablation

    session = step_by_step(launch, "ablation")
    measured = ablation.measure_ablation(session, warm_up, iterations, advance, seeds, only, changes)
    return measured, ablation.TABLES


@click.command("gpu")
@shown("--device", type=click.Choice(["cuda", "cpu"]), default="cuda", help="cpu: Warp's, which is slow.")
@click.option("--small", is_flag=True, help="Tiny sizes: does it work, not how fast is it.")
@shown("--schedule", type=click.Choice(["paper", "released"]), default="paper", help="Of the fit.")
@shown("--seconds", type=click.FloatRange(min=1), default=480.0, help="After which no part begins.")
@click.option("--part", help="Only this one, in this process; prints JSON.")
@figures_option
def bench_gpu(
    device: str, small: bool, schedule: str, seconds: float, part: str | None, out: Path | None
) -> None:
    """Check all that a GPU should do: parity, times, a fit, live runs. `make gpu-check` calls it.

    \b
    python -m benchmarks gpu --out benchmarks/results/gpu.json
    python -m benchmarks gpu --device cpu --small      # tries all of it without a GPU
    """
    from benchmarks.gpu.check import gpu_check, parts, run_part, table

    chosen = parts(small, schedule)
    if part is not None:
        if part not in chosen:
            raise UsageError(f"there is no part {part!r}: choose one of {', '.join(chosen)}")
        click.echo(json.dumps(run_part(part, device, small, schedule)))
        return
    check_files(out)

    def keep(figures: dict[str, Any]) -> None:
        write_json(out, figures)
        name = [*figures][-1]
        click.echo(f"{name}: {figures[name].get('error', 'done')}", err=True)

    arguments = ["--device", device, "--schedule", schedule, *["--small"] * small]
    figures = gpu_check(arguments, chosen, keep, seconds)
    show(table(figures, chosen))
    if failed := [name for name, found in figures.items() if "error" in found]:
        raise SagsError(f"failed: {', '.join(failed)}; what they said is above")
