"""The model over a sliding window: what leaves it is folded, and nothing that stays changes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sags_node.kernels.threads import configure_threads
from sags_node.model import columns
from sags_node.model.decoder import Decoder, DecoderConfig
from sags_node.model.deformation import spread_nodes
from sags_node.model.field import Deltas, FieldRates, NodeField, PointField
from sags_node.model.hexplane import HexPlaneField
from sags_node.model.window import AnchoredField, WindowModel, awaken
from sags_node.types import F32

SLOT_NS, SLOTS = 100_000_000, 6
BOX = np.array([[-0.05, -0.04, 0.03], [0.05, 0.04, 0.1]])
TOKENS = ["self", "planes", "nodes"]
NEWEST_NS = (SLOTS - 1) * SLOT_NS

# Rows are of order 1 (quaternions, logits, log scales up to 8): a few units in the last place of float32.
ROUNDING = 4e-6


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


def moving_deltas(tokens: str, seed: int = 0) -> Deltas:
    """A field whose slots differ, so that tissue moves by millimetres and turns by tenths of a radian."""
    hexplane = HexPlaneField(BOX, 0, SLOT_NS, SLOTS, cells=5, levels=2, channels=16, seed=seed)
    hexplane.advance(NEWEST_NS, _never)
    levels = 2 if tokens == "planes" else 1
    decoder = Decoder(DecoderConfig(tokens, features=32, levels=levels), seed)
    awaken(decoder, seed)
    decoder.parameters["head_out_weight"][:] *= 5
    rng = np.random.default_rng(seed)
    in_time = hexplane.cells[hexplane.grid.space_rows :]
    in_time[:] = rng.uniform(0.2, 2.0, in_time.shape)
    return Deltas(hexplane, decoder)


def moving_model(tokens: str, seed: int = 0) -> WindowModel:
    rows, deltas = some_rows(seed=seed), moving_deltas(tokens, seed)
    nodes = spread_nodes(rows[:, columns.MEAN], 40)
    return WindowModel(rows, NodeField(deltas, nodes) if tokens == "nodes" else PointField(deltas))


def _never(t_ns: int) -> None:
    raise AssertionError(f"the slot at {t_ns} ns retired")


def states(model: WindowModel, times_ns: list[int]) -> list[F32]:
    return [model.field.deform(model.rows, t_ns) for t_ns in times_ns]


def angles(a: F32, b: F32) -> F32:
    """Between rotations [N, 4], rad."""
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    return 2 * np.arccos(np.clip(np.abs((a * b).sum(1)), 0, 1))


@pytest.mark.parametrize("tokens", TOKENS)
def test_the_oldest_slot_is_the_canonical_state(tokens: str) -> None:
    model = moving_model(tokens)
    np.testing.assert_allclose(states(model, [0, -SLOT_NS]), [model.rows] * 2, atol=ROUNDING)
    moved = states(model, [NEWEST_NS])[0]
    assert np.abs(moved - model.rows)[:, columns.MEAN].max() > 1e-3
    assert angles(moved[:, columns.QUAT], model.rows[:, columns.QUAT]).max() > 0.1


@pytest.mark.parametrize("tokens", TOKENS)
def test_folding_changes_nothing_that_stays_in_the_window(tokens: str) -> None:
    model = moving_model(tokens)
    canonical = model.rows.copy()
    times = [int(share * SLOT_NS) for share in (2, 2.5, 3.75, 5, 9)]
    before = states(model, times)
    assert model.advance(NEWEST_NS + 2 * SLOT_NS) == 2
    np.testing.assert_allclose(states(model, times), before, atol=ROUNDING)
    np.testing.assert_allclose(model.rows, before[0], atol=ROUNDING)
    assert np.abs(model.rows - canonical)[:, columns.MEAN].max() > 1e-3


def test_what_is_forgotten_is_seen() -> None:
    model = moving_model("nodes")
    before = states(model, [3 * SLOT_NS])[0]
    assert model.advance(NEWEST_NS + 2 * SLOT_NS, folds=False) == 2
    after = states(model, [3 * SLOT_NS])[0]
    assert np.abs(after - before)[:, columns.MEAN].max() > 1e-3


@pytest.mark.parametrize("tokens", TOKENS)
def test_new_slots_say_what_the_newest_said(tokens: str) -> None:
    model = moving_model(tokens)
    newest = states(model, [NEWEST_NS])[0]
    model.advance(NEWEST_NS + SLOT_NS)
    for state in states(model, [NEWEST_NS, NEWEST_NS + SLOT_NS // 2, NEWEST_NS + SLOT_NS]):
        np.testing.assert_allclose(state, newest, atol=ROUNDING)


@pytest.mark.parametrize("slots", [SLOTS, SLOTS + 1, 100])
def test_after_a_gap_longer_than_the_window_the_last_state_is_kept(slots: int) -> None:
    model = moving_model("nodes")
    newest = states(model, [NEWEST_NS])[0]
    model.advance(NEWEST_NS + slots * SLOT_NS)
    np.testing.assert_allclose(model.rows, newest, atol=2 * ROUNDING)
    np.testing.assert_allclose(states(model, [NEWEST_NS + slots * SLOT_NS])[0], newest, atol=2 * ROUNDING)


def test_a_thousand_foldings_lose_nothing_and_take_no_memory() -> None:
    model = moving_model("nodes")
    newest = states(model, [NEWEST_NS])[0]
    lengths = np.linalg.norm(model.rows[:, columns.QUAT], axis=1)
    size, arrays = model.nbytes, model.field.deltas.hexplane.cells
    for number in range(1, 1001):
        model.advance(NEWEST_NS + number * SLOT_NS)
    assert model.nbytes == size and model.field.deltas.hexplane.cells is arrays
    np.testing.assert_allclose(states(model, [NEWEST_NS + 1000 * SLOT_NS])[0], newest, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(model.rows[:, columns.QUAT], axis=1), lengths, rtol=1e-5)


@pytest.mark.parametrize("tokens", TOKENS)
def test_a_gaussian_born_late_is_as_it_was_seen(tokens: str) -> None:
    model = moving_model(tokens)
    t_ns = int(3.4 * SLOT_NS)
    times = [0, SLOT_NS, t_ns, NEWEST_NS]
    others = states(model, times)
    born = some_rows(40, seed=9)
    model.insert(born, t_ns)
    assert len(model) == 340 and len(np.unique(model.ids)) == 340
    for state, other in zip(states(model, times), others, strict=True):
        np.testing.assert_allclose(state[:300], other, atol=ROUNDING)
    np.testing.assert_allclose(states(model, [t_ns])[0][300:], born, atol=ROUNDING)
    model.advance(NEWEST_NS + 3 * SLOT_NS)
    np.testing.assert_allclose(states(model, [t_ns])[0][300:], born, atol=2 * ROUNDING)


@pytest.mark.parametrize("tokens", TOKENS)
def test_a_gaussian_born_on_another_moves_with_it(tokens: str) -> None:
    model = moving_model(tokens)
    t_ns = int(3.4 * SLOT_NS)
    shift = np.array([1e-5, 0, 0], np.float32)
    twin = states(model, [t_ns])[0][:50]
    twin[:, columns.MEAN] += shift
    model.insert(twin, t_ns)
    for state, moved in zip(states(model, [0, NEWEST_NS]), (0, NEWEST_NS), strict=True):
        apart = state[300:, columns.MEAN] - state[:50, columns.MEAN]
        travelled = states(model, [t_ns])[0][:50, columns.MEAN] - state[:50, columns.MEAN]
        assert np.median(np.linalg.norm(apart, axis=1)) < 0.2 * np.median(
            np.linalg.norm(travelled, axis=1)
        ), moved


def test_tissue_outside_the_box_makes_it_grow_and_changes_nothing() -> None:
    model = moving_model("self")
    hexplane = model.field.deltas.hexplane
    times = [0, int(2.3 * SLOT_NS), NEWEST_NS]
    before, size = states(model, times), model.nbytes
    far = some_rows(5, seed=3)
    far[:, columns.MEAN] = BOX[1] + np.array([0.01, 0.0, 0.0])
    model.insert(far, NEWEST_NS)
    assert hexplane.grid.box[1][0] > BOX[1, 0] + 0.005
    for state, known in zip(states(model, times), before, strict=True):
        np.testing.assert_allclose(state[:300], known, atol=ROUNDING)
    assert model.nbytes > size


def test_a_stray_a_kilometre_away_takes_no_memory() -> None:
    model = moving_model("self")
    size = model.nbytes
    stray = some_rows(1, seed=3)
    stray[:, columns.MEAN] = 1000.0
    model.insert(stray, NEWEST_NS)
    model.insert(stray, NEWEST_NS)
    assert model.nbytes < 12 * size  # twice as long on every axis, and a margin
    np.testing.assert_allclose(states(model, [NEWEST_NS])[0][300:], [stray[0]] * 2, rtol=1e-6, atol=ROUNDING)


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


def gradient_check(model: WindowModel, parameter: F32, gradient: F32, t_ns: int, seed: int) -> None:
    """The slope along a random direction in one array of parameters, by differences and by `backward`."""
    rng = np.random.default_rng(seed)
    cotangent = _cotangent(model)
    direction = rng.normal(size=parameter.shape).astype(np.float32)
    direction[np.abs(gradient) < 0.1 * np.abs(gradient).max()] = 0  # what hardly matters only adds rounding
    start, size = parameter.copy(), 2e-3 * float(np.abs(parameter).mean())
    values = []
    for sign in (1, -1):
        parameter[:] = start + sign * size * direction
        state = model.field.deform(model.rows, t_ns).astype(np.float64)
        values.append((state * cotangent).sum())
    parameter[:] = start
    slope = (values[0] - values[1]) / (2 * size)
    assert slope == pytest.approx(float((gradient.astype(np.float64) * direction).sum()), rel=2e-2)


def _cotangent(model: WindowModel) -> F32:
    cotangent = np.random.default_rng(77).normal(size=model.rows.shape).astype(np.float32)
    cotangent[:, columns.MEAN] *= 100  # means are small against the rest
    return cotangent


@pytest.mark.parametrize("tokens", ["self", "nodes"])
@pytest.mark.parametrize("slots", [0.4, 3.4])
def test_gradients_are_those_of_both_times(tokens: str, slots: float) -> None:
    model = moving_model(tokens)
    t_ns = int(slots * SLOT_NS)
    deltas = model.field.deltas
    model.field.deform(model.rows, t_ns)
    v_rows = model.field.backward(_cotangent(model))
    found = deltas.found()
    v_cells = np.zeros_like(deltas.hexplane.cells)
    v_cells[found.rows] = found.v_cells[found.rows]
    gradient_check(model, deltas.hexplane.cells, v_cells, t_ns, 1)
    gradient_check(model, deltas.decoder.values, deltas.decoder.gradients.copy(), t_ns, 2)
    gradient_check(model, model.rows, v_rows, t_ns, 3)


@pytest.mark.parametrize("tokens", ["self", "nodes"])
def test_at_the_oldest_slot_the_field_has_nothing_to_learn(tokens: str) -> None:
    model = moving_model(tokens)
    deltas = model.field.deltas
    model.field.deform(model.rows, 0)
    cotangent = _cotangent(model)
    np.testing.assert_allclose(model.field.backward(cotangent), cotangent, rtol=1e-4, atol=1e-4)
    of_one_time = deltas.decoder.gradients.copy()
    deltas.found()  # adds those of the other
    assert np.abs(deltas.decoder.gradients).max() < 1e-4 * np.abs(of_one_time).max()


@pytest.mark.parametrize("tokens", ["self", "nodes"])
def test_a_fresh_field_learns_a_motion_and_leaves_the_oldest_slot_alone(tokens: str) -> None:
    rows = some_rows()
    hexplane = HexPlaneField(BOX, 0, SLOT_NS, SLOTS, cells=5, levels=2, channels=16)
    hexplane.advance(NEWEST_NS, _never)
    deltas = Deltas(hexplane, Decoder(DecoderConfig(tokens, features=32)))
    awaken(deltas.decoder, 0)
    inner = (
        NodeField(deltas, spread_nodes(rows[:, columns.MEAN], 40))
        if tokens == "nodes"
        else PointField(deltas)
    )
    field = AnchoredField(inner, rows[:, columns.MEAN])
    np.testing.assert_allclose(field.deform(rows, NEWEST_NS), rows, atol=ROUNDING)
    wanted = rows.copy()
    wanted[:, columns.MEAN] += np.array([0.002, -0.001, 0.001], np.float32)
    rates = dataclasses.replace(FieldRates(), cells=5e-3)
    for _ in range(150):
        deformed = field.deform(rows, NEWEST_NS)
        v_deformed = np.zeros_like(deformed)
        v_deformed[:, columns.MEAN] = np.sign(deformed - wanted)[:, columns.MEAN]
        field.backward(v_deformed)
        field.step(rates)
    left = np.abs(field.deform(rows, NEWEST_NS) - wanted)[:, columns.MEAN].mean()
    assert left < 0.3 * np.abs(wanted - rows)[:, columns.MEAN].mean()
    np.testing.assert_allclose(field.deform(rows, 0), rows, atol=ROUNDING)
