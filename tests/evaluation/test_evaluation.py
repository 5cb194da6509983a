"""What is kept, the measuring of a run with known answers, golden comparison and the report."""

import json
import re
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from command_line import refused
from engine_scenes import as_bytes, rasterize, round_gaussians, rows
from golden import Golden, Tolerance, compare, read_golden, write_golden
from places import ROOT

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import LaunchConfig
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import SagsError, UsageError
from sags_node.phantom.scene import Phantom
from sags_node.rig import rectified_rig, save_rig
from sags_node.tools.evaluation import plots
from sags_node.tools.evaluation.figures import MEANS, POOLED
from sags_node.tools.evaluation.measure import MeasureOptions, Measurer
from sags_node.tools.evaluation.plots import Series, line_plot
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.tools.evaluation.report import write_report
from sags_node.tools.evaluation.run import MappedFrame, Run
from sags_node.tools.evaluation.session import evaluate
from sags_node.tools.evaluation.summary import STAGES, summarise
from sags_node.types import (
    Bool,
    Camera,
    FrameResult,
    Gaussians,
    Observation,
    RectifiedPair,
    Reference,
    RenderedView,
    Snapshot,
    StereoFrame,
    StereoRig,
)
from sags_node.vision.rectify import Rectifier

WIDTH, HEIGHT, FOCAL, BASELINE, DEPTH = 160, 128, 250.0, 0.004, 0.1  # disparity 10 px
K = np.array([[FOCAL, 0, 79.5], [0, FOCAL, 63.5], [0, 0, 1]])
CAMERA = Camera(WIDTH, HEIGHT, K, np.eye(4))
PERIOD_NS = 33_333_333
SPEED = np.array([0.015, 0.006, 0.0], np.float32)  # m/s: 1.25 and 0.5 px a frame
FRAMES = 20
DEFAULTS = MeasureOptions()
CONFIG = load_launch(None, ["device:=cpu", "publish.detail:=false", "vision.tissue.dilate:=0"])


def rig() -> StereoRig:
    return rectified_rig("synthetic", WIDTH, HEIGHT, K, BASELINE)


def tissue_at(seconds: float) -> Gaussians:
    """A textured sheet, larger than the view, that slides with SPEED."""
    spacing = 2 * DEPTH / FOCAL
    x, y = np.meshgrid(np.arange(-60, 60), np.arange(-49, 49))
    means = np.stack([x.ravel() * spacing, y.ravel() * spacing, np.full(x.size, DEPTH)], 1)
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.random((98, 120, 3), np.float32), (0, 0), 1.5).reshape(-1, 3)
    moved = means.astype(np.float32) + SPEED * np.float32(seconds)
    return round_gaussians(moved, 0.6 * spacing, np.clip((texture - 0.5) * 4 + 0.5, 0, 1))


def stereo_frame(frame_id: int) -> StereoFrame:
    """What two cameras with different exposures see, with an instrument on the left and exact truth."""
    stamp = frame_id * PERIOD_NS
    tissue = np.ones((HEIGHT, WIDTH), bool)
    tissue[40:60, 100:] = False
    left = rasterize(tissue_at(stamp * 1e-9), CAMERA).rgb.copy()
    left[~tissue] = (200, 255, 200)
    planes = make_rasterizer("numba", WIDTH, HEIGHT).forward(
        tissue_at(stamp * 1e-9), CAMERA.moved_right(BASELINE)
    )
    right = as_bytes(0.8 * colours_of(planes) + 0.05)
    right[40:60, 88:] = (200, 255, 200)
    points = tissue_at(0).means[7350:7400].astype(np.float64) + SPEED * stamp * 1e-9
    reference = Reference(
        depth=np.full((HEIGHT, WIDTH), DEPTH, np.float32), points=points, points_visible=np.ones(50, bool)
    )
    return StereoFrame(frame_id, stamp, stamp, left, right, tissue=tissue, reference=reference)


def frame_result(frame: StereoFrame, velocity: np.ndarray, late: float = 0.0) -> FrameResult:
    """What a mapper says that knows the truth, or knows it `late` seconds late."""
    gaussians = tissue_at(frame.t_capture_ns * 1e-9 - late)
    velocities = np.tile(velocity.astype(np.float32), (len(gaussians), 1))
    ids = frame.frame_id, frame.t_capture_ns
    assert frame.tissue is not None
    measured = np.where(frame.tissue, np.float32(DEPTH + 0.002), np.float32(0))
    view = rasterize(gaussians, CAMERA)
    return FrameResult(
        pair=RectifiedPair(*ids, CAMERA, BASELINE, frame.left, frame.right),
        observation=Observation(
            *ids, CAMERA, frame.left, frame.left[..., 0], frame.tissue, measured, np.ones_like(measured)
        ),
        snapshot=Snapshot(*ids, 3 * frame.frame_id, gaussians, velocities, CAMERA, 0.01, {"iterations": 2}),
        views={"left": RenderedView(*ids, CAMERA, view.colours, view.depth, view.alpha)},
        epoch=0,
        timings_ms={"rectify": 1.0, "map": 20.0},
        skipped={"frame": "equals its predecessor"} if frame.frame_id == 3 else {},
    )


def with_right_eye(result: FrameResult) -> FrameResult:
    """The same, drawn for the right eye too."""
    camera = CAMERA.moved_right(BASELINE)
    drawn = rasterize(result.snapshot.gaussians, camera)
    return replace(result, views={**result.views, "right": drawn})


def measured_run(
    frames: list[StereoFrame],
    velocity: np.ndarray,
    options: MeasureOptions = DEFAULTS,
    late: float = 0.0,
    dropped: int | None = None,
    change: Callable[[FrameResult], FrameResult] = lambda result: result,
    config: LaunchConfig = CONFIG,
) -> Measurer:
    """Keep a run that plays `frames`, with what it made of each changed, and measure it."""
    with Run() as run:
        for frame in frames:
            if not options.holds_out(frame.frame_id) and frame.frame_id != dropped:
                run.add(change(frame_result(frame, velocity, late)), 21.0, frame.t_capture_ns)
        receipt = Receipt(rig(), (WIDTH, HEIGHT), options.lpips_weights)
        measurer = Measurer(run, Rectifier(rig(), WIDTH, HEIGHT), config, options, receipt)
        measurer.run(frames, lambda what, done: None)
    return measurer


def summary_of(
    measurer: Measurer, options: MeasureOptions = DEFAULTS, **segments: tuple[int, int]
) -> dict[str, Any]:
    return summarise("synthetic", measurer.rows, options, segments, 33.0)


@pytest.fixture(scope="module")
def frames() -> list[StereoFrame]:
    return [stereo_frame(frame_id) for frame_id in range(FRAMES)]


# ---- what is kept ------------------------------------------------------------------------------------------


def test_a_run_gives_back_every_bit_and_leaves_nothing(frames: list[StereoFrame]) -> None:
    rng = np.random.default_rng(0)
    with Run() as run:
        folder, kept = run.folder, []
        for frame in frames[:3]:
            result = frame_result(frame, SPEED)
            tissue, depth = rng.random((HEIGHT, WIDTH)) < 0.5, rng.random((HEIGHT, WIDTH), np.float32)
            seen = replace(result.observation, tissue=tissue, depth=depth)
            kept.append(replace(result, observation=seen))
            run.add(kept[-1], 12.5, 99, 40.25)
        assert run.frame_ids == [0, 1, 2] and run.read(3) is None
        for frame_id, result in enumerate(kept):
            view, back, given = result.views["left"], run.read(frame_id), result.snapshot
            assert isinstance(back, MappedFrame)
            for got, wanted in (
                (back.rgb, view.rgb),
                (back.depth, view.depth),
                (back.tissue, result.observation.tissue),
                (back.measured_depth, result.observation.depth),
                (back.snapshot.velocities, given.velocities),
                (back.snapshot.camera.K, CAMERA.K),
                *(
                    (getattr(back.snapshot.gaussians, name), getattr(given.gaussians, name))
                    for name in ("means", "quats", "scales", "opacities", "colors", "ids")
                ),
            ):
                np.testing.assert_array_equal(got, wanted, strict=True)
            for name in ("frame_id", "t_capture_ns", "counts"):
                assert getattr(back.snapshot, name) == getattr(given, name)
            assert back.facts.timings_ms == result.timings_ms
            assert (back.facts.frame_ms, back.facts.t_shown_ns, back.facts.latency_ms) == (12.5, 99, 40.25)
    assert not folder.exists()


@pytest.mark.fault("disk: what a measurement keeps cannot be written")
def test_a_run_says_what_to_do_when_it_cannot_write(frames: list[StereoFrame]) -> None:
    with Run() as run:
        run.folder.rmdir()
        with pytest.raises(SagsError, match="set TMPDIR"):
            run.add(frame_result(frames[0], SPEED), 1.0, 0)


# ---- a run with known answers ----------------------------------------------------------------------------


def test_a_perfect_model_is_measured_as_perfect(frames: list[StereoFrame]) -> None:
    summary = summary_of(measured_run(frames, SPEED / 0.8))
    assert summary["online"]["psnr"] > 60  # the left images are its own renders, to the last bit
    assert summary["online"]["ssim"] > 0.999
    assert summary["predict"]["psnr"] > 45  # rounding to grey levels alone is 58 dB
    assert summary["predict_3"]["psnr"] > 45  # motion is even
    copies = [summary[group]["copy_psnr"] for group in ("predict", "predict_2", "predict_3")]
    assert copies == sorted(copies, reverse=True) and copies[0] > copies[2] + 3
    assert summary["heldout"]["psnr"] > 45 > summary["heldout"]["copy_psnr"] + 3
    for figure in ("psnr", "carried_psnr"):
        assert summary["between"][figure] > 45 > summary["between"]["mean_psnr"] + 3
    assert summary["novel"]["psnr"] > 45  # despite the other exposure, and the instrument
    assert summary["depth"]["median_mm"] < 0.01
    assert summary["depth"]["coverage"] > 0.99
    assert summary["measured_depth"]["median_mm"] == pytest.approx(2.0, abs=1e-3)
    assert summary["track"]["median_mm"] < 1e-3
    assert summary["track"]["lost"] == 0


def test_the_right_eye_is_measured_where_it_is_shown(frames: list[StereoFrame]) -> None:
    """The truth drawn for it is better than the warp, whose depth is 2 mm off, and than the image of the
    frame before: tissue has moved since."""
    velocity = SPEED / 0.8
    assert summary_of(measured_run(frames, velocity))["right"] is None
    measurer = measured_run(frames, velocity, MeasureOptions(paper_psnr=True), change=with_right_eye)
    for row in measurer.rows:  # nothing is measured that no table shows
        assert all(figures.keys() <= set(MEANS[group]) for group, figures in row.figures.items())
    found = summary_of(measurer)["right"]
    # dB: the truth is in steps of 8 bits, and so is 0.8 of what was shown
    rounding = 10 * np.log10(1 + 0.8**2)
    assert found["psnr"] == pytest.approx(found["model_psnr"] - rounding, abs=0.2)
    assert found["psnr"] > 45 > max(found["warp_psnr"], found["copy_psnr"]) + 3
    assert 0.5 < found["coverage"] <= 1


def test_prediction_uses_velocities_and_their_share(frames: list[StereoFrame]) -> None:
    exact = summary_of(measured_run(frames, SPEED / 0.8))
    taken_whole = summary_of(measured_run(frames, SPEED))
    still = summary_of(measured_run(frames, np.zeros(3)))
    for group in ("predict", "heldout"):
        assert exact[group]["psnr"] > taken_whole[group]["psnr"] + 3 > still[group]["psnr"] + 6
    assert still["between"] == exact["between"]  # both frames around are known: no velocity is needed
    assert still["predict"]["psnr"] == pytest.approx(still["predict"]["copy_psnr"], abs=1.5)
    assert exact["online"] == still["online"]


def test_a_late_model_is_measured_as_late(frames: list[StereoFrame]) -> None:
    late = 2 * PERIOD_NS * 1e-9
    summary = summary_of(measured_run(frames, SPEED, late=late))
    assert summary["online"]["psnr"] < 30
    assert summary["track"]["median_mm"] < 0.01  # late, but it moves along


def test_counts_and_segments(frames: list[StereoFrame]) -> None:
    measurer = measured_run(frames, SPEED / 0.8, dropped=12)
    summary = summary_of(measurer, motion=(2, 6), never=(100, 200))
    assert [summary[key] for key in ("frames", "processed", "held_out", "dropped")] == [20, 16, 3, 1]
    inside = [row.figures["online"]["psnr"] for row in measurer.rows if 2 <= row.frame_id <= 6]
    assert summary["online"]["motion"]["psnr"] == pytest.approx(np.mean(inside), abs=1e-4)
    assert summary["online"]["never"] is None
    assert summary["heldout"]["motion"] is None  # frames 1, 9, 17
    assert summary["novel"]["motion"] is not None  # every fifth processed frame
    assert summary["latency_ms"] is None  # nothing was published
    assert summary["frame_ms"]["p50"] == 21.0
    assert summary["stage_ms"]["map"] == 20.0
    assert set(STAGES) <= summary["stage_ms"].keys() and summary["stage_ms"]["publish"] is None
    assert summary["iterations_per_frame"] == 2
    assert summary["skipped"] == {"frame": 1}
    assert summary["gaussians"]["max"] == len(tissue_at(0))
    assert summary["online"]["lpips"] is None and summary["lpips_backbone"] is None
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


def test_papers_count_with_the_masks_as_they_were_given(frames: list[StereoFrame]) -> None:
    """Whatever margin the node puts around instruments, of frames that it was shown and of those held out."""

    def figures(margin: int) -> dict[str, Any]:
        def eroded(result: FrameResult) -> FrameResult:
            seen = result.observation
            tissue = cv2.erode(seen.tissue.view(np.uint8), np.ones((2 * margin + 1,) * 2)) > 0
            return replace(result, observation=replace(seen, tissue=tissue))

        config = load_launch(None, ["publish.detail:=false", f"vision.tissue.dilate:={margin}"])
        options = MeasureOptions(paper_psnr=True)
        measurer = measured_run(frames[:2], SPEED, options, late=0.1, change=eroded, config=config)
        return {group: row.figures[group] for row in measurer.rows for group in row.figures}

    plain, margined = figures(0), figures(2)
    for group in ("online", "heldout"):
        assert margined[group]["paper_psnr"] == plain[group]["paper_psnr"]
        assert margined[group]["paper_ssim"] == plain[group]["paper_ssim"]
        assert margined[group]["psnr"] != plain[group]["psnr"]


def test_instruments_that_cover_the_first_frames_leave_the_rest_measured(frames: list[StereoFrame]) -> None:
    """There is no model then: nothing lies between it and the next frame, and no depth calls itself sure."""

    def covered(result: FrameResult) -> FrameResult:
        if result.pair.frame_id > 0:
            return result
        empty, none = rows(tissue_at(0), np.zeros(0, int)), np.zeros((HEIGHT, WIDTH), np.float32)
        return replace(
            result,
            observation=replace(result.observation, tissue=none > 0, depth=none),
            snapshot=replace(result.snapshot, gaussians=empty, velocities=np.zeros((0, 3), np.float32)),
            views={"left": rasterize(empty, CAMERA)},
        )

    summary = summary_of(measured_run(frames[:6], SPEED, change=covered))
    assert summary["between"] is None and summary["heldout"] is not None
    assert summary["online"]["psnr"] > 60
    assert summary["depth_confidence"] is None


def test_what_was_not_known_is_null(frames: list[StereoFrame]) -> None:
    blind = [replace(frame, reference=None) for frame in frames[:4]]
    options = MeasureOptions(hold_out=0, paper_psnr=True)
    summary = summary_of(measured_run(blind, SPEED, options, late=0.1), options)
    assert summary["depth"] is None and summary["track"] is None and summary["heldout"] is None
    assert summary["online"]["paper_psnr"] > summary["online"]["psnr"]
    assert summary["held_out"] == 0


# ---- golden ----------------------------------------------------------------------------------------------


def test_golden_catches_a_planted_change(tmp_path: Path) -> None:
    summary: dict[str, Any] = {
        "frames": 10,
        "online": {"psnr": 34.2, "ssim": 0.91, "motion": {"psnr": 32.0}},
        "track": None,
        "frame_ms": {"p50": 30.0},
        "settings": {"overrides": ["seed:=1"]},
    }
    tolerances = {"online": Tolerance(absolute=0.05), "online.ssim": Tolerance(relative=0.001)}
    file = tmp_path / "golden.json"
    write_golden(file, Golden(command="make golden", tolerances=tolerances, figures={}), summary)
    golden = read_golden(file)
    assert "frame_ms" not in golden.figures and compare(summary, golden) == []
    near = {"psnr": 34.24, "ssim": 0.9105, "motion": {"psnr": 32.0}}
    assert compare(summary | {"frame_ms": {"p50": 300.0}, "online": near}, golden) == []
    far = {"psnr": 34.26, "ssim": 0.912, "motion": {"psnr": None}}
    *said, fix = compare(summary | {"frames": 9, "online": far, "novel": {"psnr": 30.0}}, golden)
    other = "frames novel.psnr online.motion.psnr online.psnr online.ssim".split()
    assert [line.split(":")[0] for line in said] == other and "make golden" in fix
    assert "34.26" in said[3] and "34.2" in said[3] and "0.05" in said[3]
    del summary["online"]
    assert any("online.psnr: missing" in line for line in compare(summary, golden))


# ---- report ----------------------------------------------------------------------------------------------


def test_report_opens_and_shows_the_worst_frame(frames: list[StereoFrame], tmp_path: Path) -> None:
    spoilt = frames.copy()
    spoilt[7] = replace(frames[7], left=255 - frames[7].left)  # unlike anything the model shows
    measurer = measured_run(spoilt, SPEED / 0.8)
    summary = {**summary_of(measurer, motion=(2, 5)), "session": "<b>name</b>"}
    pictures = measurer.gallery.pictures
    assert [picture.frame_id for picture in pictures] == [0, 7, 10, 19]
    first = measurer.rows[0]
    assert first.facts is not None
    measurer.rows[0] = replace(first, facts=replace(first.facts, warnings={"picture_dark": "dark < black"}))
    file = write_report(tmp_path / "out", summary, measurer.rows, pictures, "overlay.mp4")
    text = file.read_text(encoding="utf-8")
    kinds = Counter(re.findall(r'<img[^>]* src="([^"]*?);base64,', text))
    assert kinds == {"data:image/jpeg": 16, "data:image/svg+xml": 4} and text.count("<img") == 20
    within: list[str] = []  # every element is closed
    for closes, tag, is_closed in re.findall(r"<(/?)([a-z][a-z0-9]*)[^>]*?(/?)>", text):
        if closes:
            assert within.pop() == tag
        elif tag not in ("img", "meta") and not is_closed:
            within.append(tag)
    assert within == []
    assert len(text) < 2_000_000
    assert "frame 7," in text and "the worst" in text
    assert "dark &lt; black</td><td>1 frames, 0 to 0" in text
    assert "<b>name" not in text and "http" not in text
    order = [text.index(each) for each in ("overlay.mp4", "<h2>Over time", "<h2>Figures", "<h2>Images")]
    assert order == sorted(order)
    style, body = text.split("</style>")
    assert {name for used in re.findall(r'class="([^"]+)"', body) for name in used.split()} == (
        set(re.findall(r"\.([a-z]+)", style.split("<style>")[1]))
    )
    groups = text[order[2] : order[3]]
    assert "the image before, shown again:" in groups and "stereo alone:" in groups
    assert "<td></td></tr><tr>" not in groups.replace("\n", "") and "None" not in groups and "{" not in groups
    sheet = cv2.imread(str(file.parent / "sheet.png"))
    assert sheet.shape == (4 * 288, 4 * 360, 3)


def test_report_of_a_run_without_anything_optional(frames: list[StereoFrame], tmp_path: Path) -> None:
    """Of a live run with detail what is shown stands there, which is neither the model nor has its error."""
    measurer = measured_run([replace(frames[0], reference=None)], SPEED, MeasureOptions(hold_out=0))
    live = [replace(row, figures={"shown": row.figures["online"]}) for row in measurer.rows]
    for told, columns in ((measurer.rows, "camera model depth error"), (live, "camera shown depth")):
        file = write_report(tmp_path, summary_of(measurer), told, measurer.gallery.pictures)
        text = file.read_text()
        assert re.findall("<figcaption>(.+?)</figcaption>", text) == columns.split()
        assert ("The error is brightest" in text) == ("error" in columns)


def test_a_plot_is_valid_svg_with_a_gap_where_nothing_is_known() -> None:
    points = [(0, 10.0), (1, 35.0), (2, float("nan")), (3, 20.0), (4, 22.0)]
    spans = {"motion": (3, 99), "half": (-1, 2)}
    svg = line_plot("a < b, $5 and $6", [Series("one", "#123456", points)], spans)
    tree = ElementTree.fromstring(svg)
    texts = {text.text for text in tree.iter("{http://www.w3.org/2000/svg}text")}
    assert {"a < b, $5 and $6", "motion"} <= texts and "half" not in texts
    lines = [each.attrib for each in tree.iter("{http://www.w3.org/2000/svg}path")]
    (line,) = (each["d"] for each in lines if "stroke: #123456" in each.get("style", ""))
    assert line.count("M") == 2 and line.count("L") == 2
    numbers = np.array(line.replace("M", "").replace("L", "").split(), float).reshape(-1, 2)
    assert numbers[1, 1] < numbers[0, 1]  # larger is higher
    assert line_plot("empty", [Series("one", "#123456", [])], {}) == ""


def test_the_names_of_all_lines_of_a_report_lie_inside_it() -> None:
    names = ["the model alone, of a frame that it learnt from", "the image before, again", "never seen"]
    svg = line_plot("", [Series(name, "#123456", [(0, 1.0), (1, 2.0)]) for name in names], {})
    (width,) = re.findall(r'viewBox="0 0 ([0-9.]+)', svg)
    for name in names:
        (begin,) = re.findall(rf' x="([0-9.]+)"[^>]*>{name}<', svg)
        assert float(begin) + 5 * len(name) < float(width)  # pt a letter of this size, at most


def test_without_matplotlib_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(plots, "find_spec", lambda name: None)
    for command in (("eval", "--report"), ("demo", "--out")):
        refused(2, *command, tmp_path / "out", said=("pip install '.[report]'",))
    assert not (tmp_path / "out").exists()


# ---- whole sessions --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def session_folder(frames: list[StereoFrame], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The synthetic session as a recording on disk, with its calibration and its truth."""
    folder = tmp_path_factory.mktemp("session")
    save_rig(rig(), folder / "calib")
    for name in ("left", "right", "tools", "depth"):
        (folder / name).mkdir()
    for frame in frames:
        assert frame.tissue is not None and frame.reference is not None
        assert frame.reference.depth is not None
        pictures = {
            "left": frame.left[..., ::-1],
            "right": frame.right[..., ::-1],
            "tools": np.where(frame.tissue, 0, 255).astype(np.uint8),
            "depth": (frame.reference.depth * 1e5).round().astype(np.uint16),
        }
        for name, picture in pictures.items():
            cv2.imwrite(str(folder / name / f"{frame.frame_id:04d}.png"), picture)
    points = np.stack([frame.reference.points for frame in frames if frame.reference is not None])
    np.savez(folder / "tracks.npz", points=points, visible=np.ones(points.shape[:2], bool))
    (folder / "launch.yaml").write_text(
        "source: {kind: folders, left: left, right: right, tools: tools, rate: 30,"
        " reference: {depth: depth, tracks: tracks.npz}}\n"
        "rig: calib\nmapping: {max_gaussians: 12000}\nsegments: {motion: [5, 14]}\n"
    )
    return folder


def test_a_session_in_steps_is_measured_and_reproducible(session_folder: Path) -> None:
    first, second = (evaluate(session_folder, iterations=1).summary for _ in range(2))
    assert compare(second, Golden(command="", figures=first)) == []
    assert first["session"] == session_folder.name
    assert [first[key] for key in ("frames", "processed", "held_out", "dropped")] == [20, 17, 3, 0]
    assert first["online"]["ssim"] > 0.9 and first["online"]["motion"]["ssim"] > 0.9
    assert first["heldout"]["ssim"] > 0.8 and first["novel"]["psnr"] > 28
    assert first["depth"]["median_mm"] < 1.5 and first["depth"]["coverage"] > 0.9
    assert first["track"]["median_px"] < 2 and first["track"]["lost"] < 0.05
    assert first["iterations_per_frame"] == 1 and first["budget_ms"] is None
    assert first["latency_ms"] is None
    assert first["settings"]["depth_reference"] == "exact"


def test_a_recording_without_truth_is_measured_against_itself(session_folder: Path) -> None:
    """The sheet slides by |SPEED| all the time. Played backwards from the last frame it comes back."""
    launch = (session_folder / "launch.yaml").read_text()
    start = launch.index(" reference:")
    own = session_folder / "own.yaml"
    own.write_text(launch[:start].rstrip(",") + "}" + launch[launch.index("\nrig:") :])
    options = MeasureOptions(hold_out=0, second=True)
    outcome = evaluate(own, options=options, iterations=2)
    found = outcome.summary
    assert found["depth"] is None and found["track"] is None and found["second_run"] == {"frames": FRAMES}
    slid_mm = float(np.linalg.norm(SPEED)) * (FRAMES - 1) * PERIOD_NS * 1e-6
    assert found["forth_back"]["moved_mm"] == pytest.approx(slid_mm, rel=0.1)
    assert found["forth_back"]["median_mm"] < slid_mm / 10  # the same bounds as beside true points
    assert found["forth_back"]["median_px"] < 2 and found["forth_back"]["lost"] < 0.5
    assert found["stereo"]["median_mm"] < 1.5 and found["stereo"]["motion"]["coverage"] > 0.9
    assert found["stereo"]["stereo_coverage"] < found["stereo"]["coverage"] <= 1
    assert found["hidden"]["psnr"] > found["hidden"]["copy_psnr"]  # the sheet slides on, the last image not
    assert found["right"]["psnr"] > 20 and found["right"]["warp_psnr"] > 20
    for row in outcome.rows:
        assert all(figures.keys() <= set(MEANS[group]) for group, figures in row.figures.items())
    known = evaluate(session_folder, options=options, iterations=2).summary
    assert known["stereo"] is None and known["forth_back"] is None  # the truth says more
    assert known["depth"]["median_mm"] < 1.5 and known["track"]["lost"] < 0.05
    assert known["right"] == found["right"] and known["hidden"] == found["hidden"]


def test_a_segment_is_of_frames_of_the_recording(session_folder: Path) -> None:
    """With a stride of 2 its frames 5 to 14 are those played as 3 to 7."""
    outcome = evaluate(session_folder, ["source.stride:=2"], MeasureOptions(0), iterations=0)
    inside = [row.figures["online"]["psnr"] for row in outcome.rows if 5 <= 2 * row.frame_id <= 14]
    assert outcome.summary["segments"] == {"motion": [3, 7]} and len(inside) == 5
    assert outcome.summary["online"]["motion"]["psnr"] == pytest.approx(np.mean(inside), abs=1e-4)
    config = load_launch(None, ["segments:={whole: [0, 14], none: [13, 14]}", "source.stride:=4"])
    assert config.played_segments == {"whole": (0, 3), "none": (4, 3)}


def test_views_from_aside_are_compared_with_truth_of_their_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Part of a recording of 15 frames: every second one from the seventh."""
    looked_at: list[float] = []
    nothing = np.zeros((HEIGHT, WIDTH, 3), np.float32), np.zeros((HEIGHT, WIDTH), np.float32)

    def still(phantom: Phantom, phase: float) -> Any:
        looked_at.append(phase)
        return SimpleNamespace(look=lambda camera, samples: nothing)

    monkeypatch.setattr(Phantom, "still", still)
    scene = ["source.seconds:=0.5", f"source.width:={WIDTH}", f"source.height:={HEIGHT}"]
    part = ["source.start:=0.2", "source.stride:=2", "source.frames:=4"]
    evaluate(None, [*scene, *part], MeasureOptions(0, aside=True), iterations=0)
    assert looked_at == [6 / 15, 8 / 15, 10 / 15, 12 / 15]


def test_real_time_is_measured(session_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    played, options = ["source.rate:=10", "ns:=a/b"], MeasureOptions(hold_out=0)
    outcome = evaluate(session_folder, played, options, "realtime")
    summary = outcome.summary
    assert summary["frames"] == 20 and summary["held_out"] == 0
    assert 1 <= summary["processed"] == 20 - summary["dropped"]
    assert summary["latency_ms"]["p50"] > 0 and summary["rss_mb"]["max"] > 50
    assert summary["frame_ms"]["p50"] <= summary["latency_ms"]["max"]
    assert summary["shown"]["ssim"] > 0.95 and summary["online"] is None
    assert summary["predict"]["copy_psnr"] > 20
    assert summary["depth"]["median_mm"] < 1.5 and summary["settings"]["depth_reference"] == "exact"
    assert outcome.pictures[0].render.shape == outcome.pictures[0].truth.shape
    page = write_report(tmp_path / "report", summary, outcome.rows, outcome.pictures)
    assert page.read_text(encoding="utf-8").count('alt="plot"') >= 3
    assert not list(tmp_path.glob("sags-eval-*"))
    with pytest.raises(UsageError, match=r"sees every frame.*--pace step"):
        evaluate(session_folder, played, pace="realtime")
    with pytest.raises(SagsError, match=r"the node failed: .*mapping\.rung 99"):
        evaluate(session_folder, ["mapping.rung:=99"], options, "realtime")


def test_a_receipt_tells_what_was_compared_apart(frames: list[StereoFrame]) -> None:
    tissue = np.ones((HEIGHT, WIDTH), bool)
    tissue[:4] = False

    def receipt(last: StereoFrame = frames[5], tissue: Bool = tissue, of: StereoRig | None = None) -> Any:
        found = Receipt(of or rig(), (WIDTH, HEIGHT), None)
        for frame in (*frames[:3], last):
            found.add(frame, tissue)
        return found.as_json()

    whole = receipt()
    assert whole["frames"]["ids"] == "0-2, 5" and whole["frames"]["count"] == 4
    assert whole["masks"]["pixels_counted"] == 4 * (HEIGHT - 4) * WIDTH
    assert receipt() == whole
    changed = replace(frames[5], left=frames[5].left ^ np.uint8(1))
    assert receipt(changed)["frames"]["digest"] != whole["frames"]["digest"]
    assert receipt(tissue=~tissue)["masks"]["digest"] != whole["masks"]["digest"]
    other = replace(rig(), left=replace(rig().left, K=rig().left.K + 0.01))
    assert receipt(of=other)["calibration"] != whole["calibration"]


def test_options_out_of_range_and_ambiguous_segments_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="every 0"):
        MeasureOptions(every=0)
    launch = tmp_path / "launch.yaml"
    launch.write_text("segments: {psnr: [1, 2]}")
    with pytest.raises(UsageError, match=r"segments\.psnr"):
        evaluate(launch)


def test_the_page_of_figures_explains_every_group() -> None:
    page = (ROOT / "docs/evaluation.md").read_text(encoding="utf-8")
    groups = [*MEANS, *POOLED]
    assert [group for group in groups if f"`{group}`" not in page] == []
