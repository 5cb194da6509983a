"""One ONNX file, opened with limits, on the best processor there is."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sags_node.config.schema import OnnxConfig
from sags_node.errors import SagsError, UsageError

LARGEST_FILE = 2**31  # bytes: an ONNX file cannot be larger
LARGEST_SIDE = 4096  # px
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
        outputs: their names.
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
        _check_file(path, setting)
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
            self._session = ort.InferenceSession(
                str(path),
                options,
                providers=wanted,
                enable_fallback=0,  # it would print to stdout
            )
            declared, metadata = self._session.get_inputs(), self._session.get_modelmeta()
            given = self._session.get_outputs()
            self.outputs: tuple[str, ...] = tuple(output.name for output in given)
            self.description = f"inputs: {_in_words(declared)}; outputs: {_in_words(given)}"
            self.metadata: Mapping[str, str] = metadata.custom_metadata_map
            self.inputs = tuple(self._tensor(tensor) for tensor in declared)
        except UsageError:
            raise
        except Exception as error:  # the runtime raises a class of its own for every kind of fault
            raise UsageError(
                f"{setting}.path: {path} is no ONNX model that can be run: {first_line(error)}"
            ) from None
        self.processor = "cuda" if "CUDA" in self._session.get_providers()[0] else "cpu"

    def run(self, feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """All outputs by name.

        Raises:
            DepthNetworkError: the runtime failed.
        """
        try:
            values = self._session.run(self.outputs, dict(feeds))
        except Exception as error:  # as above
            raise DepthNetworkError(f"{self.name} failed: {first_line(error)}") from None
        return {
            name: value
            for name, value in zip(self.outputs, values, strict=True)
            if isinstance(value, np.ndarray)
        }

    def _tensor(self, declared: Any) -> Tensor:
        if declared.type not in TYPES:
            raise UsageError(
                f"{self.name}: input {declared.name} is {declared.type}; a picture is uint8 or float: export "
                "the network with pictures as its only inputs"
            )
        shape = tuple(side if isinstance(side, int) and side > 0 else None for side in declared.shape)
        if any(side is not None and side > LARGEST_SIDE for side in shape):
            raise UsageError(
                f"{self.name}: input {declared.name} is {list(declared.shape)}, more than {LARGEST_SIDE} px; "
                "export the network for smaller pictures"
            )
        return Tensor(declared.name, shape, TYPES[declared.type])


def _in_words(tensors: Sequence[Any]) -> str:
    """Name, shape and type of each, as the runtime gives them."""
    return ", ".join(f"{each.name} {_sides(each.shape)}{each.type}" for each in tensors)


def _sides(shape: Sequence[Any] | None) -> str:
    return "x".join("?" if side is None else str(side) for side in shape) + " " if shape else ""


def _check_file(path: Path, setting: str) -> None:
    if not path.is_file():
        raise UsageError(f"{setting}.path: {path} is no file; check the path")
    size = path.stat().st_size
    if size > LARGEST_FILE:
        raise UsageError(
            f"{setting}.path: {path} has {size / 1e9:.1f} GB, an ONNX file has 2 GB at most; "
            "it is another file"
        )


def first_line(error: Exception) -> str:
    """What the runtime says, without the lines and paths of its source."""
    line = str(error).strip().partition("\n")[0]
    return line.rpartition(" : ")[2][:200]
