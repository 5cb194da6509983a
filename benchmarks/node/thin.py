"""`benchmarks thin`: what thin images cost to make and to read, and what they take of a link."""

import time
from typing import Any

import numpy as np

from benchmarks import Advance
from sags_node.errors import SagsError
from sags_node.kernels.threads import configure_threads
from sags_node.mapping.budget import StepBudget
from sags_node.messaging.thin import decode, thin_pictures
from sags_node.messaging.topics import thin_picture
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.pipeline.session import Session

WARM_UP = 30  # frames, after which the model has its full size
RATE = 30.0  # Hz, for the data rate on a link
NAMES = tuple(
    f"thin/{size}/left/{form}"
    for size in ("full", "half", "quarter")
    for form in (
        *("image_rect_color/jpeg", "render/image/jpeg", "render/image/alpha"),
        *("render/depth/png", "render/depth_confidence/png", "tissue_mask/png"),
    )
)
TABLES = ("topic make_cpu_ms decode_cpu_ms kB Mbit_per_s_at_30_Hz",)


def measure_thin(session: Session, frames: int, advance: Advance) -> list[dict[str, Any]]:
    """Measure a row for each thin image: CPU time to make and to decode it, and its size, mean of `frames`.

    Raises:
        SagsError: the recording is too short.
    """
    configure_threads(session.config.engine.threads)
    pipeline, budget = Pipeline(session.config, session.rig), StepBudget(1)
    asked = {name: {name: thin_picture(name)} for name in NAMES}
    figures: dict[str, list[tuple[float, float, int]]] = {name: [] for name in NAMES}
    with session.source as source:
        for number, frame in enumerate(source):
            result = pipeline.process(frame, budget, FrameRequest(left=True))
            advance(number + 1, WARM_UP + frames, "making")
            if number < WARM_UP or result.held:
                continue
            for name in NAMES:
                began = time.thread_time()
                content = thin_pictures(result, asked[name])[name]
                made = time.thread_time()
                decode(name, content.scale, content.parts[1])
                read = time.thread_time()
                size = sum(memoryview(part).nbytes for part in content.parts)
                figures[name].append((1e3 * (made - began), 1e3 * (read - made), size))
            if number + 1 == WARM_UP + frames:
                break
    if not figures[NAMES[0]]:
        raise SagsError(f"the recording ends before frame {WARM_UP}; choose a longer one")
    return [_row(name, np.array(figures[name])) for name in NAMES]


def _row(name: str, figures: Any) -> dict[str, Any]:
    make_ms, decode_ms, size = figures.mean(axis=0)
    return {
        "topic": name,
        "make_cpu_ms": round(make_ms, 2),
        "decode_cpu_ms": round(decode_ms, 2),
        "kB": round(size * 1e-3, 1),
        "Mbit_per_s_at_30_Hz": round(8 * RATE * size * 1e-6, 1),
    }
