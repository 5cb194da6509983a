"""The network as an ONNX file that says of itself how it is fed and read, see docs/depth.md."""

from __future__ import annotations

import warnings
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

from sags_node.config import OnnxConfig
from sags_node.errors import UsageError
from sags_node.learning.network import MULTIPLE, StereoNetwork
from sags_node.vision.onnx_session import OnnxSession
from sags_node.vision.onnx_test_pair import make_pair

OPSET = 17
SIZE = (320, 256)  # px that it works at, whatever the pictures have: what it was trained on
INPUTS, OUTPUT = ("left", "right"), "disparity"


def check_export() -> None:
    """To be asked before long work whose result is such a file.

    Raises:
        UsageError: the package that writes it is missing.
    """
    if find_spec("onnx") is None:
        raise UsageError("ONNX files need the package onnx: pip install 'sags-node[learning]'")


def export(network: StereoNetwork, file: Path, trained: str) -> None:
    """Write the file.

    Args:
        trained: in a line, on what; anybody can read it in the file.

    Raises:
        UsageError: as `check_export`.
        OSError: it cannot be written.
    """
    check_export()
    import onnx

    example = tuple(torch.zeros(1, 3, SIZE[1], SIZE[0]) for _ in INPUTS)
    sides = {2: "height", 3: "width"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter: the newer one needs one more package
        torch.onnx.export(
            network.eval(),
            example,
            file,
            input_names=list(INPUTS),
            output_names=[OUTPUT],
            opset_version=OPSET,
            dynamic_axes=dict.fromkeys((*INPUTS, OUTPUT), sides),
            dynamo=False,
        )
    model = onnx.load_model(file)
    said = {
        "inputs": f"[{', '.join(INPUTS)}]",
        "layout": "nchw",
        "color": "rgb",
        "normalization": "unit",
        "size": str(list(SIZE)),
        "multiple": str(MULTIPLE),
        "output": OUTPUT,
        "meaning": "disparity",
        "trained": trained,
    }
    onnx.helper.set_model_props(model, said)
    onnx.save_model(model, file)


def difference(network: StereoNetwork, file: Path) -> float:
    """How far ONNX Runtime's disparity differs from torch's, mean px, on the adaptor's made-up pair."""
    left, right = (
        eye.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255) for eye in make_pair(*SIZE)[:2]
    )
    session = OnnxSession(OnnxConfig(path=file, providers=("cpu",)))
    given = session.run({"left": left, "right": right})[OUTPUT]
    with torch.no_grad():
        wanted = network(torch.from_numpy(left), torch.from_numpy(right)).numpy()
    return float(np.abs(given - wanted).mean())
