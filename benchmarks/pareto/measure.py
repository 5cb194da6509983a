"""Run time against error of the online mapper: every setting is played over the same recording.

Time budgets, working sizes and numbers of Gaussians are compared in the mode the node runs in, with a budget
of time. Rules that leave work out are compared with a fixed number of steps, so that only the rule changes.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from benchmarks import Advance
from benchmarks.node.hosts import measure_hosts
from benchmarks.pareto.baselines import baselines_of_run, known_fits, measured_baselines
from benchmarks.pareto.settings import (
    HOSTS,
    RUNG_PART,
    Setting,
    Sweep,
    rung_settings,
    skip_settings,
    time_settings,
)
from sags_node.engine.rasterizer.rasterize import make_rasterizer, to_view
from sags_node.errors import SagsError
from sags_node.pipeline.session import Session, open_session
from sags_node.pipeline.warm_up import warm_up
from sags_node.quality import metrics
from sags_node.sources.source import open_source
from sags_node.tools.evaluation.measure import FrameRow, MeasureOptions, Progress
from sags_node.tools.evaluation.provenance import machine_name
from sags_node.tools.evaluation.run import MappedFrame, Run
from sags_node.tools.evaluation.session import measure
from sags_node.tools.evaluation.steps import run_step
from sags_node.tools.evaluation.summary import summarise
from sags_node.vision.rectify import Rectifier
from sags_node.vision.tissue import TissueMask

SHORTEST = 3  # frames; the first one, in which the model is made, takes another time
KEPT = (
    "frame_ms", "cpu_ms", "stage_ms", "rate_hz", "iterations_per_frame", "online", "predict", "heldout",
    "between", "novel", "right", "depth", "measured_depth", "track", "gaussians", "skipped",
)  # fmt: skip

Row = dict[str, Any]


TABLES = (
    "session why_default",
    "settings: session name frame_ms.p50 frame_ms.p99 cpu_ms.p50 online_at_full_size.psnr predict.psnr"
    " heldout.psnr novel.psnr depth.median_mm depth.coverage track.median_mm gaussians.mean non_dominated",
    "baselines: session frame_ms.p50 predict.psnr heldout.psnr novel.psnr depth.median_mm depth.coverage"
    " name",
    "skips: session on.online.psnr off.online.psnr online_db depth_mm saved_ms rule",
    "hosts: session share_after_first_second first_render_ms frame_ms.p50 latency_ms.p50 latency_ms.p99 size"
    " online_at_full_size.psnr gaussians.mean updates_per_s name",
)


def measure_pareto(
    launches: Sequence[str | None],
    overrides: Sequence[str],
    sweep: Sweep,
    advance: Advance,
) -> Row:
    """Play every setting over every recording and measure it; keys as benchmarks/README.md lists them.

    Args:
        launches: launch files or session folders; None: the built-in phantom.
        overrides: `key:=value`, for all of them.
    """
    sessions = [_Comparison(launch, overrides, sweep, advance).measure() for launch in launches]
    return {
        "machine": machine_name(),
        "overrides": list(overrides),
        "parts": list(sweep.parts),
        "repeat": sweep.repeat,
        "hold_out": sweep.options.hold_out,
        "novel_every": sweep.options.every,
        "psnr_convention": "tissue",
        "sessions": sessions,
    }


def non_dominated(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Tell which (time, quality) points are Pareto-optimal: no other is as good in both and better in one."""
    return [
        not any(ms <= time and quality >= good and (ms, quality) != (time, good) for ms, quality in points)
        for time, good in points
    ]


def why_default(rows: Sequence[Row], period_ms: float) -> str:
    """Say in one sentence what speaks for or against the default among rows of `time_settings`."""
    default = rows[0]
    ms, psnr = _place(default)
    camera = f"the camera's {period_ms:.3g} ms"
    if ms > period_ms:
        return f"{default['name']} is the default, though it takes {ms:.1f} of {camera}"
    best = max((row for row in rows if _place(row)[0] <= period_ms), key=lambda row: _place(row)[1])
    if best is default:
        return f"{default['name']} is the default: the best image of all that stay within {camera}"
    gain = _place(best)[1] - psnr
    return (
        f"{default['name']} is the default and stays within {camera}; so does {best['name']}, {gain:+.2f} dB"
    )


class _Comparison:
    """All settings of one recording."""

    def __init__(self, launch: str | None, overrides: Sequence[str], sweep: Sweep, advance: Advance) -> None:
        self._launch = launch
        self._overrides = (*overrides, "source.loop:=false", "source.pace:=step", "mapping.iterations:=null")
        self._sweep = sweep
        self._advance = advance
        self._session = self._open(())
        self._size = self._session.working_size
        warm_up(self._session.config)

    def measure(self) -> Row:
        session, parts = self._session, self._sweep.parts
        timed = time_settings(session.config, self._size, parts)
        timed += rung_settings() if RUNG_PART in parts else []
        skips = skip_settings() if "skips" in parts else {}
        pairs = [setting for pair in skips.values() for setting in pair]
        runs: dict[Setting, list[Row]] = {setting: [] for setting in (*timed, *pairs)}
        turns = [setting for _ in range(self._sweep.repeat) for setting in runs]
        baselines: list[Row] = []
        compared: Row = {}
        for place, setting in enumerate(turns, 1):
            progress = self._progress(f"{setting.name} ({place} of {len(turns)})")
            with self._played(setting, progress) as (played, run):
                row, receipt = self._measured(setting, played, run, progress)
                runs[setting].append(row)
                if place == 1:  # the default
                    compared = receipt
                    baselines = baselines_of_run(runs[setting][0])
                    baselines += measured_baselines(played, run, self._size, self._sweep.options, progress)
        baselines += known_fits(session.name)
        rows = [_middle(runs[setting]) for setting in timed]
        for row, best in zip(rows, non_dominated([_place(row) for row in rows]), strict=True):
            row["non_dominated"] = best
        with session.source as source:
            rate, frames = source.rate, source.frame_count
        return {
            "session": session.name,
            "frames": frames,
            "rate_hz": rate,
            "receipt": compared,  # of the default; the others play the same frames
            "segments": {name: list(span) for name, span in session.config.played_segments.items()},
            "why_default": why_default(rows, 1e3 / rate),
            "settings": rows,
            "baselines": baselines,
            "skips": [
                {"rule": rule, **_effect(_middle(runs[on]), _middle(runs[off]))}
                for rule, (on, off) in skips.items()
            ],
            "hosts": self._hosts() if HOSTS in parts else [],
        }

    def _hosts(self) -> list[Row]:
        return measure_hosts(self._launch, self._overrides, lambda what: self._progress(what)("", 0))

    @contextmanager
    def _played(self, setting: Setting, progress: Progress) -> Iterator[tuple[Session, Run]]:
        session = self._open(setting.overrides)
        with Run() as run:
            run_step(session, self._sweep.options, run, progress, setting.skips)
            if len(run) < SHORTEST:
                raise SagsError(
                    f"{session.name}: {len(run)} frames were processed and {SHORTEST} are needed to tell "
                    "a time; play more (--frames, source.frames, source.start)"
                )
            yield session, run

    def _measured(self, setting: Setting, session: Session, run: Run, progress: Progress) -> tuple[Row, Row]:
        """The setting's row, and its receipt."""
        found = measure(session, run, self._sweep.options, setting.overrides, progress)
        summary = found.summary
        at_full_size = summary["online"]
        if session.working_size != self._size:
            at_full_size = online_at(self._size, session, run, self._sweep.options, progress)
        if at_full_size["psnr"] is None:
            raise SagsError(
                f"{session.name}: no frame shows tissue, so there is nothing to compare; see vision.tissue"
            )
        row = {
            "name": setting.name,
            "part": setting.part,
            "overrides": list(setting.overrides),
            **{key: summary[key] for key in KEPT},
            "online_at_full_size": at_full_size,
        }
        return row, found.receipt

    def _open(self, overrides: Sequence[str]) -> Session:
        def rendering(done: int, of: int) -> None:
            self._advance(done, of, "rendering the phantom (once)")

        return open_session(self._launch, (*self._overrides, *overrides), rendering)

    def _progress(self, what: str) -> Progress:
        name, count = self._session.name, self._session.source.frame_count
        return lambda doing, done: self._advance(done, count, f"{name}, {what}: {doing}")


def _place(row: Row) -> tuple[float, float]:
    """Where a setting lies: ms of the median frame, and PSNR (dB) of what it shows, at the default's size."""
    return row["frame_ms"]["p50"], row["online_at_full_size"]["psnr"]


def _middle(runs: Sequence[Row]) -> Row:
    """The run whose time is in the middle (the faster of two), with the spread of all."""
    places = [_place(run) for run in runs]
    middle = sorted(runs, key=lambda run: _place(run)[0])[(len(runs) - 1) // 2]
    return middle | {"repeats": {"ms": [ms for ms, _ in places], "psnr": [psnr for _, psnr in places]}}


def _effect(on: Row, off: Row) -> Row:
    """What a rule changes: dB of the image, mm of depth error, and the ms of a mean frame that it saves."""

    def change(group: str, key: str) -> float | None:
        before, after = ((run[group] or {}).get(key) for run in (off, on))
        return None if before is None or after is None else round(after - before, 4)

    return {
        "online_db": change("online", "psnr"),
        "depth_mm": change("depth", "median_mm"),
        "saved_ms": round(1e3 / off["rate_hz"] - 1e3 / on["rate_hz"], 3),
        "skipped": on["skipped"],
        "on": on,
        "off": off,
    }


def online_at(
    size: tuple[int, int], session: Session, run: Run, options: MeasureOptions, progress: Progress
) -> dict[str, Any]:
    """Return the figures `online` of a finished run, with its Gaussians drawn at `size` (width, height, px)
    and compared with images of that size.
    """
    config = session.config
    rectifier = Rectifier(session.rig, *size)
    tissue_of = TissueMask(config.vision.tissue, rectifier)
    rasterizer = make_rasterizer("numba", *size)
    rows = []
    with open_source(config.source.model_copy(update={"pace": "step"}), references=False) as frames:
        for frame in frames:
            mapped = run.read(frame.frame_id)
            if not isinstance(mapped, MappedFrame):
                continue
            pair = rectifier(frame)
            planes = rasterizer.forward(mapped.snapshot.gaussians, pair.camera)
            view = to_view(planes, pair.camera, 0, 0)
            shown = metrics.as_float(view.rgb)
            quality = metrics.psnr(shown, metrics.as_float(pair.left), tissue_of(frame, pair))
            rows.append(FrameRow(frame.frame_id, 0.0, {"online": {"psnr": quality}}))
            progress("measuring at full size", len(rows))
    online: dict[str, Any] = summarise(session.name, rows, options, config.played_segments, None)["online"]
    return online
