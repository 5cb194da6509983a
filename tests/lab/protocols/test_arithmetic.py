"""Figures of public evaluators, by hand."""

import cv2
import numpy as np
import pytest

from sags_lab.protocols import arithmetic
from sags_lab.protocols.point_tracks import average_jaccard, calibration_error, reliability, shares_within
from sags_node.quality import metrics


def test_stir_counts_the_nearest_end_up_to_and_with_each_threshold() -> None:
    ends = np.array([[0.0, 0.0], [100.0, 0.0]])
    points = np.array([[3.0, 4.0], [100.0, 4.0], [50.0, 0.0], [100.0, 90.0]])  # 5, 4, 50 and 90 px away
    distances = arithmetic.nearest_distances(points, ends)
    assert distances.tolist() == [5.0, 4.0, 50.0, 90.0]
    shares = shares_within(distances, arithmetic.STIR_PX)
    found = {"within_4": 0.25, "within_8": 0.5, "within_16": 0.5, "within_32": 0.5, "within_64": 0.75}
    assert shares == found | {"average": 0.5}
    millimetres = shares_within(np.array([1.0, 3.0]), (2, 4, 8, 16, 32))
    assert millimetres["average"] == pytest.approx((0.5 + 4 * 1.0) / 5)


def test_stir_makes_points_of_pixels_of_both_eyes() -> None:
    """f = 1000 px, 5 mm between the eyes, principal points 10 px apart: pixel 600 seen at 560 has a disparity
    of 600 + 10 - 560 = 50 px, so z = 1000 * 5 / 50 = 100 mm, x = (600 - 500) / 1000 z = 10 mm."""
    K_left = np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])
    K_right = K_left + np.array([[0, 0, 10.0], [0, 0, 0], [0, 0, 0]])
    left, right = np.array([[600.0, 380], [600, 380]]), np.array([[560.0, 381], [610, 380]])
    points = arithmetic.stereo_points_mm(left, right, K_left, K_right, 5.0)
    assert points[0] == pytest.approx([10, -2, 100])
    distances = arithmetic.nearest_distances(points, np.array([[10.0, -2, 103]]))
    assert shares_within(distances, arithmetic.STIR_MM)["average"] == pytest.approx(4 / 5 / 2)


def test_stir_of_2026_counts_places_and_visibility() -> None:
    """Four points: near; 5 px off; visible but not said to be; hidden but said to be visible.

    Within 2 and 4 px one of the three visible ones is right, and two of those said are wrong: 1 / (3 + 2).
    Within 8, 16 and 32 px it is 2 / (3 + 1). Of the visible ones one of three is within 2 and 4, two within
    the others. Of two points the right visibility is said.
    """
    distances = np.array([1.0, 5.0, 40.0, 1.0])
    visible, said = np.array([1, 1, 1, 0], bool), np.array([1, 1, 0, 1], bool)
    figures = arithmetic.stir_2026_figures(distances, visible, said)
    assert average_jaccard(distances, visible, said) == figures["average_jaccard"]
    assert average_jaccard(np.zeros(4), visible, visible) == 1
    assert average_jaccard(np.zeros(4), visible, ~visible) == 0
    assert average_jaccard(np.array([2.0]), np.array([True]), np.array([True]), [2]) == 0  # TAP-Vid: below it
    assert average_jaccard(np.full(4, np.inf), visible, said) == 0
    assert figures == {
        "average_jaccard": pytest.approx((2 * 1 / 5 + 3 * 2 / 4) / 5),
        "average_tracking_accuracy": pytest.approx((2 * 1 / 3 + 3 * 2 / 3) / 5),
        "occlusion_accuracy": 0.5,
    }
    on_the_line = arithmetic.stir_2026_figures(np.array([16.0]), np.ones(1, bool), np.ones(1, bool))
    # Below it only.
    assert on_the_line["average_jaccard"] == on_the_line["average_tracking_accuracy"] == 1 / 5
    hidden = arithmetic.stir_2026_figures(np.array([1.0]), np.zeros(1, bool), np.zeros(1, bool))
    assert list(hidden.values()) == [0, 0, 1]


def test_stir_latency() -> None:
    """1 to 101 ms: mean 51, p95 96, p99 100."""
    assert arithmetic.latency_score(list(range(1, 102))) == pytest.approx((51 + 96 + 100) / 3)


def rotation(degrees: float, axis: int) -> np.ndarray:
    vector = np.zeros(3)
    vector[axis] = np.radians(degrees)
    return np.asarray(cv2.Rodrigues(vector)[0])


def poses(places: np.ndarray) -> np.ndarray:
    made = np.tile(np.eye(4), (len(places), 1, 1))
    made[:, :3, 3] = places
    return made


def test_a_trajectory_in_another_world_is_right() -> None:
    """Alignment takes any rigid motion of the world away, but no scale."""
    rng = np.random.default_rng(0)
    known = poses(rng.normal(0, 0.05, (20, 3)))
    known[:, :3, :3] = [rotation(each, 1) for each in rng.normal(0, 20, 20)]
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation(140, 2) @ rotation(50, 0), (0.3, -1, 2)
    figures = arithmetic.trajectory_figures(world @ known, known)
    assert max(figures.values()) < 1e-4  # mm and degrees; the arccosine of nearly one is coarse
    doubled = known.copy()
    doubled[:, :3, 3] *= 2
    spread = known[:, :3, 3] - known[:, :3, 3].mean(0)
    ate = arithmetic.trajectory_figures(doubled, known)["ate_rmse_mm"]
    assert ate == pytest.approx(1e3 * np.sqrt(np.mean(np.sum(spread**2, 1))), rel=1e-6)


def test_trajectory_errors_by_hand() -> None:
    """A square of 2 mm, walked; one corner 0.4 mm above it. The best plane does not tilt towards one corner
    of four but along the diagonal, so errors are found by brute force over all turns."""
    known = poses(1e-3 * np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], float))
    estimated = known.copy()
    estimated[2, 2, 3] = 0.4e-3
    figures = arithmetic.trajectory_figures(estimated, known)
    centred = [each[:, :3, 3] - each[:, :3, 3].mean(0) for each in (estimated, known)]
    turns = [rotation(x, 0) @ rotation(y, 1) for x in np.linspace(-9, 9, 91) for y in np.linspace(-9, 9, 91)]
    best = min(np.sqrt(np.mean(np.sum((centred[0] @ turn.T - centred[1]) ** 2, 1))) for turn in turns)
    assert figures["ate_rmse_mm"] == pytest.approx(best * 1e3, rel=0.01)
    assert figures["rpe_mean_mm"] == pytest.approx((0 + 0.4 + 0.4) / 3)
    turned = known.copy()
    turned[3, :3, :3] = rotation(3, 2)
    assert arithmetic.trajectory_figures(turned, known)["rpe_mean_deg"] == pytest.approx(1.0)


def test_scared_takes_the_mean_where_truth_is_known_and_leaves_sparse_frames_out() -> None:
    truth = np.zeros((10, 10), np.float32)
    truth[:2] = 0.1
    depth = np.full((10, 10), 0.103, np.float32)
    depth[0, :5] = 0.099
    depth[1, :4] = 0
    error = arithmetic.mean_depth_error(depth, truth)
    assert error[0] == pytest.approx((5 * 1 + 11 * 3) / 16, abs=1e-3) and error[1] == pytest.approx(16 / 20)
    truth[:] = 0
    truth[0, :9] = 0.1  # 9 %
    assert arithmetic.mean_depth_error(depth, truth) is None


def test_endonerf_counts_masked_pixels_as_black_in_both() -> None:
    rng = np.random.default_rng(1)
    truth = rng.random((64, 64, 3), np.float32)
    picture = (truth + rng.normal(0, 0.05, truth.shape)).clip(0, 1).astype(np.float32)
    tissue = np.zeros((64, 64), bool)
    tissue[:, :32] = True
    black = tissue[..., None]
    error = np.mean((picture * black - truth * black) ** 2, dtype=np.float64)
    assert metrics.paper_psnr(picture, truth, tissue) == pytest.approx(-10 * np.log10(error), abs=1e-4)
    everywhere = np.ones_like(tissue)
    plain = metrics.ssim(picture * black, truth * black, everywhere)
    assert metrics.paper_ssim(picture, truth, tissue) == pytest.approx(plain)
    assert metrics.ssim(picture, truth, tissue) < plain < 1  # black is alike


def test_depth_errors_have_a_sign() -> None:
    """Of ten known pixels eight are given: errors of -1 mm five times, 2 mm twice and 6 mm."""
    truth, depth = np.zeros((4, 4), np.float32), np.full((4, 4), 0.05, np.float32)
    truth.flat[:10] = 0.1
    depth.flat[:10] = [0.099] * 5 + [0.102, 0.102, 0.106, 0, 0]
    figures = arithmetic.depth_figures(depth, truth, np.ones((4, 4), bool))
    assert figures["mae_mm"] == pytest.approx((5 + 4 + 6) / 8, abs=1e-4)
    assert figures["median_mm"] == pytest.approx(1, abs=1e-4)
    assert figures["bias_mm"] == pytest.approx(-1, abs=1e-4)
    assert figures["p90_mm"] == pytest.approx(2 + 0.3 * 4, abs=1e-4)  # between the 7th and the 8th of 8
    assert figures["given"] == 0.8
    assert arithmetic.depth_figures(depth, truth, truth == 0) is None


def test_stereomis_tracks_by_hand() -> None:
    """Images of 512x1024 px: 2 px across and 4 px down are one of 256x256. The first point is right, then 6
    px off across (3 of theirs), then 40 (20: lost), then not seen. The second is 8 px off downwards (2) once
    it is measured, and hidden in the third frame, where it is far off."""
    truth = np.full((2, 4, 2), 200.0)
    found = truth.copy()
    found[0, 1, 0] += 6
    found[0, 2, 0] += 40
    found[0, 3, 0] += 400
    found[1, 1:, 1] += [8, 400, 8]
    visible = np.array([[True, True, True, False], [True, True, False, True]])
    figures = arithmetic.stereomis_figures(found, truth, visible, (512, 1024))
    assert figures["mte_px"] == pytest.approx((6 + 8) / 2)  # medians of 0, 6, 40 and of 0, 8, 8
    # Of 3, 20, 2 and 2: none below 1 or 2, three below 4, 8 and 16.
    assert figures["delta"] == pytest.approx((0 + 0 + 3 * 0.75) / 5)
    assert figures["survival"] == pytest.approx((2 + 4) / 8)


def test_reliability_tells_what_was_said_from_what_was_right() -> None:
    confidence = np.array([0.0, 0.1, 0.55, 0.95, 1.0, 0.9, 0.99])
    bins = reliability(confidence, np.array([0, 1, 1, 1, 1, 0, 1], bool))
    counted = [(each.least, each.most, each.count) for each in bins]
    assert counted == [(0, 0.02, 1), (0.1, 0.2, 1), (0.5, 0.6, 1), (0.9, 1, 4)]
    assert [each.right for each in bins] == [0, 1, 1, 0.75]
    assert bins[3].said == pytest.approx(0.96)
    assert calibration_error(bins) == pytest.approx((0.9 + 0.45 + 4 * 0.21) / 7)
