"""The table of `benchmarks kernels`: every kernel's time on this machine, beside the machine's own peak."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks import Advance
from benchmarks.kernels.contention import measure_contention, measure_rhythm
from benchmarks.kernels.rasterizing import RasterCase, measure_rasterizer
from benchmarks.kernels.scenes import surface
from benchmarks.kernels.timing import Work, bytes_of, median_ms, share_of_peak, stage_rows
from sags_node.engine.adam import AdamState, adam_step
from sags_node.engine.losses import tissue as losses
from sags_node.engine.rasterizer import views
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.kernels.peak import Peak, measure_peak, peak_row
from sags_node.kernels.threads import configure_threads
from sags_node.tools.evaluation.provenance import machine_name

DEPTH_WEIGHT, DEPTH_SCALE = 2e-3, 1e-3  # as the mapper's

# per value: it and its two moments are read and written, its gradient is read
ADAM_FLOATS, ADAM_OPERATIONS = 7, 14

GAUSSIAN_COLUMNS, CELL_COLUMNS = 14, 32
ACTIVE_SHARES = (0.5, 0.25, 0.1, 0.05)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is measured."""

    counts: tuple[int, ...] = (10_000, 30_000, 100_000)  # Gaussians
    sizes: tuple[tuple[int, int], ...] = ((640, 512), (320, 256))  # px
    runs: int = 31  # per median
    twin: bool = True  # also time the torch twins
    rhythm: bool = True  # also time at the pace of a camera
    contention: bool = False  # also time beside another process that burns a core


QUICK = Settings(counts=(500,), sizes=((64, 64),), runs=3, twin=False)
TABLES = (
    "threads operations_per_s",
    "n width height scene active_tiles sh_degree threads forward_ms share_of_peak twin_forward_backward_ms"
    " speedup_over_twin forward_backward_ms",
    "n width height scene active_tiles sh_degree threads stage ms share_of_peak pairs_per_s bound",
    "n width height p90 p50",
)


def measure_kernels(settings: Settings, advance: Advance) -> dict[str, Any]:
    """Measure everything that `settings` ask for; keys as benchmarks/README.md lists them.

    Uses all cores of the process, and leaves the calling thread set to them.
    """
    every = configure_threads(None)
    peaks = {threads: measure_peak(threads) for threads in sorted({1, min(2, every), every})}
    table: dict[str, Any] = {
        "machine": machine_name(),
        "threads": every,
        "settings": asdict(settings),
        "peaks": [peak_row(peak) for peak in peaks.values()],
    }
    jobs = list(_jobs(settings, peaks))
    for done, job in enumerate(jobs):
        advance(done, len(jobs), job.what)
        configure_threads(job.threads)
        table.setdefault(job.section, []).append(job.measure())
    configure_threads(None)
    return table


@dataclass(frozen=True, slots=True)
class _Job:
    """One row of a section of the table."""

    section: str
    what: str
    threads: int
    measure: Callable[[], dict[str, Any]]


def _jobs(settings: Settings, peaks: Mapping[int, Peak]) -> Iterator[_Job]:
    every, runs = max(peaks), settings.runs
    few, peak = settings.counts[0], peaks[every]
    twin_runs = 1 if settings.twin else 0
    for case in raster_cases(settings, sorted(peaks)):
        plain = case == RasterCase(few, case.width, case.height, every)
        # with more Gaussians the twin would take tens of GB
        measure = partial(measure_rasterizer, case, runs, peaks[case.threads], twin_runs if plain else 0)
        yield _Job("rasterize", f"rasteriser, {case.count} Gaussians", case.threads, measure)
    for width, height in settings.sizes:
        measure = partial(measure_losses, few, width, height, every, runs, peak)
        yield _Job("losses", f"losses, {width}x{height}", every, measure)
    tables = [(count, count, GAUSSIAN_COLUMNS) for count in settings.counts[:2]]
    for count, of, columns in [*tables, (4 * few, 12 * few, CELL_COLUMNS)]:
        measure = partial(measure_adam, count, of, columns, every, runs, peak)
        yield _Job("adam", f"Adam, {count} rows of {columns}", every, measure)
    first = RasterCase(few, *settings.sizes[0], every)
    if settings.rhythm:
        yield _Job("rhythm", "in a camera's rhythm", every, partial(measure_rhythm, first, runs))
    if settings.contention:
        yield _Job("contention", "beside a busy process", every, partial(measure_contention, first, runs))


def raster_cases(settings: Settings, thread_counts: list[int]) -> Iterator[RasterCase]:
    """Yield every count at every size; then the second count at the first size with one change at a time."""
    every = thread_counts[-1]
    for width, height in settings.sizes:
        for count in settings.counts:
            yield RasterCase(count, width, height, every)
    second = RasterCase(settings.counts[:2][-1], *settings.sizes[0], every)
    for threads in thread_counts[:-1]:
        yield replace(second, threads=threads)
    for scene in ("corner", "shuffled"):
        yield replace(second, scene=scene)
    yield replace(second, sh_degree=3)
    for share in ACTIVE_SHARES:
        yield replace(second, active_tiles=share)


def measure_adam(count: int, of: int, columns: int, threads: int, runs: int, peak: Peak) -> dict[str, Any]:
    """Measure one row of the table: Adam on `count` rows, spread at random, of a table [of, columns]. The
    calling thread must be set to `threads`, the threads of `peak`."""
    rng = np.random.default_rng(0)
    values, gradients = (rng.normal(size=(of, columns)).astype(np.float32) for _ in range(2))
    state, rates = AdamState.new(of, columns), np.full(columns, 1e-3, np.float32)
    rows = None if count == of else np.sort(rng.permutation(of)[:count])
    ms = median_ms(lambda: adam_step(values, gradients, state, rates, rows=rows), runs)
    work = {"step": Work(4 * ADAM_FLOATS * count * columns, ADAM_OPERATIONS * count * columns)}
    return {
        "n": count,
        "of": of,
        "columns": columns,
        "threads": threads,
        "step_ms": ms,
        "share_of_peak": share_of_peak(ms, work, peak),
        "stages": stage_rows({"step": ms}, work, peak),
    }


def measure_losses(
    count: int, width: int, height: int, threads: int, runs: int, peak: Peak
) -> dict[str, Any]:
    """Measure one row of the table: losses of a drawn surface against a darker image of itself. The calling
    thread must be set to `threads`, the threads of `peak`."""
    gaussians, camera = surface(count, width, height)
    planes = make_rasterizer("numba", width, height).forward(gaussians, camera)
    view = views.to_view(planes, camera, 0, 0)
    image = (0.9 * 255 * views.colours_of(planes)).astype(np.uint8)
    tissue = np.ones((height, width), np.bool_)
    v_planes, weight = np.empty_like(planes), np.empty_like(view.depth)

    def tissue_loss() -> None:
        losses.tissue_loss(planes, image, tissue, view.depth, v_planes, weight, DEPTH_WEIGHT, DEPTH_SCALE)

    times = {
        "tissue loss": median_ms(tissue_loss, runs),
        "view": median_ms(lambda: views.to_view(planes, camera, 0, 0), runs),
    }
    work = {
        "tissue loss": Work(bytes_of(planes, image, tissue, view.depth, v_planes, weight)),
        "view": Work(bytes_of(planes, view.rgb, view.depth, view.alpha)),
    }
    return {
        "width": width,
        "height": height,
        "threads": threads,
        "tissue_loss_ms": times["tissue loss"],
        "view_ms": times["view"],
        "share_of_peak": share_of_peak(sum(times.values()), work, peak),
        "stages": stage_rows(times, work, peak),
    }
