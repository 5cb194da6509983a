"""What every fit begins with: a fresh deformation field, and how fast Gaussians learn from nothing."""

from collections.abc import Sequence

import numpy as np

from sags_node.field.decoder import Tokens
from sags_node.field.deformation import Deltas, Field, NodeField, PointField
from sags_node.model import columns
from sags_node.model.deformation import spread_nodes
from sags_node.tools.fitting.settings import PARTS, Part, RowRates, Units
from sags_node.types import F32, F64

NODES = 512
BOX_QUANTILE = 1e-3  # share of Gaussians outside the field's box on either side: outliers must not enlarge it
MIN_SIDE = 1e-3  # m, of that box

OF_PART: dict[Part, slice] = {
    "means": columns.MEAN,
    "log_scales": columns.LOG_SCALE,
    "quats": columns.QUAT,
    "colors": columns.COLOR,
    "logits": slice(columns.LOGIT, columns.LOGIT + 1),
}


def row_rates(rates: RowRates, pixel: float) -> F32:
    """The learning rates [14] of canonical rows; `pixel`: the width of a pixel at the tissue, m."""
    return _row((rates.mean_px * pixel, rates.log_scale, rates.quat, rates.color, rates.logit))


def unit_row(units: Units) -> F32:
    """The change [14] of a row that a decoder output of 1 stands for."""
    return _row((units.mean, units.log_scale, units.quat, units.color, units.logit))


def _row(values: Sequence[float]) -> F32:
    """A row [14] with one value for each of `PARTS`."""
    found = np.empty(columns.COUNT, np.float32)
    for part, value in zip(PARTS, values, strict=True):
        found[OF_PART[part]] = value
    return found


def marked(parts: Sequence[Part]) -> F32:
    """A row [14] with 1 in the columns of these parts and 0 in the rest."""
    return _row([float(part in parts) for part in PARTS])


def make_box(means: F32) -> F64:
    """The lowest and highest corner [2, 3] m of a field over canonical means [N, 3] m."""
    low, high = np.quantile(means, [BOX_QUANTILE, 1 - BOX_QUANTILE], axis=0)
    return np.array([low, np.maximum(high, low + MIN_SIDE)])


def make_field(deltas: Deltas, means: F32, tokens: Tokens) -> Field:
    """A field over canonical means [N, 3] m, which decide where its nodes are, if its tokens are nodes."""
    if tokens == "nodes":
        return NodeField(deltas, spread_nodes(means, NODES))
    return PointField(deltas)
