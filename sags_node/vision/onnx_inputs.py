"""A network's inputs: which pictures they take, of what size, and how a picture becomes one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.config.schema import NetworkFormat, Normalization
from sags_node.errors import UsageError
from sags_node.types import F32, U8
from sags_node.vision.onnx_session import Tensor

Eye = Literal["left", "right"]
Size = tuple[int, int]  # width, height, px
PICTURE_CHANNELS = (1, 3)
PAIR_CHANNELS = (2, 6)  # both eyes in one tensor, left first
CHANNELS = (*PICTURE_CHANNELS, *PAIR_CHANNELS)
GRAY_WEIGHTS = (0.299, 0.587, 0.114)


class Fit(NamedTuple):
    """How a picture is brought to a network's size."""

    inner: Size  # it is resized to this
    outer: Size  # and padded at the right and below to this


@dataclass(frozen=True, slots=True)
class Input:
    """One input of a network."""

    name: str
    eyes: tuple[Eye, ...]  # whose pictures, one after the other in its channels
    channels: int  # of one picture
    channels_first: bool
    dtype: type[np.generic]
    width: int | None  # px; None: any
    height: int | None

    def fit(self, size: Size, multiple: int) -> Fit:
        """A side that the network fixes is resized to it; one that it leaves open is padded."""
        inner = self.width or size[0], self.height or size[1]
        outer = (
            self.width or -(-size[0] // multiple) * multiple,
            self.height or -(-size[1] // multiple) * multiple,
        )
        return Fit(inner, outer)

    def tensor(
        self, pictures: Mapping[Eye, U8], fit: Fit, normalization: Normalization, bgr: bool
    ) -> NDArray[Any]:
        """The network's input [1, C, h, w] or [1, h, w, C] from pictures [H, W, 3] RGB."""
        values = np.concatenate(
            [self._channels(pictures[eye], fit, normalization, bgr) for eye in self.eyes], 2
        )
        if self.channels_first:
            values = values.transpose(2, 0, 1)
        return np.ascontiguousarray(values[None], self.dtype)

    def _channels(self, picture: U8, fit: Fit, normalization: Normalization, bgr: bool) -> U8 | F32:
        shrinks = fit.inner[0] < picture.shape[1] or fit.inner[1] < picture.shape[0]
        fitted = cv2.resize(picture, fit.inner, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        right, below = fit.outer[0] - fit.inner[0], fit.outer[1] - fit.inner[1]
        fitted = cv2.copyMakeBorder(fitted, 0, below, 0, right, cv2.BORDER_REPLICATE)
        mean, std = (
            np.broadcast_to(np.array(part, np.float32), 3) for part in (normalization.mean, normalization.std)
        )
        if self.channels == 1:
            fitted = cv2.cvtColor(fitted, cv2.COLOR_RGB2GRAY)[..., None]
            mean, std = (np.dot(part, GRAY_WEIGHTS).astype(np.float32)[None] for part in (mean, std))
        elif bgr:
            fitted, mean, std = fitted[..., ::-1], mean[::-1], std[::-1]
        if self.dtype == np.uint8:
            return np.asarray(fitted)
        return np.asarray((fitted * np.float32(1 / 255) - mean) / std, np.float32)


def recognise(tensors: Sequence[Tensor], said: NetworkFormat, name: str) -> tuple[Input, ...]:
    """How a network takes its pictures: one input is one picture or both in its channels, two are a pair,
    four are a pair at a small and at the full size.

    Args:
        name: of the file, for messages.

    Raises:
        UsageError: these are not the inputs of a depth network.
    """
    if len(tensors) not in (1, 2, 4):
        raise UsageError(
            f"{name} takes {len(tensors)} inputs ({', '.join(t.name for t in tensors)}); a depth network "
            "takes one picture, a pair, or a pair at two sizes: export it with those alone"
        )
    tensors = _ordered(tensors, said, name)
    shapes = [_layout(tensor, said, name) for tensor in tensors]
    eyes: list[tuple[Eye, ...]] = [("left",), ("right",)] * (len(tensors) // 2)
    if len(tensors) == 1:
        eyes = [("left", "right") if shapes[0][0] in PAIR_CHANNELS else ("left",)]
    found = []
    for tensor, (channels, first), seen in zip(tensors, shapes, eyes, strict=True):
        one = channels // len(seen)
        if one not in PICTURE_CHANNELS:
            raise UsageError(
                f"{name}: input {tensor.name} has {channels} channels; a picture has 1 or 3, a pair 2 or 6"
            )
        height, width = tensor.shape[2:] if first else tensor.shape[1:3]
        if said.size is not None:
            width, height = width or said.size[0], height or said.size[1]
        found.append(Input(tensor.name, seen, one, first, tensor.dtype, width, height))
    return tuple(found)


def _layout(tensor: Tensor, said: NetworkFormat, name: str) -> tuple[int, bool]:
    """Number of channels, and whether they come before height and width."""
    shape = tensor.shape
    if len(shape) != 4 or shape[0] not in (1, None):
        text = "x".join("?" if side is None else str(side) for side in shape)
        raise UsageError(
            f"{name}: input {tensor.name} is {text}; a picture is 1x3xHxW or 1xHxWx3 with batch size 1"
        )
    first = said.layout == "nchw" if said.layout else shape[1] in CHANNELS or shape[3] not in CHANNELS
    return (shape[1] if first else shape[3]) or 3, first


def has_clear_layout(tensor: Tensor) -> bool:
    """Whether its shape says which side is the channels'."""
    return tensor.shape[1] in CHANNELS or tensor.shape[3] in CHANNELS


def _ordered(tensors: Sequence[Tensor], said: NetworkFormat, name: str) -> Sequence[Tensor]:
    """As they are named, left and right eye in turn; else in the file's order."""
    if said.inputs is None:
        return tensors
    by_name = {tensor.name: tensor for tensor in tensors}
    if sorted(said.inputs) != sorted(by_name):
        raise UsageError(f"{name}: inputs: its inputs are {', '.join(by_name)}; name all, left eye first")
    return [by_name[one] for one in said.inputs]
