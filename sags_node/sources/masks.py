"""Finds out which values of a recording's masks are instruments, and which are tissue."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.config.schema import Instruments
from sags_node.errors import UsageError
from sags_node.types import U8, Bool

HALF = 128  # grey level from which on a value is white
MOST = 0.5  # share of an image that instruments cover at most
AREAS = 0.25  # share of in-between pixels with equal neighbours: in soft edges it is smaller
LOSSY = (".jpg", ".jpeg", ".webp")
NEAR = 8  # grey levels by which lossy files change a value
ENDS = 16  # grey levels: this near to white is white; in lossy files, this near to black is black
LABELS = 30  # if labels are smaller, a 255 beside them marks unlabelled pixels
SMALLEST_AREA = 1e-4  # share of a coloured mask from which on a colour counts
SHOWN = 12  # values in a message
_BETWEEN = np.array([0, *[1] * 254, 0], np.uint8)
# https://endovissub2018-roboticscenesegmentation.grand-challenge.org: instruments, threads and clamps; tissue
ENDOVIS = ("#00ff00", "#00ffff", "#7dff0c", "#bb9b19", "#00ff7d", "#ffff7d", "#7b0faf", "#0cff8d")
ENDOVIS_TISSUE = ("#000000", "#ff3700", "#18377d", "#7c9b05")


class Masks:
    """Finds the tissue in masks as OpenCV reads them: grey [H, W], or BGR(A) [H, W, C].

    One dark and one bright value are understood, and so are the colours of EndoVis 2018. All other masks need
    `instruments`: it lists the values that are instruments; the others are tissue. Values at soft edges,
    between areas, do not count.

    Attributes:
        oddities: warnings about the masks, each with a remedy after a semicolon.

    Args:
        some: masks spread over the recording.

    Raises:
        UsageError: the values are ambiguous, or instruments would cover most of the image.
    """

    def __init__(
        self, folder: Path, some: Iterable[tuple[Path, NDArray[Any]]], instruments: Instruments = "white"
    ) -> None:
        self._instruments = instruments
        listed = [] if isinstance(instruments, str) else [*map(_colour_of, instruments)]
        # A listed grey such as #ffffff counts as a grey value, too: masks without colour are read as grey.
        self._greys = [int(name[1:3], 16) for name in listed if 3 * name[1:3] == name[1:]]
        self._colours = [] if all(isinstance(value, int) for value in instruments) else listed
        self._values: set[int] = set()
        looked_at = [(file, _eight_bits(mask, file)) for file, mask in some]
        # An opaque mask of one colour is ambiguous. Others tell whether the alpha channel holds the mask.
        self._is_alpha = any(_shows_in_alpha(mask) for _, mask in looked_at)
        shares = [float(np.mean(~self.tissue(mask, file))) for file, mask in looked_at]
        share = float(np.median(shares))
        self.oddities: list[str] = []
        if not any(shares):
            self.oddities.append(
                f"{folder}: none of {len(shares)} masks that were looked at marks an instrument; leave masks "
                "out, and tissue is found by colour (docs/networks.md)"
            )
        if share > MOST and isinstance(instruments, str):
            other = "black" if instruments == "white" else "white"
            raise UsageError(
                f"{folder} would take {share:.0%} of the image for instruments (polarity the other "
                f"way?); if {instruments} means tissue there, set source.instruments:={other}"
            )

    def tissue(self, mask: NDArray[Any], file: Path) -> Bool:
        """Return the tissue mask [H, W]: True where there is no instrument.

        Raises:
            UsageError: the values, together with those of earlier masks, are ambiguous.
        """
        lossy = file.suffix.lower() in LOSSY
        mask = _eight_bits(mask, file)
        self._is_alpha = self._is_alpha or _shows_in_alpha(mask)
        is_alpha = self._is_alpha and _is_of_one_colour(mask)
        grey = mask[..., 3] if is_alpha else _as_grey(mask, NEAR * lossy)
        if grey.ndim == 3:
            return self._of_colours(grey, file)
        if not isinstance(self._instruments, str):
            away = np.abs(np.arange(256)[:, None] - np.array(self._greys)).min(axis=1, initial=256)
            tissue: Bool = (away > NEAR * lossy)[grey]
            return tissue
        self._look(grey, file, lossy)
        tissue = (grey < HALF) == (self._instruments == "white")
        return tissue

    def _look(self, mask: U8, file: Path, lossy: bool) -> None:
        """Check that this mask and those before have at most one dark and one bright value."""
        if cv2.countNonZero(cv2.LUT(mask, _BETWEEN)):
            table = np.arange(256, dtype=np.uint8)
            table[: ENDS * lossy], table[-ENDS:] = 0, 255
            self._values |= _areas(table[mask], NEAR * lossy)
        else:
            self._values |= {int(mask.min()), int(mask.max())}
        dark, bright = ([v for v in self._values if (v >= HALF) == is_bright] for is_bright in (False, True))
        if len(dark) > 1 or len(bright) > 1 or (dark not in ([], [0]) and not bright):
            known = sorted(self._values)
            labels = known[-1] == 255 and 0 < len(known) - 2 and known[-2] < LABELS
            raise _question(file, known, [v for v in known if v and not (labels and v == 255)], labels)

    def _of_colours(self, mask: U8, file: Path) -> Bool:
        """Do as `tissue` for a coloured mask [H, W, 3] BGR."""
        blue, green, red = (plane.astype(np.int32) for plane in cv2.split(mask))
        codes = blue + (green << 8) + (red << 16)
        listed = self._colours
        if not listed:
            found, counts = np.unique(codes[_alike(codes)], return_counts=True)
            there = [f"#{code:06x}" for code in found[counts > SMALLEST_AREA * codes.size]]
            if not there:
                raise UsageError(
                    f"{file} has no area of one colour, so it is no mask; name a folder of masks"
                )
            if not (isinstance(self._instruments, str) and set(there) <= {*ENDOVIS, *ENDOVIS_TISSUE}):
                raise _question(file, there, [name for name in there if name != "#000000"])
            listed = [*ENDOVIS]
        tissue: Bool = np.logical_and.reduce([codes != int(name[1:], 16) for name in listed])
        return tissue


def _colour_of(value: int | str) -> str:
    return "#" + 3 * f"{value:02x}" if isinstance(value, int) else value


def _question(
    file: Path, there: Sequence[int | str], likely: Sequence[int | str], ignore: bool = False
) -> UsageError:
    shown = ", ".join(map(str, there[:SHOWN])) + (", ..." if len(there) > SHOWN else "")
    names = ",".join(f'"{value}"' if isinstance(value, str) else str(value) for value in likely[:SHOWN])
    why = ". 255 beside labels mostly marks what nobody looked at" if ignore else ""
    return UsageError(
        f"{file} holds the values {shown}, which do not tell instruments from tissue; set "
        f"'source.instruments:=[{names}]', or those of them that are instruments{why}"
    )


def _eight_bits(mask: NDArray[Any], file: Path) -> U8:
    if mask.dtype == np.uint16:
        mask = mask >> 8 if mask.max() > 255 else mask
    elif mask.dtype != np.uint8:
        raise UsageError(f"{file} holds {mask.dtype}, which is no mask; save it as PNG of 8 bit")
    return mask.astype(np.uint8)


def _is_of_one_colour(mask: U8) -> bool:
    """Tell whether a mask is [H, W, 4] and of one colour, so that only its alpha can vary."""
    return mask.ndim == 3 and mask.shape[2] == 4 and not np.ptp(mask[..., :3], axis=(0, 1)).any()


def _shows_in_alpha(mask: U8) -> bool:
    return _is_of_one_colour(mask) and bool(mask[..., 3].min() < 255)


def _as_grey(mask: U8, near: int) -> U8:
    """The mask as grey [H, W], or as BGR [H, W, 3] if it has colours."""
    if mask.ndim == 2:
        return mask
    planes: list[U8] = [np.asarray(plane, np.uint8) for plane in cv2.split(mask)]
    spread = max(cv2.absdiff(planes[1], planes[at]).max() for at in (0, 2))
    return mask[..., :3] if spread > near else planes[1]


def _areas(mask: U8, near: int) -> set[int]:
    """The values of a mask's [H, W] areas: the darkest, the brightest and, unless they are soft edges, those
    in between. Values that differ by at most `near` count as one."""
    values, counts = np.unique(mask[_alike(mask)], return_counts=True)
    if not len(values):
        return set()
    inner = (values > values[0]) & (values < values[-1])
    between = np.count_nonzero((mask > values[0]) & (mask < values[-1]))
    if counts[inner].sum() < AREAS * between:
        values = values[~inner]
    groups = np.split(values, np.flatnonzero(np.diff(values.astype(np.int32)) > near) + 1)
    return {int(np.median(group)) for group in groups}


def _alike(values: NDArray[Any]) -> Bool:
    """The pixels [H, W] whose neighbours all have the same value."""
    steps = cv2.morphologyEx(values.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    return np.asarray(steps == 0)
