"""A frame that lends its image to other moments and other cameras."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

from sags_node.geometry import project
from sags_node.resizing import resized_image
from sags_node.types import F32, I64, U8, Bool, Camera, Gaussians, Shown

MARGIN = np.ones((5, 5), np.uint8)  # px of the working size around a pixel that must all be tissue
SAME = 0.04  # of the depth: two depths that differ by less are of one surface
FINER = 2  # px of the working size between the places where the error of the model's depth is sampled
AROUND = (5, 5)  # such places: the window over which that error is averaged


@dataclass(frozen=True)
class MatchedDepth:
    """What stereo measured in a frame, and what the model had there."""

    drawn: F32  # [h, w] m, 0 unknown
    measured: F32  # [h, w] m, 0 unknown

    @cached_property
    def finer(self) -> F32:
        """[h / FINER, w / FINER] the measured depth over the drawn one, averaged over `AROUND`."""
        height, width = self.drawn.shape
        size = -(-width // FINER), -(-height // FINER)
        drawn, measured = (
            cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST) for depth in (self.drawn, self.measured)
        )
        error = measured - drawn
        known = ((drawn > 0) & (measured > 0) & (np.abs(error) < np.float32(SAME) * drawn)).astype(np.float32)
        part = np.divide(error * known, drawn, out=np.zeros_like(drawn), where=drawn > 0)
        part, around = cv2.blur(part, AROUND), cv2.blur(known, AROUND)
        return np.asarray(1 + np.divide(part, around, out=np.zeros_like(part), where=around > 0))


@dataclass(frozen=True)
class SeenFrame:
    """A mapped frame, with what is needed to carry its image to other views."""

    t_capture_ns: int
    camera: Camera  # left eye, working size
    gaussians: Gaussians  # of that moment
    picture: Callable[[], U8]  # [H, W, 3] RGB of the left eye as it is published; made when it is asked for
    mask: Bool  # [h, w] tissue
    depth: F32  # [h, w] m, of the model drawn for it; 0 unknown
    matched: MatchedDepth | None = None  # what stereo measured last, in this frame or a moment before
    whole: Shown | None = None  # its left view as consumers were shown it: lends hidden tissue, too
    _lent: dict[tuple[int, bool], U8] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def tissue(self) -> U8:
        """[h, w] 1: tissue."""
        return self.mask.view(np.uint8)

    @cached_property
    def sure_tissue(self) -> U8:
        """[h, w] 1: tissue, at some distance from instruments (`MARGIN`)."""
        eroded: U8 = cv2.erode(self.tissue, MARGIN, borderType=cv2.BORDER_REPLICATE)
        return eroded

    @cached_property
    def surface(self) -> F32:
        """[h, w] m, the model's depth corrected by what stereo measured; 0 unknown. A small model is flatter
        than the tissue, and seen from the side a millimetre of depth shifts the image by a pixel."""
        if self.matched is None:
            return self.depth
        size = self.depth.shape[::-1]
        finer: F32 = self.depth * cv2.resize(self.matched.finer, size, interpolation=cv2.INTER_LINEAR)
        return finer

    @cached_property
    def pixels(self) -> F32:
        """[N, 2] px where its Gaussians lie in the image; NaN behind the camera."""
        return np.asarray(project(self.camera, self.gaussians.means)[0], np.float32)

    @cached_property
    def shows(self) -> Bool:
        """[N] True: its image shows that Gaussian."""
        z = project(self.camera, self.gaussians.means)[1]
        height, width = self.depth.shape
        inside = np.all((self.pixels > -0.5) & (self.pixels < (width - 0.5, height - 0.5)), axis=1)
        columns, rows = np.rint(np.where(inside[:, None], self.pixels, 0)).astype(np.intp).T
        found: Bool = inside & (self.sure_tissue[rows, columns] > 0)
        found &= np.abs(self.depth[rows, columns] - z) < np.float32(SAME) * z
        return found

    def lent(self, focal_px: float, sure: bool = False) -> U8:
        """Return its image with its tissue mask, [1 + H + 1, 1 + W + 1, 4]: RGB, and 255: tissue. In the
        border of one pixel the edge colours are repeated, and there is no tissue.

        Args:
            focal_px: of the view: the image is shrunk to about the view's resolution.
            sure: tissue beside an instrument does not count.
        """
        picture, tissue = self.picture(), self.sure_tissue if sure else self.tissue
        height, width = picture.shape[:2]
        times = max(1, int(self.camera.K[0, 0] * width / self.camera.width / focal_px + 0.5))
        key = times, sure
        if key not in self._lent:
            tissue = cv2.resize(255 * tissue, (width, height), interpolation=cv2.INTER_NEAREST)
            if self.whole is not None:
                picture = cv2.copyTo(picture, tissue, self.whole.rgb.copy())
                tissue = cv2.compare(self.whole.taken, 0, cv2.CMP_GT)
            if times > 1:
                size = max(2, width // times), max(2, height // times)
                picture = resized_image(picture, size)
                tissue = cv2.resize(tissue, size, interpolation=cv2.INTER_NEAREST)
            packed = cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA)
            packed = cv2.copyMakeBorder(packed, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
            tissue = cv2.copyMakeBorder(tissue, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(0.0,))
            self._lent[key] = np.asarray(cv2.insertChannel(tissue, packed, 3))
        return self._lent[key]

    @property
    def oldest_ns(self) -> int:
        """The capture time of the oldest image that it lends."""
        return self.t_capture_ns if self.whole is None else self.whole.oldest_ns

    def rows_of(self, ids: I64) -> tuple[I64, Bool]:
        """Find the rows [M] of its Gaussians that have these `ids` [M], and which of the ids it has [M]."""
        own = self.gaussians.ids
        if ids is own:
            return np.arange(len(ids)), np.ones(len(ids), np.bool_)
        if not len(own):
            return np.zeros(len(ids), np.int64), np.zeros(len(ids), np.bool_)
        rows = self._by_id[np.minimum(np.searchsorted(own[self._by_id], ids), len(own) - 1)]
        return rows, own[rows] == ids

    @cached_property
    def _by_id(self) -> I64:
        return np.argsort(self.gaussians.ids, kind="stable")
