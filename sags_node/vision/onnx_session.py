"""A user's ONNX file: it is opened with limits, described, and fed with images; its maps are read.

A network's description stands in the file itself, in a YAML file beside it, and in the launch file. Of
these the later one wins.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from sags_node.config.launch_file import explain
from sags_node.config.schema import NORMALIZATIONS, NetworkFormat, Normalization, OnnxConfig
from sags_node.config.yaml_reader import parse_yaml, read_yaml
from sags_node.errors import SagsError, UsageError
from sags_node.resizing import resized_image
from sags_node.types import F32, U8

Eye = Literal["left", "right"]
Size = tuple[int, int]  # width, height, px
LARGEST_FILE = 2**31  # bytes: an ONNX file cannot be larger
LARGEST_SIDECAR = 2**16  # bytes
LARGEST_SIDE = 4096  # px
KEYS = tuple(NetworkFormat.model_fields)
PICTURE_CHANNELS = (1, 3)
PAIR_CHANNELS = (2, 6)  # both eyes in one tensor, left first
CHANNELS = (*PICTURE_CHANNELS, *PAIR_CHANNELS)
GRAY_WEIGHTS = (0.299, 0.587, 0.114)
COARSENESS = (1, 2, 4, 8)  # image px per px of an output
PROVIDERS = {"cuda": "CUDAExecutionProvider", "cpu": "CPUExecutionProvider"}
TYPES: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}


class DepthNetworkError(SagsError):
    """The network gave nothing usable for one frame."""


@dataclass(frozen=True, slots=True)
class Tensor:
    """An input as the file declares it."""

    name: str
    shape: tuple[int | None, ...]  # None: any length
    dtype: type[np.generic]


class OnnxSession:
    """ONNX Runtime's session of one file.

    Args:
        setting: where the launch file names it.

    Attributes:
        inputs: in the file's order.
        outputs: names of those that are tensors.
        description: what the file says of both, for messages.
        metadata: what the file says of itself.
        processor: "cuda" or "cpu", where it runs.

    Raises:
        UsageError: the file is missing, too large, no ONNX model, or asks for what cannot be given.
    """

    def __init__(self, config: OnnxConfig, setting: str = "vision.onnx") -> None:
        import onnxruntime as ort

        path = config.path
        assert path is not None  # no network, no session
        if not path.is_file():
            raise UsageError(f"{setting}.path: {path} is no file; check the path")
        if (size := path.stat().st_size) > LARGEST_FILE:
            raise UsageError(
                f"{setting}.path: {path} has {size / 1e9:.1f} GB, an ONNX file has 2 GB at most; "
                "it is another file"
            )
        options = ort.SessionOptions()
        options.log_severity_level = 4  # fatal: what goes wrong is raised, once
        options.intra_op_num_threads = config.threads or len(os.sched_getaffinity(0))
        # Threads that spin between frames would take the mapper's cores.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        there = ort.get_available_providers()
        wanted = [PROVIDERS[name] for name in config.providers if PROVIDERS[name] in there]
        if not wanted:
            raise UsageError(
                f"{setting}.providers: none of {', '.join(config.providers)} is in this ONNX Runtime; add "
                "cpu, or install onnxruntime-gpu"
            )
        self.name = path.name
        try:
            self._session = ort.InferenceSession(  # the fallback would print to stdout
                str(path), options, providers=wanted, enable_fallback=0
            )
            declared, given = self._session.get_inputs(), self._session.get_outputs()
            self.description = f"inputs: {_in_words(declared)}; outputs: {_in_words(given)}"
            tensors = (output.name for output in given if output.type.startswith("tensor("))
            self.outputs: tuple[str, ...] = tuple(tensors)
            if not self.outputs:
                raise UsageError(
                    f"{self.name} gives no tensor: outputs: {_in_words(given)}; export its map by itself"
                )
            self.metadata: Mapping[str, str] = self._session.get_modelmeta().custom_metadata_map
            self.inputs = tuple(self._tensor(tensor) for tensor in declared)
        except UsageError:
            raise
        except Exception as error:  # the runtime raises a class of its own for every kind of fault
            raise UsageError(
                f"{setting}.path: {path} is no ONNX model that can be run: {_first_line(error)}"
            ) from None
        self.processor = "cuda" if "CUDA" in self._session.get_providers()[0] else "cpu"

    def run(self, feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Run the network, and return all outputs by name.

        Raises:
            DepthNetworkError: the runtime failed.
        """
        try:
            values = self._session.run(self.outputs, dict(feeds))
        except Exception as error:  # as above
            raise DepthNetworkError(f"{self.name} failed: {_first_line(error)}") from None
        return dict(zip(self.outputs, values, strict=True))

    def _tensor(self, declared: Any) -> Tensor:
        if declared.type not in TYPES:
            raise UsageError(
                f"{self.name}: input {declared.name} is {declared.type}; an image is uint8 or float: export "
                "the network with images as its only inputs"
            )
        shape = tuple(side if isinstance(side, int) and side > 0 else None for side in declared.shape)
        if any(side is not None and side > LARGEST_SIDE for side in shape):
            raise UsageError(
                f"{self.name}: input {declared.name} is {list(declared.shape)}, more than {LARGEST_SIDE} px; "
                "export the network for smaller images"
            )
        return Tensor(declared.name, shape, TYPES[declared.type])


def _in_words(tensors: Sequence[Any]) -> str:
    """Name, shape and type of each, as the runtime gives them."""
    return ", ".join(f"{each.name} {_sides(each.shape)}{each.type}" for each in tensors)


def _sides(shape: Sequence[Any] | None) -> str:
    return "x".join("?" if side is None else str(side) for side in shape) + " " if shape else ""


def _first_line(error: Exception) -> str:
    """Return what the runtime says, without the lines and paths of its source."""
    line = str(error).strip().partition("\n")[0]
    return line.rpartition(" : ")[2][:200]


# ---- what is said of it ----------------------------------------------------------------------------------


def read_format(config: OnnxConfig, metadata: Mapping[str, str]) -> NetworkFormat:
    """Read the description of a network.

    Args:
        metadata: of the ONNX file, each value as YAML; keys that `NetworkFormat` lacks are ignored.

    Raises:
        UsageError: a value is wrong, or the sidecar cannot be read or holds an unknown key.
    """
    assert config.path is not None
    sidecar = config.path.with_suffix(".yaml")
    found = _validated({key: metadata[key] for key in KEYS if key in metadata}, f"metadata of {config.path}")
    if sidecar.is_file():
        tree = read_yaml(sidecar, "description of a network", LARGEST_SIDECAR)
        if not isinstance(tree, dict):
            raise UsageError(f"{sidecar}: a map of keys is expected: {', '.join(KEYS)}")
        found |= _validated(tree, str(sidecar))
    said = {key: getattr(config, key) for key in KEYS if getattr(config, key) is not None}
    return NetworkFormat(**(found | said))


def _validated(tree: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The values that a map gives, checked and typed. Text is read as YAML: metadata holds only text."""
    try:
        parsed = {
            key: parse_yaml(value, f"{where}: {key}") if isinstance(value, str) else value
            for key, value in tree.items()
        }
        checked = NetworkFormat.model_validate(parsed)
    except ValidationError as error:
        raise UsageError(explain(error, where, root=NetworkFormat)) from None
    return {key: getattr(checked, key) for key in KEYS if getattr(checked, key) is not None}


# ---- what goes in, and what comes out --------------------------------------------------------------------


class Fit(NamedTuple):
    """How an image is brought to a network's size."""

    inner: Size  # it is resized to this
    outer: Size  # and padded at the right and below to this


@dataclass(frozen=True, slots=True)
class Input:
    """One input of a network."""

    name: str
    eyes: tuple[Eye, ...]  # whose images, one after the other in its channels
    channels: int  # of one image
    channels_first: bool
    dtype: type[np.generic]
    width: int | None  # px; None: any
    height: int | None

    def fit(self, size: Size, multiple: int) -> Fit:
        """Return how an image fits: resized to a side that the network fixes, padded where it is open."""
        inner = self.width or size[0], self.height or size[1]
        outer = (
            self.width or -(-size[0] // multiple) * multiple,
            self.height or -(-size[1] // multiple) * multiple,
        )
        return Fit(inner, outer)

    def tensor(
        self, pictures: Mapping[Eye, U8], fit: Fit, normalization: Normalization, bgr: bool
    ) -> NDArray[Any]:
        """Make the network's input [1, C, h, w] or [1, h, w, C] from images [H, W, 3] RGB."""
        values = np.concatenate(
            [self._channels(pictures[eye], fit, normalization, bgr) for eye in self.eyes], 2
        )
        if self.channels_first:
            values = values.transpose(2, 0, 1)
        return np.ascontiguousarray(values[None], self.dtype)

    def _channels(self, picture: U8, fit: Fit, normalization: Normalization, bgr: bool) -> U8 | F32:
        fitted = resized_image(picture, fit.inner)
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
    """Tell how a network takes its images: one input is one image or both in its channels, two are a
    pair, four are a pair at a small and at the full size.

    Args:
        name: of the file, for messages.

    Raises:
        UsageError: these are not the inputs of a depth network, or not of the size that is said.
    """
    if len(tensors) not in (1, 2, 4):
        raise UsageError(
            f"{name} takes {len(tensors)} inputs ({', '.join(t.name for t in tensors)}); a depth network "
            "takes one image, a pair, or a pair at two sizes: export it with those alone"
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
                f"{name}: input {tensor.name} has {channels} channels; an image has 1 or 3, a pair 2 or 6"
            )
        height, width = tensor.shape[2:] if first else tensor.shape[1:3]
        if said.size is not None:
            width, height = width or said.size[0], height or said.size[1]
        found.append(Input(tensor.name, seen, one, first, tensor.dtype, width, height))
    if said.size is not None and said.size not in ((one.width, one.height) for one in found):
        sizes = " and ".join(dict.fromkeys(f"{one.width}x{one.height}" for one in found))
        raise UsageError(
            f"{name}: size: {said.size[0]}x{said.size[1]} px, but its file takes {sizes} alone: set that, or "
            "leave size out"
        )
    sides = [(one.width or 0, one.height or 0) for one in found]  # 0: open
    if said.multiple is not None and all(map(all, sides)) and np.any(np.array(sides) % said.multiple):
        raise UsageError(
            f"{name}: multiple: {said.multiple} px, but file or size fix {sides[-1][0]}x{sides[-1][1]}: "
            "leave multiple out, or change size where the file leaves sides open"
        )
    return tuple(found)


def _layout(tensor: Tensor, said: NetworkFormat, name: str) -> tuple[int, bool]:
    """Number of channels, and whether they come before height and width."""
    shape = tensor.shape
    if len(shape) != 4 or shape[0] not in (1, None):
        text = "x".join("?" if side is None else str(side) for side in shape)
        raise UsageError(
            f"{name}: input {tensor.name} is {text}; an image is 1x3xHxW or 1xHxWx3 with batch size 1"
        )
    first = said.layout == "nchw" if said.layout else shape[1] in CHANNELS or shape[3] not in CHANNELS
    return (shape[1] if first else shape[3]) or 3, first


def has_clear_layout(tensor: Tensor) -> bool:
    """Tell whether a tensor's shape shows which dimension holds the channels."""
    return tensor.shape[1] in CHANNELS or tensor.shape[3] in CHANNELS


def _ordered(tensors: Sequence[Tensor], said: NetworkFormat, name: str) -> Sequence[Tensor]:
    """The tensors in the order of `said.inputs` (left and right eye in turn), else in the file's order."""
    if said.inputs is None:
        return tensors
    by_name = {tensor.name: tensor for tensor in tensors}
    if sorted(said.inputs) != sorted(by_name):
        raise UsageError(f"{name}: inputs: its inputs are {', '.join(by_name)}; name all, left eye first")
    return [by_name[one] for one in said.inputs]


class Network(OnnxSession):
    """A network as its file and the launch file describe it, fed with images of one size.

    Args:
        size: width and height of the images it will get, px.
        multiple: px, of sides that the network and its description leave open.
        normalization: where the description names none.

    Raises:
        UsageError: as `OnnxSession`, `read_format` and `recognise`.
    """

    def __init__(
        self, config: OnnxConfig, size: Size, multiple: int, normalization: str, setting: str = "vision.onnx"
    ) -> None:
        super().__init__(config, setting)
        self._size = size
        self._said = read_format(config, self.metadata)
        self._normalization = self._said.normalization or NORMALIZATIONS[normalization]
        self._fed = recognise(self.inputs, self._said, self.name)
        self._fits = [one.fit(size, self._said.multiple or multiple) for one in self._fed]

    def _outputs(self, left: U8, right: U8 | None = None) -> dict[str, NDArray[Any]]:
        """Run it on images [H, W, 3] RGB; the right one is only looked at by a stereo network."""
        eyes: dict[Eye, U8] = {"left": left} if right is None else {"left": left, "right": right}
        bgr = self._said.color == "bgr"
        fed = zip(self._fed, self._fits, strict=True)
        return self.run({one.name: one.tensor(eyes, fit, self._normalization, bgr) for one, fit in fed})

    def _maps(self, values: NDArray[Any]) -> NDArray[Any] | None:
        """An output as maps [C, h, w] of the padded image, full size or coarser; None: it is no map.

        Args:
            values: [1, C, h, w], [1, h, w, C], [C, h, w], [h, w, C] or [h, w].
        """
        maps = values[0] if values.ndim == 4 and len(values) == 1 else values
        maps = maps[None] if maps.ndim == 2 else maps
        width, height = self._fits[-1].outer
        for coarseness in COARSENESS if maps.ndim == 3 else ():
            shape = -(-height // coarseness), -(-width // coarseness)
            if maps.shape[1:] == shape:
                return maps
            if maps.shape[:2] == shape:
                return maps.transpose(2, 0, 1)
        return None

    @property
    def _map_sizes(self) -> str:
        """The sizes that `_maps` accepts, for messages."""
        width, height = self._fits[-1].outer
        return f"{width}x{height} px that it was given, or of a half, a quarter or an eighth of them"

    def _without_padding(self, plane: F32) -> F32:
        """A map of the padded image without the padding, [h, w] of `Fit.inner`."""
        (width, height), outer = self._fits[-1]
        if plane.shape[::-1] != outer:
            plane = cv2.resize(plane, outer, interpolation=cv2.INTER_LINEAR)
        return plane[:height, :width]
