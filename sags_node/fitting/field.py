"""What every fit begins with: a fresh deformation field, and how fast Gaussians learn from nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sags_node.fitting.settings import PARTS, FieldShape, Part, RowRates, Tokens
from sags_node.model import columns
from sags_node.model.decoder import INITIAL_GATE, Decoder, DecoderConfig
from sags_node.model.deformation import spread_nodes
from sags_node.model.field import Block, Deltas, Field, NodeField, PointField
from sags_node.model.hexplane import HexPlaneField
from sags_node.types import F32, F64

NODES = 512
BOX_QUANTILE = 1e-3  # of the Gaussians beyond the field's box on either side: strays must not blow it up
MIN_SIDE = 1e-3  # m, of that box

OF_PART: dict[Part, slice] = {
    "means": columns.MEAN,
    "log_scales": columns.LOG_SCALE,
    "quats": columns.QUAT,
    "colors": columns.COLOR,
    "logits": slice(columns.LOGIT, columns.LOGIT + 1),
}


def row_rates(rates: RowRates, pixel: float) -> F32:
    """Learning rates [14] of canonical rows, where a pixel is as wide as `pixel` m."""
    return _row((rates.mean_px * pixel, rates.log_scale, rates.quat, rates.color, rates.logit))


def _row(values: Sequence[float]) -> F32:
    """[14] one value for each of `PARTS`."""
    found = np.empty(columns.COUNT, np.float32)
    for part, value in zip(PARTS, values, strict=True):
        found[OF_PART[part]] = value
    return found


def marked(parts: Sequence[Part]) -> F32:
    """[14] 1 in the columns of some parts, 0 in the rest."""
    return _row([float(part in parts) for part in PARTS])


def make_box(means: F32) -> F64:
    """Lowest and highest corner [2, 3] m of a field over canonical means [N, 3] m."""
    low, high = np.quantile(means, [BOX_QUANTILE, 1 - BOX_QUANTILE], axis=0)
    return np.array([low, np.maximum(high, low + MIN_SIDE)])


def make_decoder(
    hexplane: HexPlaneField, tokens: Tokens, seed: int, block: Block = "adaptive", xavier: bool = False
) -> Decoder:
    """A decoder of the HexPlane's features, which deforms nothing yet unless its last layers are `xavier`."""
    grid = hexplane.grid
    config = DecoderConfig(tokens, grid.features, grid.levels if tokens == "planes" else 1)
    gate = 1.0 if block == "mlp" else INITIAL_GATE
    return Decoder(config, seed, gate, xavier)


def make_deltas(
    hexplane: HexPlaneField, shape: FieldShape, tokens: Tokens, block: Block, seed: int
) -> Deltas:
    """HexPlane and a fresh decoder, in the shape's units."""
    units = shape.units
    row = _row((units.mean, units.log_scale, units.quat, units.color, units.logit))
    return Deltas(hexplane, make_decoder(hexplane, tokens, seed, block, shape.xavier), block, row)


def make_field(deltas: Deltas, means: F32, tokens: Tokens) -> Field:
    """A field over canonical means [N, 3] m, which decide where its nodes are, if its tokens are nodes."""
    if tokens == "nodes":
        return NodeField(deltas, spread_nodes(means, NODES))
    return PointField(deltas)
