"""What a run at a smaller size shows at the full one: only so do sizes compare."""

from __future__ import annotations

from typing import Any

from sags_node.engine.rasterizer.rasterize import make_rasterizer, to_view
from sags_node.pipeline.session import Session
from sags_node.quality import metrics
from sags_node.sources.source import open_source
from sags_node.tools.evaluation.measure import FrameRow, MeasureOptions, Progress
from sags_node.tools.evaluation.run import MappedFrame, Run
from sags_node.tools.evaluation.summary import summarise
from sags_node.vision.rectify import Rectifier
from sags_node.vision.tissue import TissueMask


def online_at(
    size: tuple[int, int], session: Session, run: Run, options: MeasureOptions, progress: Progress
) -> dict[str, Any]:
    """The figures `online` of a finished run, with its Gaussians drawn at `size` (width, height, px) and
    compared with pictures of that size.

    Raises:
        SagsError: the recording cannot be read again.
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
    online: dict[str, Any] = summarise(session.name, rows, options, config.segments, None)["online"]
    return online
