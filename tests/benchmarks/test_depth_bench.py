"""`benchmarks depth`: what it compares with, on scenes whose depth is known, and the CT surface itself."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from onnx_networks import save_matcher

from benchmarks.quality.depth import (
    Comparison,
    Tally,
    by_confidence,
    error_figures,
    measure_faults,
    regions_of,
)
from benchmarks.quality.depth_ct import CTPair, distances_to_surface, errors_along_z, read_ct_pair
from benchmarks.quality.sgbm import JudgedSGBM, PlainSGBM
from sags_node.config.schema import StereoConfig
from sags_node.errors import UsageError
from sags_node.geometry import unproject
from sags_node.types import F32, U8, Bool, Camera, RectifiedPair

WIDTH, HEIGHT, BASELINE, FOCAL = 320, 256, 0.0043, 285.0
CAMERA = Camera(WIDTH, HEIGHT, np.array([[FOCAL, 0, 159.5], [0, FOCAL, 127.5], [0, 0, 1]]), np.eye(4))
ALL = np.ones((HEIGHT, WIDTH), np.bool_)


def shown_pair(disparity: F32, noise: float = 0.0) -> tuple[RectifiedPair, F32]:
    """A textured surface of this disparity [H, W] (px, of the right image), and its depth (m) as the left
    eye sees it; 0 where it does not see it."""
    rng = np.random.default_rng(3)
    spots = sum(s * cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), s) for s in (1.2, 3, 8))
    gray = np.clip(125 + 35 * spots / spots.std(), 30, 220).astype(np.float32)
    columns, rows = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    right = cv2.remap(gray, columns + disparity, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    left_disparity = np.zeros_like(disparity)
    for y in range(HEIGHT):  # the nearest surface wins, so far to near
        order = np.argsort(disparity[y], kind="stable")
        place = np.rint(order + disparity[y, order]).astype(int)
        inside = place < WIDTH
        left_disparity[y, place[inside]] = disparity[y, order[inside]]
    truth = np.divide(FOCAL * BASELINE, left_disparity, where=left_disparity > 0, out=left_disparity * 0)

    def eye(picture: F32) -> U8:
        noisy = picture + noise * rng.standard_normal(picture.shape)
        return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, -1)

    return RectifiedPair(0, 0, CAMERA, BASELINE, eye(gray), eye(right)), truth.astype(np.float32)


def slanted() -> F32:
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return (16.0 + 0.010 * columns - 0.012 * rows).astype(np.float32)


# ---- figures ---------------------------------------------------------------------------------------------


def test_figures_of_known_errors() -> None:
    errors = np.array([-4.0, -1, -1, 2, 3])
    assert error_figures(errors) == {"median_mm": 2.0, "p90_mm": 3.6, "bias_mm": -1.0}
    assert error_figures(np.empty(0))["median_mm"] is None
    rows = by_confidence(errors, np.array([0.1, 0.2, 0.9, 1.0, 0.6], np.float32))
    assert [row["share"] for row in rows] == [0.4, 0, 0.2, 0.4]
    assert rows[0]["median_mm"] == 2.5 and rows[1]["p90_mm"] is None


def test_coverage_counts_only_where_there_is_truth() -> None:
    tally = Tally()
    truth = np.array([[0.05, 0.05, 0.0, 0.05]], np.float32)
    depth = np.array([[0.052, 0.0, 0.06, 0.01]], np.float32)
    tissue = np.array([[True, True, True, False]])
    tally.add(depth, (depth > 0).astype(np.float32), truth, tissue, shared=depth > 0.02)
    figures = tally.figures()
    assert figures["coverage"] == 0.5
    assert figures["median_mm"] == pytest.approx(2.0, abs=1e-3)
    assert figures["where_configured_knows"]["median_mm"] == figures["median_mm"]


@pytest.mark.parametrize("baseline", [PlainSGBM, JudgedSGBM])
def test_sgbm_is_metric(baseline: type[PlainSGBM | JudgedSGBM]) -> None:
    pair, truth = shown_pair(slanted())
    for scale, limit_mm in ((1, 0.8), (2, 1.6)):  # a sixth of a pixel: it is drawn to whole ones
        depth, _ = baseline(StereoConfig(), CAMERA, BASELINE, scale)(pair, ALL)
        known = (depth > 0) & (truth > 0)
        assert known[:, 60:].mean() > 0.9
        assert np.median(np.abs(depth - truth)[known]) * 1e3 < limit_mm
        assert depth.max() <= StereoConfig().max_depth * 1.2


def test_matchers_are_compared_where_the_first_knows() -> None:
    truth = np.full((HEIGHT, WIDTH), 0.05, np.float32)

    def half(pair: RectifiedPair, tissue: Bool) -> tuple[F32, F32]:
        depth = truth.copy()
        depth[:, WIDTH // 2 :] = 0
        return depth, (depth > 0).astype(np.float32)

    def wrong_elsewhere(pair: RectifiedPair, tissue: Bool) -> tuple[F32, F32]:
        depth = truth.copy()
        depth[:, WIDTH // 2 :] += 0.01
        return depth, np.ones_like(depth)

    comparison = Comparison({"as configured": half, "other": wrong_elsewhere})
    comparison.add(shown_pair(slanted())[0], ALL, truth, {"shown": truth})
    first, other, shown = comparison.rows()
    assert first["coverage"] == 0.5 and other["coverage"] == 1.0 and shown["coverage"] == 1.0
    assert other["p90_mm"] == pytest.approx(10, abs=1e-3)
    assert other["where_configured_knows"]["p90_mm"] == 0


# ---- recordings ------------------------------------------------------------------------------------------


def test_regions_of_a_step_beside_an_instrument() -> None:
    """By hand: 20 px of disparity on the left half, 10 px on the right one, an instrument at the bottom."""
    disparity = np.where(np.arange(WIDTH) < 160, np.float32(20), np.float32(10)) * np.ones((HEIGHT, 1), "f4")
    truth, tissue = (FOCAL * BASELINE / disparity).astype(np.float32), ALL.copy()
    tissue[200:] = False
    truth[:, 300:] = 0
    found = regions_of(truth, tissue, FOCAL * BASELINE)
    columns = {name: np.flatnonzero(mask[50]) for name, mask in found.items()}
    assert columns["near"].tolist() == list(range(160)) and not found["far"].any()
    assert columns["at edges"].tolist() == list(range(150, 170))  # 10 px to either side
    assert columns["not seen by the right eye"].tolist() == list(range(20))
    assert columns["elsewhere"].tolist() == [*range(20, 150), *range(170, 300)]
    assert np.flatnonzero(found["beside instruments"][:, 50]).tolist() == list(range(185, 200))
    assert regions_of(np.zeros_like(truth), tissue, FOCAL * BASELINE) == {}


def test_faults_make_depth_worse(tmp_path: Path) -> None:
    said = {"inputs": "[first, second]", "normalization": "bytes", "meaning": "disparity", "multiple": "32"}
    network = save_matcher(tmp_path / "blocks.onnx", metadata=said)
    faults = {"noise": (0.0, 0.08), "gloss": (0.0, 64.0)}
    measured = measure_faults(lambda *_: None, network, (256, 192), 1, faults)
    clean, noisy, dull, shiny = measured["faults"]
    assert noisy["settings"][0]["median_mm"] > 1.3 * clean["settings"][0]["median_mm"]
    assert dull["white"] < 0.001 and shiny["white"] > 0.01
    digests = {row["receipt"]["frames"]["digest"] for row in measured["faults"]}
    assert len(digests) == 4
    blocks = clean["settings"][-1]
    assert blocks["name"] == "network blocks.onnx"
    assert blocks["coverage"] > 0.5
    assert 0 < blocks["median_mm"] < 3.3  # half a px of disparity at 80 mm, 230 px and 4.3 mm


# ---- a CT surface ----------------------------------------------------------------------------------------


def tilted_surface(offset: float) -> F32:
    """Depth (m) of the plane z = 50 mm + offset + x."""
    slopes = (np.arange(WIDTH) - CAMERA.K[0, 2]) / FOCAL
    return np.tile((0.05 + offset) / (1 - slopes), (HEIGHT, 1)).astype(np.float32)


def test_errors_along_z_and_to_the_surface() -> None:
    region = np.zeros((HEIGHT, WIDTH), np.bool_)
    region[64:192, 64:256] = True
    v, u = np.mgrid[80:176:8, 100:220:8]
    pixels = np.stack([u.ravel(), v.ravel()], -1).astype(np.float64)
    depths = tilted_surface(0.0)[v.ravel(), u.ravel()].astype(np.float64)
    points = np.asarray(unproject(CAMERA, pixels, depths), np.float64)
    pair = RectifiedPair(0, 0, CAMERA, BASELINE, np.zeros((HEIGHT, WIDTH, 3), np.uint8), None)
    ct = CTPair("plane", pair, region, points, pixels, {})
    measured = tilted_surface(1e-3)
    measured[:, 180:] = 0
    errors, given = errors_along_z(ct, measured)
    np.testing.assert_array_equal(given, pixels[:, 0] < 180)
    np.testing.assert_allclose(errors, 1 / (1 - (pixels[given, 0] - CAMERA.K[0, 2]) / FOCAL), atol=1e-3)
    inner = pixels[given, 0] < 170  # the nearest point of others lies where nothing was measured
    np.testing.assert_allclose(distances_to_surface(ct, measured)[inner], np.sqrt(0.5), atol=0.03)
    assert len(distances_to_surface(ct, np.zeros_like(measured))) == 0


def write_ct_folder(folder: Path) -> None:
    """A plane at 60 mm before another at 70 mm; the left half of the image counts."""
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for side in ("left", "right"):
        cv2.imwrite(str(folder / f"{side}.png"), black)
        np.savetxt(folder / f"calib.{side}.intrinsics.txt", CAMERA.K)
        np.savetxt(folder / f"calib.{side}.distortion.txt", np.zeros((1, 5)))
    l2r = np.eye(4)
    l2r[0, 3] = -4.3
    np.savetxt(folder / "calib.l2r.txt", l2r)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[20:-20, 20 : WIDTH // 2] = 0
    cv2.imwrite(str(folder / "a_MASK_eval.png"), mask)
    x, y = np.meshgrid(np.arange(-20, 20, 0.8), np.arange(-20, 20, 0.8))
    planes = [np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], -1) for z in (60.0, 70.0)]
    np.savetxt(folder / "a_CT_cut.xyz", np.concatenate(planes))


def test_hidden_points_and_those_outside_the_region_do_not_count(tmp_path: Path) -> None:
    write_ct_folder(tmp_path)
    ct = read_ct_pair(tmp_path)
    np.testing.assert_allclose(ct.points[:, 2], 0.06)
    assert len(ct.points) > 500
    assert ct.pixels[:, 0].max() < WIDTH // 2 and ct.pixels[:, 0].min() > 19
    assert ct.pair.baseline == pytest.approx(BASELINE)
    assert ct.receipt["masks"]["pixels_counted"] == np.count_nonzero(ct.evaluated)


def test_a_wrong_ct_folder_is_named(tmp_path: Path) -> None:
    write_ct_folder(tmp_path)
    (tmp_path / "a_CT_cut.xyz").write_text("1 2\n3 4\n")
    with pytest.raises(UsageError, match="three numbers in each line"):
        read_ct_pair(tmp_path)
    (tmp_path / "a_CT_cut.xyz").unlink()
    with pytest.raises(UsageError, match=r"0 files \*_CT_cut.xyz"):
        read_ct_pair(tmp_path)
