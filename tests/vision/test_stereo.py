"""Stereo depth: scenes with exact truth, and real recordings."""

import itertools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from frames import make_frame
from places import ROOT

from sags_node import geometry
from sags_node.config.schema import StereoConfig, TissueConfig
from sags_node.errors import UsageError
from sags_node.rig import load_rig, read_rig
from sags_node.sources.pictures import read_picture
from sags_node.types import F32, U8, Camera, RectifiedPair
from sags_node.vision import dense_depth, inverse_search
from sags_node.vision.margin import EDGE_MARGIN
from sags_node.vision.rectify import Rectifier
from sags_node.vision.stereo import StereoDepth
from sags_node.vision.tissue import TissueMask

# ---- stereo: scenes with exact truth ---------------------------------------------------------------------

WIDTH, HEIGHT, BASELINE = 640, 512, 0.0043
CAMERA = Camera(WIDTH, HEIGHT, np.array([[570.0, 0, 319.5], [0, 570.0, 255.5], [0, 0, 1]]), np.eye(4))
ALL = np.ones((HEIGHT, WIDTH), np.bool_)


def make_pair(left: U8, right: U8) -> RectifiedPair:
    return RectifiedPair(0, 0, CAMERA, BASELINE, left, right)


def texture(width: int, seed: int = 0) -> U8:
    """Red spots of several sizes, 30 to 220 grey levels."""
    rng = np.random.default_rng(seed)
    spots = sum(
        sigma * cv2.GaussianBlur(rng.normal(size=(HEIGHT, width)), (0, 0), sigma) for sigma in (1.5, 3, 8)
    )
    gray = np.clip(125 + 35 * spots / spots.std(), 30, 220).astype(np.uint8)
    return np.stack([gray, gray // 2, gray // 2], -1)


def plane_pair(a: float, b: float, c: float) -> tuple[RectifiedPair, F32]:
    """A textured plane of disparity a + b x + c y (px) in the left image, and that disparity."""
    left = texture(WIDTH)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    source = (x + a + c * y) / (1 - b)  # the left column that the right column x shows
    right = cv2.remap(left, source, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return make_pair(left, right), (a + b * x + c * y).astype(np.float32)


def to_disparity(depth: F32) -> F32:
    """The formula is its own inverse; unknown stays 0."""
    return geometry.disparity_to_depth(depth, CAMERA.K[0, 0], BASELINE)


@pytest.mark.parametrize(
    ("width", "height", "scale", "median_px", "p99_px"),
    [(640, 512, 1, 0.05, 0.4), (640, 512, 2, 0.1, 0.6), (640, 512, 4, 0.2, 1.8), (637, 509, 4, 0.4, 1.8)],
)
def test_slanted_plane(width: int, height: int, scale: int, median_px: float, p99_px: float) -> None:
    """Also of a size that the scale does not divide."""
    whole, truth = plane_pair(28.0, 0.02, -0.01)
    part = np.s_[:height, :width]
    camera, truth = Camera(width, height, CAMERA.K, np.eye(4)), truth[part]
    pair = replace(whole, camera=camera, left=whole.left[part], right=whole.right[part])
    depth, confidence = StereoDepth(StereoConfig(scale=scale), camera, BASELINE)(pair, ALL[part])
    known = depth > 0
    error = np.abs(to_disparity(depth) - truth)[known]
    visible = np.s_[:, 60:]  # columns whose match lies inside the right image
    assert known[visible].mean() > 0.95
    assert np.median(error) < median_px
    assert np.percentile(error, 99) < p99_px
    unseen = np.arange(width) + 2 * scale < truth  # left of what the right image shows
    assert known[unseen].mean() < 0.01
    assert np.median(confidence[visible]) > 0.8


def test_rows_off_by_the_calibration_still_match() -> None:
    pair, truth = plane_pair(28.0, 0.02, -0.01)
    lower = cv2.warpAffine(pair.right, np.array([[1.0, 0, 0], [0, 1, 2.5]]), (WIDTH, HEIGHT))
    depth, confidence = StereoDepth(StereoConfig(), CAMERA, BASELINE)(make_pair(pair.left, lower), ALL)
    inside = np.s_[10:-10, 60:]
    known = (depth > 0)[inside]
    assert known.mean() > 0.95
    assert np.median(confidence[inside]) > 0.8
    assert np.median(np.abs(to_disparity(depth) - truth)[inside][known]) < 0.2


@pytest.mark.parametrize("workers", [2, 3, 7])
def test_bands_leave_no_seams(workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each worker takes a band of rows; how many there are changes nothing, in the last digit of confidence
    either. With steps in depth and noise everything depends on what is around."""
    pair, _ = plane_pair(28.0, 0.02, -0.01)
    right = np.where(np.arange(HEIGHT)[:, None, None] // 40 % 2, pair.right, np.roll(pair.right, 6, axis=1))
    noise = np.random.default_rng(1).normal(0, 4, right.shape)
    pair = make_pair(pair.left, np.clip(right + noise, 0, 255).astype(np.uint8))
    found = []
    for count in (1, workers):
        for module in (dense_depth, inverse_search):
            monkeypatch.setattr(module, "thread_count", lambda count=count: count)
        found.append(StereoDepth(StereoConfig(), CAMERA, BASELINE)(pair, ALL))
    for alone, shared in zip(*found, strict=True):
        assert (alone > 0).mean() > 0.3 and np.array_equal(alone, shared)


def test_a_cut_to_another_scene_leaves_no_trace() -> None:
    near, _ = plane_pair(70.0, 0.0, 0.0)
    far, _ = plane_pair(15.0, 0.01, 0.0)
    stereo = StereoDepth(StereoConfig(), CAMERA, BASELINE)
    first, _ = stereo(far, ALL)
    stereo(near, ALL)
    again, _ = stereo(far, ALL)
    np.testing.assert_array_equal(again, first)


@pytest.mark.parametrize(
    ("what", "matched", "sure"), [("plain", 0.0, 0.02), ("noise", 0.1, 0.02), ("other scenes", 0.05, 0.0125)]
)
def test_eyes_that_have_nothing_in_common_are_seldom_matched(what: str, matched: float, sure: float) -> None:
    rng, sigma = np.random.default_rng(0), 3.0 * (what == "noise")
    eyes = [np.rint(rng.normal(128, sigma, (HEIGHT, WIDTH, 3))).astype(np.uint8) for _ in range(2)]
    if what == "other scenes":
        eyes = [texture(WIDTH, seed) for seed in (1, 2)]
    depth, confidence = StereoDepth(StereoConfig(), CAMERA, BASELINE)(make_pair(*eyes), ALL)
    assert np.isfinite(depth).all() and np.isfinite(confidence).all()
    assert (depth > 0).mean() <= matched and confidence.mean() < sure


def test_depth_ends_at_the_tissue_edge_and_at_the_range() -> None:
    pair, truth = plane_pair(28.0, 0.02, -0.01)
    tissue = ALL.copy()
    tissue[200:300, 300:] = False
    config = StereoConfig(max_depth=0.08)
    depth, confidence = StereoDepth(config, CAMERA, BASELINE)(pair, tissue)
    assert not depth[195:305, 295:].any()
    assert depth[:190, 300:].any()
    assert depth.max() <= 0.08 * 1.01
    assert depth[depth > 0].min() >= 0.03 * 0.99
    assert not confidence[depth == 0].any()
    assert (to_disparity(truth) > 0.08).any()  # there was something to cut off


@pytest.mark.parametrize(
    ("config", "camera", "baseline", "words"),
    [
        (StereoConfig(scale=4), Camera(100, 100, CAMERA.K, np.eye(4)), BASELINE, "too few"),
        (StereoConfig(), CAMERA, 4.3, "baseline"),
        (
            StereoConfig(),
            CAMERA,
            BASELINE / 0.0254,
            "169 mm apart .* convert 'my rig' -o FOLDER --unit inch; if that baseline is right, set vision",
        ),
    ],
)
def test_what_cannot_be_matched_is_refused(
    config: StereoConfig, camera: Camera, baseline: float, words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        StereoDepth(config, camera, baseline, "my rig")


@pytest.mark.parametrize(("baseline", "max_depth"), [(0.012, 0.3), (0.063, 0.3), (0.12, 1.0)])
def test_eyes_of_devices_that_are_no_endoscope_are_taken(baseline: float, max_depth: float) -> None:
    """A wide endoscope; a ZED mini; a ZED, whose user says how far it looks."""
    assert not StereoDepth(StereoConfig(max_depth=max_depth), CAMERA, baseline).findings


# ---- stereo and tissue: real recordings ------------------------------------------------------------------


def test_depth_of_a_real_session_is_right_and_confidence_tells_good_from_bad(data_folder: Path) -> None:
    folder = data_folder / "d4d_pull"
    video = cv2.VideoCapture(str(folder / "2025_03_06-16_49_40_combined_2x2.mp4"))
    rectifier = Rectifier(load_rig(ROOT / "calib/d4d"), 640, 512)
    find_tissue = TissueMask(TissueConfig(exclude=((0, 0, 367, 37),)), rectifier)
    stereo = StereoDepth(StereoConfig(), rectifier.camera, rectifier.baseline)
    found, wanted = [], 0
    for index in itertools.takewhile(lambda _: video.grab(), itertools.count()):
        if index % 20:
            continue
        picture = cv2.cvtColor(video.retrieve()[1], cv2.COLOR_BGR2RGB)[:540]
        tool = cv2.imread(str(folder / f"toolmask/{index:04d}.png"), cv2.IMREAD_GRAYSCALE) > 127
        reference = cv2.imread(str(folder / f"depth_mm_x100/{index:04d}.png"), cv2.IMREAD_UNCHANGED) * 1e-5
        frame = make_frame(picture[:, :675], picture[:, 675:], ~tool)
        pair = rectifier(frame)
        mask = find_tissue(frame, pair)
        depth, confidence = stereo(pair, mask)
        truth = cv2.resize(reference, (640, 512), interpolation=cv2.INTER_NEAREST)
        known = mask & (truth > 0) & (depth > 0)
        found.append((np.abs(depth - truth)[known] * 1e3, confidence[known]))
        side = 2 * round(EDGE_MARGIN * 640) + 1  # so near to an instrument depth is not asked for
        inner = cv2.erode(mask.view(np.uint8), np.ones((side, side), np.uint8)) > 0
        wanted += int((inner & (truth > 0)).sum())
    error, confidence = (np.concatenate(each) for each in zip(*found, strict=True))
    assert np.median(error) < 1.05  # the reference itself is good to about 1 mm
    assert np.percentile(error, 90) < 3.6
    assert len(error) / wanted > 0.89  # the strip that the right eye does not see is 4 %
    quarters = [(confidence > low) & (confidence <= low + 0.25) for low in (0, 0.25, 0.5, 0.75)]
    medians = [np.median(error[quarter]) for quarter in quarters]
    assert medians == sorted(medians, reverse=True)
    assert medians[0] > 3 * medians[-1]  # where it is worst, beside instruments, there is no depth at all


def test_metric_depth_against_a_ct_surface(data_folder: Path) -> None:
    """Maier-Hein et al., TMI 2014: the CT surface is given in the left raw camera's frame, millimetres."""
    folder = data_folder / "tmi_ct_pair"
    rig = read_rig(folder, (720, 576))
    rectifier = Rectifier(rig, 720, 576)
    pair = rectifier(make_frame(read_picture(folder / "left.png"), read_picture(folder / "right.png")))
    stereo = StereoDepth(StereoConfig(), rectifier.camera, rectifier.baseline)
    depth, _ = stereo(pair, np.ones((576, 720), np.bool_))
    surface = np.loadtxt(folder / "Stereo_SD_d_complete_22_CT_cut.xyz") * 1e-3
    pixels, truth = seen_points(rectifier.camera, surface @ rig.left.R.T)
    measured = depth[pixels[:, 1], pixels[:, 0]]
    known = measured > 0
    error_mm = (measured - truth)[known] * 1e3
    assert known.mean() > 0.9
    assert abs(np.median(error_mm)) < 1.0
    assert np.median(np.abs(error_mm)) < 1.0
    assert np.percentile(np.abs(error_mm), 90) < 2.0


def seen_points(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and depths of the points that no other point within 6 px hides: the organ is folded."""
    projected, depths = geometry.project(camera, points)
    pixels = np.rint(projected).astype(int)
    front = np.full((camera.height, camera.width), np.inf, np.float32)
    np.minimum.at(front, (pixels[:, 1], pixels[:, 0]), depths)
    front = cv2.erode(front, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (13, 13)))
    seen = depths < front[pixels[:, 1], pixels[:, 0]] + 2e-3
    return pixels[seen], depths[seen]


def test_large_disparities_and_highlights_of_a_beating_heart(data_folder: Path) -> None:
    """No reference here: the right image, fetched by the depth found, must look like the left one.

    Rows above 70 hold instruments; columns left of 100 are not in the right image.
    """
    folder = data_folder / "hamlyn_invivo_001_100"
    rectifier = Rectifier(load_rig(ROOT / "calib/hamlyn_heart"), 360, 288)
    stereo = StereoDepth(StereoConfig(scale=2), rectifier.camera, rectifier.baseline)
    columns, rows = np.meshgrid(np.arange(360, dtype=np.float32), np.arange(288, dtype=np.float32))
    for index in (1, 50, 100):
        left, right = (read_picture(folder / side / f"{index:04d}.jpg") for side in ("left", "right"))
        depth, _ = stereo(rectifier(make_frame(left, right)), np.ones((288, 360), np.bool_))
        known = depth > 0
        disparity = geometry.disparity_to_depth(depth, rectifier.camera.K[0, 0], rectifier.baseline)
        heart = np.s_[70:, 100:]
        low, high = np.percentile(disparity[heart][known[heart]], [1, 99])
        assert 56 < low < high < 100
        assert known[heart].mean() > 0.85
        fetched = cv2.remap(right, columns - disparity, rows, cv2.INTER_LINEAR)
        matched = np.abs(fetched.astype(np.float32) - left)[known].mean()
        unmatched = np.abs(right.astype(np.float32) - left)[known].mean()
        assert matched < 0.25 * unmatched
