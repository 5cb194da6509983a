"""Small depth networks of every convention, written as ONNX files: block matching, and a table of depths."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

FLOAT, UINT8 = TensorProto.FLOAT, TensorProto.UINT8
EXPECTED = {
    "unit": (np.zeros(3), np.ones(3)),
    "bytes": (np.zeros(3), np.full(3, 1 / 255)),
    "imagenet": (np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])),
    "symmetric": (np.full(3, 0.5), np.full(3, 0.5)),
}
MOST_DISPARITY = 40  # px
LEVEL = 24.0  # grey levels that the block matcher tells apart: it fails where it is fed the wrong range


class Graph:
    """Nodes are added one by one; every call gives the name of what it made."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def __call__(self, op: str, *inputs: str | np.ndarray, **attributes: Any) -> str:
        names = [one if isinstance(one, str) else self._constant(one) for one in inputs]
        output = f"{op}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, names, [output], **attributes))
        return output

    def named(self, name: str, made: str) -> None:
        self.nodes.append(helper.make_node("Identity", [made], [name]))

    def _constant(self, values: np.ndarray) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(values), name))
        return name

    def save(
        self,
        path: Path,
        inputs: Mapping[str, tuple[int, Sequence[Any]]],
        outputs: Sequence[str],
        metadata: Mapping[str, str] | None = None,
    ) -> Path:
        graph = helper.make_graph(
            self.nodes,
            "network",
            [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in inputs.items()],
            [helper.make_empty_tensor_value_info(name) for name in outputs],  # ONNX Runtime infers types
            self.constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        helper.set_model_props(model, dict(metadata or {}))
        path.write_bytes(model.SerializeToString())
        return path


def floats(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def save_matcher(
    path: Path,
    *,
    nhwc: bool = False,
    channels: int = 3,
    uint8: bool = False,
    concatenated: bool = False,
    size: tuple[Any, Any] = ("w", "h"),
    expects: str = "bytes",
    names: tuple[str, str] = ("first", "second"),
    guided: bool = False,
    output: str = "full",
    factor: float = 1.0,
    depth_of: float | None = None,
    metadata: Mapping[str, str] | None = None,
    fault: str = "",
) -> Path:
    """Block matching of two images over disparities of 0 to 40 px.

    Args:
        size: width and height of the inputs; a text is any.
        expects: the normalisation it undoes.
        names: of the inputs, left first; the file holds them in alphabetical order.
        guided: it also takes the pair at half its size, first, and fails without.
        output: full, half (of its size), 6187 (its name) or several.
        factor: of the disparity, in the output.
        depth_of: focal length times baseline (px m), for depth in metres instead of disparity.
        fault: nan or error, where the left image is nearly black.
    """
    g = Graph()

    def shape(count: int) -> list[Any]:
        return [1, size[1], size[0], count] if nhwc else [1, count, size[1], size[0]]

    kind = UINT8 if uint8 else FLOAT
    if concatenated:
        inputs = {"pair": (kind, shape(2 * channels))}
        axis = 3 if nhwc else 1
        cuts = np.array([[0], [channels], [2 * channels]])
        split = [g("Slice", "pair", cuts[eye], cuts[eye + 1], np.array([axis])) for eye in (0, 1)]
    else:
        inputs = {name: (kind, shape(channels)) for name in sorted(names)}
        split = list(names)
    left, right = (_gray(g, eye, nhwc, channels, "bytes" if uint8 else expects) for eye in split)
    bank = np.zeros((MOST_DISPARITY + 1, 1, 1, MOST_DISPARITY + 1), np.float32)
    for d in range(MOST_DISPARITY + 1):
        bank[d, 0, 0, MOST_DISPARITY - d] = 1
    shifted = g("Conv", right, bank, pads=[0, MOST_DISPARITY, 0, 0])
    cost = g("AveragePool", g("Abs", g("Sub", left, shifted)), kernel_shape=[9, 9], pads=[4, 4, 4, 4])
    disparity = g("Cast", g("ArgMin", cost, axis=1, keepdims=1), to=FLOAT)
    disparity = g("Mul", disparity, floats(factor))
    if depth_of is not None:
        disparity = g("Div", floats(depth_of), disparity)
    if guided:
        small = [1, channels, size[1] // 2, size[0] // 2]
        inputs = {"init_left": (kind, small), "init_right": (kind, small), **inputs}
        apart = g("Abs", g("Sub", *(g("ReduceMean", f"init_{eye}", keepdims=0) for eye in ("left", "right"))))
        disparity = g("Mul", disparity, g("Cast", g("Less", apart, np.float32(20)), to=FLOAT))
    if fault:
        disparity = _faulty(g, left, disparity, fault)
    half = g("AveragePool", disparity, kernel_shape=[2, 2], strides=[2, 2], ceil_mode=1)
    maps = {"full": {"disparity": disparity}, "half": {"disparity": half}, "6187": {"6187": disparity}}
    outputs = maps.get(output)
    if outputs is None:  # a certainty, a coarse guess, the disparity itself
        certainty = g("Exp", g("Neg", g("ReduceMin", cost, axes=[1], keepdims=1)))
        guess = g("AveragePool", g("AveragePool", half, kernel_shape=[2, 2], strides=[2, 2], ceil_mode=1),
                  kernel_shape=[9, 9], pads=[4, 4, 4, 4])  # fmt: skip
        outputs = {"certainty": certainty, "guess": guess, "final": disparity}
    for name, made in outputs.items():
        g.named(name, made)
    return g.save(path, inputs, list(outputs), metadata)


def _gray(g: Graph, eye: str, nhwc: bool, channels: int, expects: str) -> str:
    """Grey levels [1, 1, h, w] in steps of LEVEL, cut off at 0 and 255."""
    values = g("Cast", eye, to=FLOAT)
    if nhwc:
        values = g("Transpose", values, perm=[0, 3, 1, 2])
    mean, std = (part.astype(np.float32) for part in EXPECTED[expects])
    if channels == 1:
        mean, std = mean.mean(keepdims=True), std.mean(keepdims=True)
    levels = g("Add", g("Mul", values, 255 * std[:, None, None]), 255 * mean[:, None, None])
    levels = g("Clip", levels, np.float32(0), np.float32(255))
    return g("ReduceMean", g("Floor", g("Div", levels, floats(LEVEL))), axes=[1], keepdims=1)


def _faulty(g: Graph, left: str, disparity: str, fault: str) -> str:
    brightest = g("ReduceMax", left, keepdims=0)
    if fault == "nan":  # the root of a negative number
        root = g("Sqrt", g("Sub", brightest, np.float32(50 / LEVEL)))
        return g("Add", disparity, g("Mul", root, np.float32(0)))
    place = g("Where", g("Less", brightest, np.float32(50 / LEVEL)), np.int64(7), np.int64(0))
    return g("Add", disparity, g("Gather", floats(0), place))


def save_table(path: Path, pictures: np.ndarray, maps: np.ndarray) -> Path:
    """A monocular network that knows the images [N, H, W, 3] (uint8) and gives the map [N, H, W] of the one
    most like its input."""
    g = Graph()
    count, height, width, _ = pictures.shape
    levels = np.floor(pictures / LEVEL).mean(-1, dtype=np.float32)[:, None]
    h, w = height // 8, width // 8
    thumbs = levels[:, :, : 8 * h, : 8 * w].reshape(count, 1, h, 8, w, 8).mean((3, 5))
    seen = g("AveragePool", _gray(g, "image", False, 3, "imagenet"), kernel_shape=[8, 8], strides=[8, 8])
    apart = g("ReduceMean", g("Abs", g("Sub", thumbs.astype(np.float32), seen)), axes=[1, 2, 3], keepdims=0)
    nearest = g("ArgMin", apart, axis=0, keepdims=1)
    g.named("predicted_depth", g("Gather", maps.astype(np.float32), nearest, axis=0))
    return g.save(path, {"image": (FLOAT, [1, 3, height, width])}, ["predicted_depth"])


def save_odd(path: Path, inputs: Mapping[str, Sequence[Any]], output: str) -> Path:
    """No depth network: any inputs, and an output that is `same`, `small` or a `sequence`."""
    g = Graph()
    first = next(iter(inputs))
    made = {
        "same": lambda: g("Identity", first),
        "small": lambda: g("AveragePool", first, kernel_shape=[3, 3], strides=[3, 3]),
        "sequence": lambda: g("SequenceConstruct", first),
    }[output]()
    g.named("out", made)
    return g.save(path, {name: (FLOAT, shape) for name, shape in inputs.items()}, ["out"])
