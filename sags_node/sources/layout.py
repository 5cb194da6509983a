"""Turns the images of a device or file into those of the two eyes, as `source.geometry` says."""

from pathlib import Path

import cv2
import numpy as np

from sags_node.config.schema import Box, GeometryConfig
from sags_node.errors import UsageError
from sags_node.types import U8, Bool, Samples, Side

_FLIPS = {"horizontal": 1, "vertical": 0, "both": -1}  # OpenCV's codes
FIELD_ROWS = {"top": 0, "bottom": 1}
# How many eyes an image shows (side by side, one above the other); (1, 1) in other layouts.
EYES = {"side_by_side": (2, 1), "over_under": (1, 2), "row_interleaved": (1, 2)}
WIDEST = 2.2  # width over height of one eye's image; the widest usual one is 1.9 (17:9)


class Layout:
    """Splits an image into both eyes, then keeps one field, crops and flips each eye, and makes it 8 bit.

    Args:
        config: `source.geometry`.
        tools: box of a third pane, as large as those of the eyes.
    """

    def __init__(self, config: GeometryConfig, tools: Box | None = None) -> None:
        self._config = config
        self._crops = {"left": config.crop, "right": config.crop_right or config.crop}
        self._tools = tools
        self.is_sequential = config.layout == "frame_sequential"
        self.shows_both = config.layout not in ("separate", "frame_sequential")
        self.takes_fields = config.layout == "row_interleaved" or config.deinterlace != "none"
        self.order: tuple[Side, Side] = ("right", "left") if config.first == "right" else ("left", "right")

    def size(self, width: int, height: int, name: str) -> tuple[int, int]:
        """Return width and height of an eye's image (px), given those of the images that `name` delivers.

        Raises:
            UsageError: it cannot be split or cropped as asked.
        """
        layout = self._config.layout
        beside, above = EYES.get(layout, (1, 1))
        if width % beside:
            raise UsageError(f"{name} is {width} px wide, which is odd: it cannot hold two eyes side by side")
        if height % above:
            raise UsageError(f"{name} is {height} px high, which is odd: it cannot hold two eyes, {layout}")
        width, height = width // beside, height // above
        sizes = [_cropped(width, height, crop, name) for crop in self._crops.values()]
        if sizes[0] != sizes[1]:
            raise UsageError(
                f"source.geometry.crop is {sizes[0][0]}x{sizes[0][1]} px but crop_right "
                f"{sizes[1][0]}x{sizes[1][1]}; both eyes need one size"
            )
        if self._tools is not None and _cropped(width, height, self._tools, name) != sizes[0]:
            raise UsageError(
                f"source.tools is {self._tools[2]}x{self._tools[3]} px but source.geometry.crop "
                f"{sizes[0][0]}x{sizes[0][1]}; all panes need one size"
            )
        return sizes[0]

    def pixel_aspect(self, width: int, height: int, told: float) -> float:
        """Return the width of an eye's pixel over its height.

        A file may say that its pixels are square although its eyes were squeezed to fit beside or above each
        other. Then an eye is narrower than high, or more than 2.2 times as wide.

        Args:
            width, height: of the delivered images, px.
            told: the pixel aspect that the file gives.
        """
        match self._config.layout:
            case "row_interleaved":
                return 0.5 * told
            case "side_by_side" if told == 1 and width // 2 < height:
                return 2.0
            case "over_under" if told == 1 and width > WIDEST * (height // 2):
                return 0.5
            case _:
                return told

    def eye(self, picture: Samples, side: Side) -> U8:
        """Return one eye's image [H, W, 3]; the argument itself if there is nothing to do."""
        return self._finish(picture, 0, self._crops[side])

    def tissue(self, picture: Samples, left: U8) -> Bool | None:
        """Return the tissue mask [H, W]: True where the tools' pane shows no paint. None: no such pane."""
        if self._tools is None:
            return None
        from sags_node.sources.pixels import unpainted  # a kernel; other videos do not need it loaded

        return unpainted(self._finish(picture, 0, self._tools), left)

    def eyes(self, picture: Samples) -> tuple[U8, U8]:
        """Return the left and the right eye of an image [H, W, 3] that shows both; views if possible."""
        of = dict(zip(self.order, self._apart(picture), strict=True))
        left, right = (self._finish(*of[side], self._crops[side]) for side in ("left", "right"))
        return left, right

    def in_turn(self, first: Samples, second: Samples) -> tuple[U8, U8]:
        """Return the left and the right eye of two successive images [H, W, 3] that show one eye each."""
        of = dict(zip(self.order, (first, second), strict=True))
        return self.eye(of["left"], "left"), self.eye(of["right"], "right")

    def _apart(self, picture: Samples) -> tuple[tuple[Samples, int], tuple[Samples, int]]:
        """The first and the second eye as views, each with the row of the image in which it begins."""
        height, width = picture.shape[:2]
        match self._config.layout:
            case "side_by_side":
                return (picture[:, : width // 2], 0), (picture[:, width // 2 :], 0)
            case "over_under":
                return (picture[: height // 2], 0), (picture[height // 2 :], height // 2)
            case "panes":
                return (picture, 0), (picture, 0)
            case _:
                return (picture[0::2], 0), (picture[1::2], 1)

    def _finish(self, picture: Samples, row: int, crop: Box | None) -> U8:
        flip, keep = self._config.flip, self._config.deinterlace
        if keep != "none":
            picture = _one_field(picture, (FIELD_ROWS[keep] - row) % 2)
        if crop is not None:
            x, y, w, h = crop
            picture = picture[y : y + h, x : x + w]
        if flip != "none":
            picture = cv2.flip(picture, _FLIPS[flip])
        return self._eight_bits(picture)

    def _eight_bits(self, picture: Samples) -> U8:
        if picture.dtype == np.uint8 and self._config.levels == (0.0, 1.0):
            return np.ascontiguousarray(picture, np.uint8)
        from sags_node.sources.pixels import spread  # a kernel; other images do not need it loaded

        return spread(picture, self._config.levels)


def refuse_turned(geometry: GeometryConfig, where: Path | str) -> None:
    """Refuse a calibration that comes with the images if they are flipped: it holds before the flip only.

    Raises:
        UsageError: they are flipped; the error begins with `where`.
    """
    if geometry.flip != "none":
        raise UsageError(
            f"{where}: camera_info is of images as they come, and source.geometry.flip: {geometry.flip} "
            "turns them: leave flip out, or calibrate with the turned images and set rig"
        )


def _cropped(width: int, height: int, crop: Box | None, name: str) -> tuple[int, int]:
    if crop is None:
        return width, height
    x, y, w, h = crop
    if x + w > width or y + h > height:
        raise UsageError(
            f"source.geometry: the box {list(crop)} (x, y, width, height) leaves the image: an eye "
            f"of {name} is {width}x{height} px"
        )
    return w, h


def _one_field(picture: Samples, first_row: int) -> Samples:
    """Deinterlace: keep every other row, and replace the rest by the mean of the rows above and below."""
    field = picture[first_row::2]
    whole = np.empty_like(picture)
    whole[first_row::2] = field
    between = whole[1 - first_row :: 2]
    inside = cv2.addWeighted(field[:-1], 0.5, field[1:], 0.5, 0.0)
    before = 1 if first_row else 0  # missing rows above the first row of the field
    between[before : before + len(inside)] = inside
    if first_row:
        between[0] = field[0]
    if len(between) > before + len(inside):
        between[-1] = field[-1]
    return whole
