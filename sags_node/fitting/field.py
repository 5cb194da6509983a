"""What every fit begins with: a fresh deformation field, and how fast Gaussians learn from nothing."""

from __future__ import annotations

import numpy as np

from sags_node.fitting.settings import Tokens
from sags_node.model import columns
from sags_node.model.decoder import Decoder, DecoderConfig
from sags_node.model.deformation import spread_nodes
from sags_node.model.field import Deltas, Field, NodeField, PointField
from sags_node.model.hexplane import HexPlaneField
from sags_node.types import F32, F64

NODES = 512
BOX_QUANTILE = 1e-3  # of the Gaussians beyond the field's box on either side: strays must not blow it up
MIN_SIDE = 1e-3  # m, of that box
LOG_SCALE_RATE, QUAT_RATE, COLOR_RATE, LOGIT_RATE = 5e-3, 1e-3, 2.5e-3, 0.05  # EndoGaussian, SAGS


def row_rates(mean_rate: float) -> F32:
    """Learning rates [14] of canonical rows; `mean_rate` is that of the means, in m."""
    rates = np.empty(columns.COUNT, np.float32)
    rates[columns.MEAN] = mean_rate
    rates[columns.LOG_SCALE] = LOG_SCALE_RATE
    rates[columns.QUAT] = QUAT_RATE
    rates[columns.COLOR] = COLOR_RATE
    rates[columns.LOGIT] = LOGIT_RATE
    return rates


def make_box(means: F32) -> F64:
    """Lowest and highest corner [2, 3] m of a field over canonical means [N, 3] m."""
    low, high = np.quantile(means, [BOX_QUANTILE, 1 - BOX_QUANTILE], axis=0)
    return np.array([low, np.maximum(high, low + MIN_SIDE)])


def make_decoder(hexplane: HexPlaneField, tokens: Tokens, seed: int) -> Decoder:
    """A decoder of the HexPlane's features, which deforms nothing yet."""
    grid = hexplane.grid
    config = DecoderConfig(tokens, grid.features, grid.levels if tokens == "planes" else 1)
    return Decoder(config, seed)


def make_field(deltas: Deltas, means: F32, tokens: Tokens) -> Field:
    """A field over canonical means [N, 3] m, which decide where its nodes are, if its tokens are nodes."""
    if tokens == "nodes":
        return NodeField(deltas, spread_nodes(means, NODES))
    return PointField(deltas)
