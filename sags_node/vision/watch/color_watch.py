"""Whether red and blue are exchanged: images that were written as BGR and read as RGB, or the reverse.

Tissue in white light is red. In five recordings of three scopes the red of the median pixel exceeds its blue
by 0.11 to 0.34 of R + G + B; with channels exchanged blue exceeds red by as much. Nothing is held back:
shapes and depth are right, and in blue light (fluorescence) tissue is blue.
"""

import numpy as np

from sags_node.types import U8, Finding
from sags_node.vision.watch.judgement import Evidence, Judgement
from sags_node.vision.watch.palette import Colors
from sags_node.vision.watch.standing import Debounced

ACROSS = 64  # pixels across the image that are looked at
DARK = 0.15  # of full light, mean of R, G and B: below, the camera's black level distorts colours
LEAST_SEEN = 0.1  # of them are neither dark nor clipped: fewer tell nothing
BLUE = 0.08  # of R + G + B: blue over red of the median pixel

EXCHANGED = Finding(
    "red_blue_exchanged",
    "tissue is blue over the whole image: it looks as if red and blue are exchanged; unless the light is "
    "blue, correct what wrote or sends the images (BGR was taken for RGB), or exchange both in the files",
)


class ColorWatch(Debounced):
    """Looks at the left image of every frame."""

    def judge(self, evidence: Evidence, judged: Judgement) -> Judgement:
        """Note whether red and blue are exchanged. Returns `judged`: colours hold nothing back."""
        self.note(evidence.pair.t_capture_ns, [EXCHANGED] if is_blue(evidence.pair.left) else [])
        return judged


def is_blue(picture: U8) -> bool:
    """Tell whether most of an image [H, W, 3] is far bluer than red."""
    step = max(1, picture.shape[1] // ACROSS)
    colors = Colors(picture[::step, ::step], DARK)
    if np.count_nonzero(colors.fair) < LEAST_SEEN * colors.fair.size:
        return False
    red, blue, light = (
        each[colors.fair].astype(np.int32) for each in (colors.red, colors.blue, colors.light)
    )
    return bool(np.median((blue - red) / light) > BLUE)
