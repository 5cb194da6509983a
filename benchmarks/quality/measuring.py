"""How accurately lengths and areas between anchors are measured, and whether the stated errors are true.

The phantom's tissue is pulled. Anchors are pinned at pixels of true points that its first frame shows.
"""

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks import Advance
from benchmarks.quality.depth import rounded
from benchmarks.quality.tracking import middle, pin, true_points
from sags_node.errors import SagsError
from sags_node.geometry import project
from sags_node.mapping.budget import StepBudget
from sags_node.messaging import cdr
from sags_node.messaging.content import FRAME_CONTENT
from sags_node.messaging.measure import MEASURING, Measured, area_of, length_of, measure
from sags_node.messaging.received import Frame, interpret
from sags_node.messaging.wire import Message, Meta
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session, open_posed
from sags_node.pipeline.warm_up import prepare
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import F64, Bool, FrameResult

EVERY = 5  # frames between two that are measured
STEPS = 2  # of the mapper, each frame
CORNERS = {"distance": 2, "path": 4, "area": 3}
SHAPES = 60  # of each kind, between anchors drawn at random
CHANGED = 0.05  # change as a share of the first true value


@dataclass(frozen=True, slots=True)
class _Tally:
    """All values of one kind, in all frames that were measured; mm, or mm2 for an area."""

    errors: list[float] = field(default_factory=list)  # of values that were sure
    told: list[float] = field(default_factory=list)  # their stated errors
    kept: list[float] = field(default_factory=list)  # errors if the first measured value is kept
    changed: list[bool] = field(default_factory=list)  # the true value has changed by more than `CHANGED`
    stretch: list[tuple[float, float]] = field(default_factory=list)  # its error and its stated error
    unsure: list[float] = field(default_factory=list)  # errors of values that were not sure


TABLES = (
    "anchors values told.p50 told.p90 within_told kept.p50 kept.p90 stretch_error.p50 stretch_within_told"
    " error.p50 error.p90",
)


def measure_lengths(session: Session, advance: Advance, seed: int = 0) -> dict[str, Any]:
    """Measure between anchors of a recording that has true points."""
    prepare(session.config)
    pipeline, budget = Pipeline(session.config, session.rig), StepBudget(STEPS)
    receipt = Receipt(session.rig, session.working_size, None)
    tallies: dict[str, _Tally] = defaultdict(_Tally)
    shapes: list[tuple[str, list[int]]] = []
    rows = firsts = first = None
    with open_posed(session.config, session.rig) as source:
        for number, frame in enumerate(source):
            result = pipeline.process(frame, budget)
            truth = true_points(frame, result)
            if truth is None or frame.reference is None or frame.reference.points_visible is None:
                raise SagsError(f"{session.name} has no true points; a session of the phantom has")
            if rows is None:
                places = np.asarray(project(result.pair.camera, truth)[0], np.float64)
                wanted = np.flatnonzero(frame.reference.points_visible & middle(places, result))
                rows = [*pin(pipeline, result, places, wanted).values()]
                shapes = _shapes(len(rows), seed)
            elif number % EVERY == 0:
                receipt.add(frame, result.observation.tissue)
                found = _values(result, shapes)
                exact = [
                    (area_of if kind == "area" else length_of)(truth[rows][np.array(corners) - 1])
                    for kind, corners in shapes
                ]
                first, firsts = first or exact, firsts or found
                rest = zip(shapes, found, exact, firsts, first, strict=True)
                for (kind, _), now, true, before, truly in rest:
                    _add(tallies[kind], 1e6 if kind == "area" else 1e3, now, true, before, truly)
            advance(number + 1, source.frame_count, "measuring")
    anchors = 0 if rows is None else len(rows)
    figures = {kind: _figures(tally) for kind, tally in tallies.items()}
    return {"session": session.name, "anchors": anchors, **figures, "receipt": receipt.as_json()}


def _shapes(anchors: int, seed: int) -> list[tuple[str, list[int]]]:
    """Random shapes: the kind of value, and the numbers of its anchors, which begin with 1."""
    rng = np.random.default_rng(seed)
    draws = ((kind, corners) for kind, corners in CORNERS.items() for _ in range(SHAPES))
    return [(kind, (1 + rng.choice(anchors, corners, replace=False)).tolist()) for kind, corners in draws]


def _values(result: FrameResult, shapes: list[tuple[str, list[int]]]) -> list[Measured]:
    """The values of all shapes, as a client reads them from the messages of a frame."""
    frame = Frame()
    for name in MEASURING:
        body = FRAME_CONTENT[name](result)
        meta = Meta(
            type=body.type, type_hash=cdr.type_hash(body.type), seq=1, frame_id=result.pair.frame_id,
            stamp_ns=result.pair.t_capture_ns, publish_ns=0, session="", epoch=0, step=0,
            encoding=body.encoding, shape=list(body.shape), dtype=body.dtype, dropped=0,
        )  # fmt: skip
        frame[name] = interpret(Message(name, meta, body.parts), 0)
    return [measure(frame, corners, kind == "area") for kind, corners in shapes]


def _add(tally: _Tally, unit: float, found: Measured, exact: float, first: Measured, before: float) -> None:
    """Add a value and the true one, given both as they were in the first frame that was measured."""
    if found.value is None:
        return
    off = unit * abs(found.value - exact)
    if found.unsure is not None or found.error is None:
        tally.unsure.append(off)
        return
    stretch = found.stretch(first)
    if stretch is None or first.value is None or first.unsure is not None:
        return  # without a first value that was sure there is nothing to keep
    tally.errors.append(off)
    tally.told.append(unit * found.error)
    tally.kept.append(unit * abs(first.value - exact))
    tally.changed.append(abs(exact / before - 1) > CHANGED)
    tally.stretch.append((abs(stretch[0] - exact / before), stretch[1]))


def _figures(tally: _Tally) -> dict[str, Any]:
    """Figures of values that were sure, of those of them that have changed, and of unsure ones."""
    changed = np.array(tally.changed, np.bool_)
    return {
        "all": _compared(tally, np.ones(len(changed), np.bool_)),
        "changed": _compared(tally, changed),
        "unsure": {"values": len(tally.unsure), "error": _spread(np.array(tally.unsure))},
    }


def _compared(tally: _Tally, rows: Bool) -> dict[str, Any]:
    errors, told, kept = (np.array(values)[rows] for values in (tally.errors, tally.told, tally.kept))
    stretch, of_stretch = np.array(tally.stretch).reshape(-1, 2)[rows].T
    return {
        "values": len(errors),
        "error": _spread(errors),
        "told": _spread(told),
        "within_told": rounded(np.mean(errors <= told)) if len(errors) else None,
        "kept": _spread(kept),
        "stretch_error": _spread(stretch),
        "stretch_within_told": rounded(np.mean(stretch <= of_stretch)) if len(errors) else None,
    }


def _spread(values: F64) -> dict[str, float] | None:
    if not len(values):
        return None
    return {"p50": rounded(np.median(values)), "p90": rounded(np.percentile(values, 90))}
