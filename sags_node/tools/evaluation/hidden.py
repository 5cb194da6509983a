"""How well hidden tissue is shown: boxes of a recording's images are hidden from the node for a while."""

from collections.abc import Callable

import numpy as np

from sags_node.config.schema import LaunchConfig
from sags_node.messaging import published
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.quality import metrics
from sags_node.sources.source import Source
from sags_node.types import F32, Bool, RectifiedPair, RenderedView, StereoFrame, StereoRig
from sags_node.vision.tissue import TissueMask

PLACES = ((0.3, 0.3), (0.5, 0.65), (0.7, 0.35))  # of width and height: the middles of the boxes
SIZE = (0.19, 0.2)  # of width and height
TIMES = ((0.15, 0.5), (0.35, 2.0))  # when boxes are hidden: from which share of the recording, for how many s


class Curtain(TissueMask):
    """A tissue mask without the boxes of `drawn`, while that is set."""

    drawn: Bool | None = None  # [h, w] the boxes

    def __call__(self, frame: StereoFrame, pair: RectifiedPair, expected: RenderedView | None = None) -> Bool:
        self.whole = super().__call__(frame, pair, expected)
        return self.whole if self.drawn is None else self.whole & ~self.drawn


def measure_hidden(
    config: LaunchConfig, rig: StereoRig, source: Source, frames: int, progress: Callable[[str, int], None]
) -> dict[int, dict[str, float]]:
    """Play a recording with boxes hidden; return the figures of their pixels, as published, by frame number.

    `psnr` of what is shown there, `model_psnr` of the model alone, `copy_psnr` of the last image in which
    they were seen, shown again; dB, each the mean over the boxes.

    Args:
        frames: of the recording, without those of its warm-up: in these nothing is hidden.
    """
    pipeline = Pipeline(config, rig)
    curtain = Curtain(config.vision.tissue, pipeline.rectifier)
    pipeline.tissue = curtain
    camera = pipeline.rectifier.camera
    budget, boxes = pipeline.make_budget(), _boxes(camera.width, camera.height)
    every = np.logical_or.reduce(boxes)
    found: dict[int, dict[str, float]] = {}
    before: F32 | None = None  # the last image that showed the boxes
    number = until = 0
    with source as playing:
        for frame in playing:
            now = frame.t_capture_ns
            for share, seconds in TIMES:
                if not frame.warm_up and number == round(share * frames):
                    until = now + round(seconds * 1e9)
            curtain.drawn = every if now < until else None
            result = pipeline.process(frame, budget, FrameRequest(left=True))
            truth = metrics.as_float(published.picture(result.pair, "left"))
            if curtain.drawn is None:
                before = truth
            elif before is not None and not result.held and (curtain.whole & every).any():
                view, size = result.views["left"], published.size_of(result.pair)
                pictures = {
                    "psnr": metrics.as_float(published.colours(view, size)),
                    "model_psnr": metrics.as_float(view.colours.at(*size)),
                    "copy_psnr": before,
                }
                where = [published.nearest(result.pair, box & curtain.whole) for box in boxes]
                found[frame.frame_id] = {
                    name: float(np.mean([metrics.psnr(picture, truth, box) for box in where if box.any()]))
                    for name, picture in pictures.items()
                }
            number += not frame.warm_up
            progress("hiding tissue", number)
    return found


def _boxes(width: int, height: int) -> list[Bool]:
    boxes = []
    for x, y in PLACES:
        box = np.zeros((height, width), np.bool_)
        rows = slice(round((y - SIZE[1] / 2) * height), round((y + SIZE[1] / 2) * height))
        box[rows, round((x - SIZE[0] / 2) * width) : round((x + SIZE[0] / 2) * width)] = True
        boxes.append(box)
    return boxes
