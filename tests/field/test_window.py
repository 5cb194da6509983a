"""The model over a sliding window: what leaves it is folded, and nothing that stays changes."""

import numpy as np
import pytest
import torch

from sags_node.field.decoder import Decoder
from sags_node.field.deformation import Deltas, Field, FieldRates, NodeField, PointField
from sags_node.field.hexplane import HexPlane
from sags_node.field.window import AnchoredField, WindowModel
from sags_node.kernels.threads import configure_threads
from sags_node.model import columns
from sags_node.model.deformation import spread_nodes
from sags_node.types import F32

SLOT_NS, SLOTS = 100_000_000, 6
BOX = np.array([[-0.05, -0.04, 0.03], [0.05, 0.04, 0.1]])
NEWEST_NS = (SLOTS - 1) * SLOT_NS

# Rows are of order 1 (quaternions, logits, log scales up to 8): a few units in the last place of float32.
ROUNDING = 4e-6


both_tokens = pytest.mark.parametrize("tokens", ["self", "nodes"])


@pytest.fixture(autouse=True, scope="module")
def _threads() -> None:
    configure_threads(None)


def some_rows(count: int = 300, seed: int = 0, box: np.ndarray = BOX) -> F32:
    rng = np.random.default_rng(seed)
    rows = np.empty((count, columns.COUNT), np.float32)
    rows[:, columns.MEAN] = rng.uniform(*box, (count, 3))
    rows[:, columns.LOG_SCALE] = rng.uniform(-8, -6, (count, 3))
    rows[:, columns.QUAT] = rng.normal(size=(count, 4))
    rows[:, columns.COLOR] = rng.uniform(0, 1, (count, 3))
    rows[:, columns.LOGIT] = rng.normal(size=count)
    return rows


def fresh_field(tokens: str, rows: F32) -> Field:
    hexplane = HexPlane(BOX, 0, SLOT_NS, SLOTS, cells=5, levels=2, channels=16)
    hexplane.advance(NEWEST_NS, lambda t_ns: None)
    deltas = Deltas(hexplane, Decoder(hexplane.features, tokens))
    deltas.decoder.awaken(0)
    nodes = spread_nodes(rows[:, columns.MEAN], 40)
    return NodeField(deltas, nodes) if tokens == "nodes" else PointField(deltas)


def moving_model(tokens: str) -> WindowModel:
    """Of a field whose slots differ, so that tissue moves by millimetres and turns by tenths of a radian."""
    field = fresh_field(tokens, some_rows())
    hexplane = field.deltas.hexplane
    with torch.no_grad():
        for weights in field.deltas.decoder.head_out:
            weights.mul_(5)
    in_time = hexplane.cells.detach().numpy()[hexplane.slot(0).start :]
    in_time[:] = np.random.default_rng(0).uniform(0.2, 2.0, in_time.shape)
    return WindowModel(some_rows(), field)


def states(model: WindowModel, times_ns: list[int]) -> list[F32]:
    return [model.rows_at(t_ns).detach().numpy() for t_ns in times_ns]


def angles(a: F32, b: F32) -> F32:
    """Between rotations [N, 4], rad."""
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    return 2 * np.arccos(np.clip(np.abs((a * b).sum(1)), 0, 1))


@both_tokens
def test_the_oldest_slot_is_the_canonical_state(tokens: str) -> None:
    model = moving_model(tokens)
    np.testing.assert_allclose(states(model, [0, -SLOT_NS]), [model.table] * 2, atol=ROUNDING)
    moved = states(model, [NEWEST_NS])[0]
    assert np.abs(moved - model.table)[:, columns.MEAN].max() > 1e-3
    assert angles(moved[:, columns.QUAT], model.table[:, columns.QUAT]).max() > 0.1


@both_tokens
def test_folding_changes_nothing_that_stays_in_the_window(tokens: str) -> None:
    model = moving_model(tokens)
    canonical = model.table.copy()
    times = [int(share * SLOT_NS) for share in (2, 2.5, 3.75, 5, 9)]
    before = states(model, times)
    assert model.advance(NEWEST_NS + 2 * SLOT_NS) == 2
    np.testing.assert_allclose(states(model, times), before, atol=ROUNDING)
    np.testing.assert_allclose(model.table, before[0], atol=ROUNDING)
    assert np.abs(model.table - canonical)[:, columns.MEAN].max() > 1e-3


@both_tokens
@pytest.mark.parametrize("slots", [1, SLOTS, SLOTS + 1, 100])
def test_new_slots_say_what_the_newest_said(slots: int, tokens: str) -> None:
    """Also after a gap longer than the window: then the last state is the canonical one."""
    model = moving_model(tokens)
    newest = states(model, [NEWEST_NS])[0]
    model.advance(NEWEST_NS + slots * SLOT_NS)
    later = [NEWEST_NS + share * SLOT_NS // 2 for share in (0, 1, 2, 2 * slots)]
    np.testing.assert_allclose(states(model, later), [newest] * 4, atol=2 * ROUNDING)
    if slots >= SLOTS:
        np.testing.assert_allclose(model.table, newest, atol=2 * ROUNDING)


def test_a_thousand_foldings_lose_nothing_and_take_no_memory() -> None:
    model = moving_model("nodes")
    newest = states(model, [NEWEST_NS])[0]
    lengths = np.linalg.norm(model.table[:, columns.QUAT], axis=1)
    cells, rows = model.field.deltas.hexplane.cells, model.table.nbytes
    for number in range(1, 1001):
        model.advance(NEWEST_NS + number * SLOT_NS)
    assert model.field.deltas.hexplane.cells is cells and model.table.nbytes == rows
    np.testing.assert_allclose(states(model, [NEWEST_NS + 1000 * SLOT_NS])[0], newest, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(model.table[:, columns.QUAT], axis=1), lengths, rtol=1e-5)


@both_tokens
def test_a_gaussian_born_late_is_as_it_was_seen(tokens: str) -> None:
    model = moving_model(tokens)
    t_ns = int(3.4 * SLOT_NS)
    times = [0, SLOT_NS, t_ns, NEWEST_NS]
    others = states(model, times)
    born = some_rows(40, seed=9)
    model.insert(born, t_ns)
    assert len(model) == 340 and len(np.unique(model.ids)) == 340
    for state, other in zip(states(model, times), others, strict=True):
        np.testing.assert_allclose(state[:300], other, atol=2 * ROUNDING)  # sums of more rows: another order
    np.testing.assert_allclose(states(model, [t_ns])[0][300:], born, atol=ROUNDING)
    model.advance(NEWEST_NS + 3 * SLOT_NS)
    np.testing.assert_allclose(states(model, [t_ns])[0][300:], born, atol=2 * ROUNDING)


@both_tokens
def test_a_gaussian_born_on_another_moves_with_it(tokens: str) -> None:
    model = moving_model(tokens)
    t_ns = int(3.4 * SLOT_NS)
    shift = np.array([1e-5, 0, 0], np.float32)
    twin = states(model, [t_ns])[0][:50]
    twin[:, columns.MEAN] += shift
    model.insert(twin, t_ns)
    at_birth = states(model, [t_ns])[0][:50, columns.MEAN]
    for state in states(model, [0, NEWEST_NS]):
        apart = np.linalg.norm(state[300:, columns.MEAN] - state[:50, columns.MEAN], axis=1)
        travelled = np.linalg.norm(at_birth - state[:50, columns.MEAN], axis=1)
        assert np.median(apart) < 0.2 * np.median(travelled)


def test_places_stay_with_their_gaussians() -> None:
    model = moving_model("nodes")
    times = [SLOT_NS, NEWEST_NS]
    kept = np.arange(300) % 3 != 0
    expected = [state[kept] for state in states(model, times)]
    model.keep(kept)
    np.testing.assert_allclose(states(model, times), expected, atol=ROUNDING)
    model.advance(NEWEST_NS + SLOT_NS)
    np.testing.assert_allclose(states(model, times), expected, atol=ROUNDING)


# ---- gradients -------------------------------------------------------------------------------------------


@both_tokens
def test_at_the_oldest_slot_the_field_has_nothing_to_learn(tokens: str) -> None:
    model = moving_model(tokens)
    cotangent = torch.from_numpy(np.random.default_rng(77).normal(size=model.table.shape).astype(np.float32))

    def decoder_gradient(t_ns: int) -> float:
        learnt = list(model.field.deltas.decoder.parameters())
        found = torch.autograd.grad(model.rows_at(t_ns), [model.rows, *learnt], cotangent, allow_unused=True)
        if t_ns == 0:
            np.testing.assert_allclose(found[0], cotangent, rtol=1e-4, atol=1e-4)
        return max(float(each.abs().max()) for each in found[1:] if each is not None)

    assert decoder_gradient(0) < 1e-4 * decoder_gradient(NEWEST_NS)


@both_tokens
def test_a_fresh_field_learns_a_motion_and_leaves_the_oldest_slot_alone(tokens: str) -> None:
    rows = torch.from_numpy(some_rows())
    field = AnchoredField(fresh_field(tokens, rows.numpy()), rows[:, columns.MEAN].numpy())
    assert torch.allclose(field.deform(rows, NEWEST_NS), rows, rtol=0, atol=ROUNDING)
    shift = torch.tensor([0.002, -0.001, 0.001])

    def left() -> torch.Tensor:
        return (field.deform(rows, NEWEST_NS)[:, columns.MEAN] - rows[:, columns.MEAN] - shift).abs()

    for _ in range(150):
        left().sum().backward()
        field.deltas.step(FieldRates(cells=5e-3, lines=5e-3))
    assert left().mean() < 0.3 * shift.abs().mean()
    assert torch.allclose(field.deform(rows, 0), rows, rtol=0, atol=ROUNDING)


@both_tokens
def test_when_the_field_forgets_the_state_at_that_time_stays(tokens: str) -> None:
    model = moving_model(tokens)
    cells = model.field.deltas.hexplane.cells.detach()
    canonical, before = model.table.copy(), states(model, [NEWEST_NS])[0]
    model.settle(NEWEST_NS, lambda: cells.copy_(1 + 0.5 * (cells - 1)))
    np.testing.assert_allclose(states(model, [NEWEST_NS])[0], columns.bounded(before), atol=ROUNDING)
    assert np.abs(model.table - canonical)[:, columns.MEAN].max() > 1e-3


def test_what_has_left_its_range_is_brought_back_and_nothing_else_changes() -> None:
    model = moving_model("nodes")
    before = states(model, [NEWEST_NS])[0]
    model.table[0, columns.LOG_SCALE] = -200, 200, -7
    model.table[0, columns.COLOR], model.table[0, columns.LOGIT] = (-9, 9, 0.5), 99
    model.table[1, columns.MEAN] = np.nan
    model.settle(NEWEST_NS, lambda: None)
    after = states(model, [NEWEST_NS])[0]
    low, high = columns.LOG_SCALE_RANGE
    np.testing.assert_allclose(after[0, columns.LOG_SCALE][:2], [low, high], atol=1e-4)
    np.testing.assert_allclose(after[0, columns.COLOR][:2], columns.COLOR_RANGE, atol=1e-4)
    np.testing.assert_allclose(after[0, columns.LOGIT], columns.LOGIT_RANGE[1], atol=1e-4)
    assert np.isnan(after[1, columns.MEAN]).all()
    np.testing.assert_allclose(after[2:], columns.bounded(before[2:]), atol=ROUNDING)
