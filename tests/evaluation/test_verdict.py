"""What a run was worth, in words: with units and baselines, and no figure left out."""

from typing import Any

from sags_node.tools.evaluation.figures import TABLE, flat, groups, headings, verdict
from sags_node.tools.evaluation.measure import MeasureOptions
from sags_node.tools.evaluation.summary import STAGES, summarise

TIMES = {"p50": 38.6, "p90": 60.0, "p99": 96.9, "max": 313.8}


def live() -> dict[str, Any]:
    """Of a demo, in the form of `summarise`."""
    return {
        "session": "phantom", "frames": 300, "processed": 268, "held_out": 0, "dropped": 32,
        "rate_hz": 27.57, "first_render_ms": 313.8, "latency_ms": TIMES, "frame_ms": TIMES,
        "budget_ms": 33.33,
        "online": {"psnr": 34.61, "ssim": 0.9356, "lpips": None, "motion": {"psnr": 31.0, "ssim": 0.9}},
        "predict": {"psnr": 36.91, "model_psnr": 33.65, "copy_psnr": 35.84}
        | {"motion": {"psnr": 29.9, "copy_psnr": 30.1}},
        "heldout": None,
        "right": {"psnr": 34.15, "warp_psnr": 32.61, "model_psnr": 31.61, "copy_psnr": 41.59}
        | {"coverage": 0.89},
        "hidden": {"psnr": 26.08, "copy_psnr": 25.32, "model_psnr": 22.85},
        "depth": {"median_mm": 0.2443, "p90_mm": 0.9778, "rmse_mm": 0.81, "coverage": 0.9906},
        "measured_depth": {"median_mm": 0.1721, "p90_mm": 0.64, "rmse_mm": 0.53, "coverage": 0.87},
        "track": {"median_mm": 0.3769, "p90_mm": 0.8802, "median_px": 1.9, "lost": 0.3297},
        "gaussians": {"mean": 21510.0, "max": 92395}, "rungs": {1: 14, 2: 0, 3: 137, 14: 5},
        "warnings": {"frames_missed": 16}, "segments": {"motion": [5, 9]},
        "settings": {"depth_reference": "exact", "width": 640, "height": 512, "device": "cpu"},
        "machine": "AMD EPYC, 2 cores",
        "overlay": {"frames": 268, "overlay": 249, "blanked": {"being pinned": 19}, "latency_ms": TIMES},
    }  # fmt: skip


def test_a_verdict_has_what_an_overlay_needs_first_with_units_and_baselines() -> None:
    said = dict(verdict(flat(live())))
    names = ["overlay", "points", "depth", "right eye", "hidden", "speed", "latency", "image"]
    assert list(said)[: len(names)] == names and len(said) < 12  # where the report is comes after them
    depth = "0.24 mm off (median), nine of ten within 0.98 mm, on 99% of the tissue, against exact truth"
    assert said.pop("depth") == f"{depth}; stereo alone: 0.17 mm on 87%"
    assert said == {
        "speed": "268 of 300 frames shown at 27.6 frames/s, 32 missed",
        "latency": "39 ms (p50), 97 ms (p99) from the camera's stamp to sending; 314 ms for the first frame",
        "image": "36.9 dB PSNR of the next frame, the model alone 33.6 dB. The image before, shown again:"
        " 35.8 dB; near while tissue rests, but without depth, another view or hidden tissue",
        "points": "0.38 mm off (median), nine of ten within 0.88 mm;"
        " 33% lost with their Gaussians (anchors take new ones)",
        "overlay": "on 249 of 268 frames (93%), 39 ms (p50), 97 ms (p99) after the camera;"
        " 19 without: being pinned",
        "right eye": "34.1 dB PSNR (left image, warped: 32.6 dB)",
        "hidden": "26.1 dB PSNR (the model alone: 22.9 dB; as it was last seen: 25.3 dB)",
        "quality": "rung 3 of 0 to 15 for most frames (1 to 14), 21,510 Gaussians on average, 640x512 px",
        "warnings": "frames_missed (16 frames)",
        "machine": "AMD EPYC, 2 cores; the model on the CPU",
    }


def test_without_truth_a_verdict_says_what_a_recording_can_tell_of_itself() -> None:
    own = {
        "stereo": {"median_mm": 0.31, "p90_mm": 1.2, "coverage": 0.99, "stereo_coverage": 0.8},
        "forth_back": {"median_mm": 0.42, "p90_mm": 1.1, "median_px": 2.0, "lost": 0.17, "moved_mm": 12.3},
        "second_run": {"frames": 150},
    }
    figures = flat(live() | dict.fromkeys(("depth", "measured_depth", "track")) | own)
    said = dict(verdict(figures))
    apart = "0.31 mm from the frame's own stereo (median), nine of ten within 1.20 mm"
    assert said["depth"] == f"{apart}; on 99% of the tissue, stereo alone on 80%"
    back = "0.42 mm off (median), nine of ten within 1.10 mm once back at the first frame, after moving"
    assert said["points"] == f"{back} 12.30 mm; 17% lost with their Gaussians (anchors take new ones)"
    assert said["played again"].startswith("the first 150 frames, frame by frame")
    gone = {"forth_back.median_mm": None, "forth_back.p90_mm": None, "forth_back.lost": 1.0}
    assert dict(verdict(figures | gone))["points"] == "all given up"
    assert "from the frame's own" not in dict(verdict(flat(live() | own)))["depth"]  # the truth is better


def test_what_did_not_happen_has_no_row_and_what_was_never_shown_has_one() -> None:
    quiet = live() | {"dropped": 0, "stage_ms": {"map": 12.0, "publish": 0.004, "render": 0.0}}
    quiet["overlay"] = {**quiet["overlay"], "overlay": 0, "freezes": {"count": 0, "seconds": 0.0}}
    found = groups(quiet)
    work, camera, overlay = (
        {what: values for what, values, _ in found[group]} for group in ("Work", "Camera", "Overlay")
    )
    assert [what for what in work if what.startswith("of that")] == ["of that, median of: map"]
    assert "missed" not in camera and not [what for what in overlay if "stood still" in what]
    assert overlay["shown on"] == ["0", ""]


def test_a_run_frame_by_frame_is_not_called_live() -> None:
    step = live() | {"latency_ms": None, "held_out": 22, "heldout": {"psnr": 35.7, "copy_psnr": 39.5}}
    said = dict(verdict(flat(step)))
    assert said["speed"].startswith("27.6 frames/s would be possible; frame by frame, 268 of 278 frames")
    assert said["latency"] == "39 ms (p50), 97 ms (p99) of work on a frame"
    assert said["unseen"] == "35.7 dB PSNR on frames kept back (the image before, shown again: 39.5 dB)"


def test_what_is_not_known_is_not_said() -> None:
    empty = summarise("nothing", [], MeasureOptions(hold_out=0), {}, None)
    assert [name for name, _ in verdict(flat(empty))] == ["speed", "machine"]
    assert verdict({}) == []


def test_figures_stand_in_groups_beside_their_baselines() -> None:
    found = groups(live())
    assert list(found) == list(TABLE) and headings(live()) == ["all frames", "motion"]
    shown = {(group, row[0]): row for group, rows in found.items() for row in rows}
    what = ("Image", "the model, PSNR over tissue")
    assert shown[what] == (what[1], ["34.6 dB", "31.0 dB"], "the image before, shown again: 35.8 dB")
    assert shown["Depth", "error, median"] == ("error, median", ["0.24 mm", ""], "stereo alone: 0.17 mm")
    assert shown["Points", "lost"][1] == ["33 %", ""]
    assert shown["Overlay", "not shown: being pinned"][1] == ["19"]
    assert ("Model", "frames on rung: 1") in shown and ("Model", "frames on rung: 2") not in shown
    for rows in found.values():
        for what, values, _ in rows:
            assert any(values) and not any("{" in value or "None" in value for value in values), what


def test_no_figure_of_a_summary_is_left_out() -> None:
    given = {f"stage_ms.{stage}" for stage in STAGES}
    given |= {key for key, value in flat(live()).items() if value is not None and ".motion." not in key}
    shown = {key for rows in TABLE.values() for figure in rows for key in (figure.key, figure.baseline_key)}
    prefixes = (*(key[:-1] for key in shown if key.endswith(".*")), "settings.")
    assert {key for key in given - shown if not key.startswith(prefixes)} == {"session", "machine"}
