"""How accurate the reported strain of a pulled surface is: on the phantom, whose strain is known."""

from typing import Any

import numpy as np

from benchmarks import Advance
from benchmarks.quality.depth import frame_of, rounded, spread
from sags_node.config.schema import LaunchConfig
from sags_node.mapping.budget import StepBudget
from sags_node.messaging.content import STRAIN_FIELDS, points
from sags_node.phantom.rig import phantom_rig
from sags_node.phantom.scene import Phantom, PhantomScene
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.warm_up import prepare
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import F32, F64, I64

SIZE = (640, 512)
SECONDS, RATE, STEPS = 4.0, 15.0, 2  # of one pull; frames a second; steps of the mapper, each frame
SINCE, EVERY = 10, 3  # frame before the pull, to which strain refers; one of so many frames is measured
STRAINED = 0.05  # strain from which on points are counted apart
PULLED, BACK = 0.75, 0.8  # shares of the session: "all" ends; the tissue is back where it was
ACROSS = 4  # vertices to each side of one, over which its true strain is taken: about 2 mm
NEAR = 0.002  # m, largest distance from a point to the surface


TABLES = ("known true_p90 error.median error.p90 bias zero.median zero.p90",)


def measure_strain(seeds: int, advance: Advance) -> dict[str, Any]:
    """Measure the strain in each message of `points` while the tissue is pulled, and once it is back."""
    config = LaunchConfig(source=PhantomScene(width=SIZE[0], height=SIZE[1]))
    prepare(config)
    told, true, back, count = [], [], [], round(SECONDS * RATE)
    receipt = Receipt(phantom_rig(*SIZE), SIZE, None)
    for seed in range(seeds):
        phantom = Phantom(PhantomScene(seconds=SECONDS, width=SIZE[0], height=SIZE[1], seed=seed))
        pipeline = Pipeline(config, phantom.rig, rate=RATE)
        before = phantom.tissue.vertices(SINCE / count)
        for number in range(count):
            advance(number, count, f"seed {seed}")
            frame = frame_of(number, RATE, phantom.frame(number, count))
            result = pipeline.process(frame, StepBudget(STEPS))
            receipt.add(frame, result.observation.tissue)
            if number == SINCE:
                pipeline.start_strain()
            if number <= SINCE or number % EVERY or PULLED * count <= number < BACK * count:
                continue
            body = points(result)
            names = body.encoding.split(",")
            rows = np.frombuffer(body.parts[1], np.float32).reshape(-1, len(names))
            now = phantom.tissue.vertices(number / count)
            vertex, off = _nearest(now.reshape(-1, 3), rows[:, :3])
            on = off <= NEAR
            told.append(rows[on][:, [names.index(name) for name in STRAIN_FIELDS[:2]]])
            true.append(true_strain(before, now).reshape(-1, 2)[vertex[on]])
            back.append(np.full(np.count_nonzero(on), number >= BACK * count))
    found, exact = np.concatenate(told), np.concatenate(true)
    rest = np.concatenate(back)
    parts = {"all": ~rest, "strained": ~rest & (np.abs(exact).max(1) >= STRAINED), "back": rest}
    return {
        "points": len(exact),
        **{name: _summary(found[which], exact[which]) for name, which in parts.items()},
        "receipts": {"phantom": receipt.as_json()},
    }


def _nearest(vertices: F32, places: F32) -> tuple[I64, F32]:
    """The vertex [N] nearest to each place [N, 3], and its distance [N] (m)."""
    from open3d.core import Tensor
    from open3d.core.nns import NearestNeighborSearch

    search = NearestNeighborSearch(Tensor(np.ascontiguousarray(vertices)))
    search.knn_index()
    found, squared = search.knn_search(Tensor(np.ascontiguousarray(places)), 1)
    return found.numpy()[:, 0], np.sqrt(squared.numpy()[:, 0])


def true_strain(before: F32, now: F32) -> F64:
    """Return the largest and smallest principal strain [rows, cols, 2] at the vertices of a grid
    [rows, cols, 3], by central differences along its rows and columns; NaN at its edges."""
    metrics, inner = [], slice(ACROSS, -ACROSS)
    for vertices in (before.astype(np.float64), now.astype(np.float64)):
        down = (vertices[2 * ACROSS :] - vertices[: -2 * ACROSS])[:, inner]
        along = (vertices[:, 2 * ACROSS :] - vertices[:, : -2 * ACROSS])[inner]
        D = np.stack([down, along], -1)
        metrics.append(np.swapaxes(D, -1, -2) @ D)
    C = np.linalg.solve(*metrics)
    half, det = 0.5 * (C[..., 0, 0] + C[..., 1, 1]), np.linalg.det(C)
    apart = np.sqrt(np.maximum(half**2 - det, 0))
    strain = np.full((*now.shape[:2], 2), np.nan)
    strain[inner, inner] = np.sqrt(np.maximum(np.stack([half + apart, half - apart], -1), 0)) - 1
    return strain


def _summary(found: F32, exact: F64) -> dict[str, Any]:
    said: dict[str, Any] = {}
    for column, name in enumerate(STRAIN_FIELDS[:2]):
        truth, told = exact[:, column], found[:, column]
        known = np.isfinite(told) & np.isfinite(truth)
        errors, nothing = np.abs(told - truth)[known], np.abs(truth)[known]
        said[name] = {
            "known": rounded(known.sum() / max(1, np.isfinite(truth).sum())),
            "true_p90": rounded(np.quantile(np.abs(truth[np.isfinite(truth)]), 0.9)),
            "error": {**spread(errors), "p99": rounded(np.quantile(errors, 0.99))},
            "bias": rounded(np.median((told - truth)[known])),
            "zero": spread(nothing),
        }
    return said
