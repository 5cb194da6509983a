"""`python -m benchmarks`: what commands say of a few frames, and how they explain a wrong call."""

import json
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import cv2
import numpy as np
import pytest
from command_line import figures_of, ran, refused
from places import ROOT, SESSION

from benchmarks.__main__ import main
from benchmarks.pareto import baselines
from benchmarks.pareto import settings as pareto_settings
from benchmarks.quality import methods
from benchmarks.tables import tables

# ---- what each says of a few frames ------------------------------------------------------------------------


def measured(tmp_path: Path, *arguments: object) -> Any:
    """What a command says as JSON, which is what it writes."""
    out = tmp_path / "new/figures.json"
    found = figures_of(*arguments, "--out", out, "--json", command=main)
    written = json.loads(out.read_text())
    figures = found if isinstance(found, dict) else {"rows": found}
    assert written == {"provenance": ANY} | figures
    return found


def test_kernels(tmp_path: Path) -> None:
    table = measured(tmp_path, "kernels", "--quick", "--contention")
    assert (tmp_path / "new/figures.svg").read_text().startswith("<?xml")
    rows = table["rasterize"]
    assert {row["scene"] for row in rows} == {"surface", "corner", "shuffled"}
    pairs = {row["active_tiles"]: row["pixel_pairs"] for row in rows}
    assert pairs.keys() == {1.0, 0.5, 0.25, 0.1, 0.05} and 0.3 * pairs[1.0] < pairs[0.5] < 0.7 * pairs[1.0]
    for row in (row for section in ("rasterize", "losses", "adam") for row in table[section]):
        assert all(each["share_of_peak"] > 0 for each in (row, *row["stages"]))
    assert table["contention"][0]["beside_busy_process_ms"]["p50"] > 0


def test_pareto(phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pareto_settings, "BUDGETS_MS", (33.0, 20.0))
    monkeypatch.setattr(pareto_settings, "SIZES", (0.5,))
    fit = {"session": phantom_session.name, "seconds": 9.0, "gaussians": 800, "heldout": {"psnr": 41.0}}
    (tmp_path / "fit_phantom.json").write_text(json.dumps(fit | {"depth": None}))
    (tmp_path / "fit_other.json").write_text(json.dumps(fit | {"session": "another"}))
    monkeypatch.setattr(baselines, "RESULTS", tmp_path)
    plot = tmp_path / "pareto.png"
    asked = "mapping.max_gaussians:=2000 mapping.rung:=8 --frames 10 --only budgets,resolutions,skips".split()
    found = measured(tmp_path, "pareto", phantom_session, *asked, "--plot", plot)
    (session,) = found["sessions"]
    rows = {tuple(each["overrides"]): each for each in session["settings"]}
    default, half = rows[()], rows["vision.width:=160", "vision.height:=128"]
    assert default["online_at_full_size"] == default["online"]
    # What is sharp at half the size is not at full size: the noise is averaged away, and detail is missing.
    assert half["online_at_full_size"]["psnr"] < half["online"]["psnr"] - 1
    copied, stereo, *_, offline = session["baselines"]
    assert copied["predict"]["psnr"] == default["predict"]["copy_psnr"]
    assert stereo["depth"] == default["measured_depth"] and offline["heldout"]["psnr"] == 41.0
    assert session["receipt"]["frames"]["ids"] == "0, 2-8"  # every eighth is held out
    skips = {each["rule"]: each for each in session["skips"]}
    assert skips["skip_depth"]["on"]["skipped"]["depth"] > 0
    assert skips["skip_duplicates"]["online_db"] == 0  # no frame repeats: the rule changes nothing
    drawn = cv2.imread(str(plot))
    assert (drawn != 255).any(-1).mean() > 0.005


def test_depth(tmp_path: Path) -> None:
    found = measured(tmp_path, "depth", SESSION, "source.frames:=17")
    assert found["frames"] == 2 and found["truth"] == "exact"
    assert found["receipt"]["frames"]["ids"] == "0, 16"  # every eighth has a reference
    regions = {row["region"]: row for row in found["regions"]}
    unseen = regions["not seen by the right eye"]
    assert unseen["stage"]["coverage"] < 0.2  # what cannot be measured is not given
    assert unseen["drawn"]["coverage"] > 0.9
    medians = [row["median_mm"] for row in found["confidence"]]
    assert medians == sorted(medians, reverse=True)


def test_disturbances(tmp_path: Path) -> None:
    asked = ["--only", "clean", "--only", "black_right", "--from", 12, "--pictures", tmp_path]
    found = measured(tmp_path, "disturbances", SESSION, "source.frames:=36", *asked)
    clean, black = found["rows"]
    for key in ("psnr_before", "model_psnr_before"):
        assert clean[key] == black[key]  # the same until then
    for row in found["rows"]:
        assert all(row[f"psnr_{when}"] > row[f"model_psnr_{when}"] for when in ("before", "during", "after"))
    assert clean["frames_to_recover"] == clean["model_frames_to_recover"] == 0
    assert clean["warned_after_s"] is None
    assert clean["anchors_wrong"] <= 0.1
    assert black["warned_of"] == ["right_eye_black"]
    assert black["borrowed_share"] > clean["borrowed_share"] + 0.2  # nothing is measured after half a second
    row = cv2.imread(str(tmp_path / "black_right.png"))[288 : 2 * 288]
    assert not row[:, 360:720].any() and row[:, :360].mean() > 20  # amid, the right eye is black


def test_endurance(tmp_path: Path) -> None:
    asked = "mapping.max_gaussians:=2000 source.frames:=12 --frames 24 --window 6 --order wrap".split()
    found = measured(tmp_path, "endurance", SESSION, *asked)
    assert found["recorded_frames"] == 12 and [each["frames"] for each in found["windows"]] == [6, 12, 18, 24]
    assert all(slope is not None for slope in found["per_1000_frames"].values())
    assert all(each["psnr"] > each["model_psnr"] for each in found["windows"])
    still = found["still"]
    assert still["settled"] < still["recognised"] <= still["frames"]


def test_alias(tmp_path: Path) -> None:
    """Its figures say of the phantom what the tests of the engine say of a wall."""
    table = measured(tmp_path, "alias", "--quick", "--picture", tmp_path / "alias.png")
    quarter = table["psnr_at_size"][0]
    assert quarter["both"] - quarter["none"] == pytest.approx(table["gain_db_quarter"])
    assert table["gain_db_quarter"] > 3
    assert all(abs(row["both"]) < 0.02 for row in table["thin_vessel_brightness_change"])
    assert (tmp_path / "alias.png").read_bytes().startswith(b"\x89PNG")


def test_methods(phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A field knows the last seconds, and nodes do not."""
    monkeypatch.setattr(methods, "SIZES", ((320, 256),))
    asked = (phantom_session, "source.frames:=20", "mapping.max_gaussians:=6000")
    nodes, field = measured(tmp_path, "methods", *asked)
    assert (nodes["method"], field["method"]) == ("nodes", "sags")
    assert field["step"]["window"] > nodes["step"]["window"]
    assert field["step"]["receipt"] == nodes["step"]["receipt"]
    assert all(row["live"]["rate_hz"] > 0 for row in (nodes, field))


# ---- what it says to people --------------------------------------------------------------------------------


def test_a_table_shows_the_keys_that_are_asked_for_wherever_they_lie() -> None:
    row = {
        "name": "fast",
        "ms": {"p50": np.float32(1.23456), "p99.9": np.int64(7)},
        "depth": None,
        "size": [640, 512],
    }
    found = {"session": "a", "parts": {"one": [row], "two": [{"name": "slow", "size": []}]}, "size": 3}
    by_name, below = tables(
        found["parts"], "ms.p50 ms.p99.9 depth.p90_mm size name", "two: size name", "gone"
    )
    cells = [[*column.cells] for column in by_name.columns]
    assert cells == [
        ["one", "two"],
        ["1.235", "-"],
        ["7", "-"],
        ["640, 512", "-"],
        ["fast", "slow"],
    ]
    assert [column.header for column in by_name.columns][1:4] == ["ms p50", "ms p99 9", "size"]
    assert [[*column.cells] for column in below.columns] == [["slow"]]
    (inherited,) = tables([found], "session name")
    assert [[*column.cells] for column in inherited.columns][1:] == [["a", "a"], ["fast", "slow"]]


def test_a_command_prints_its_tables() -> None:
    code, stdout, _ = ran("kernels", "--quick", command=main)
    assert code == 0 and "composite backward" in stdout and "share of peak" in stdout


# ---- mistakes ----------------------------------------------------------------------------------------------

LIVE = ROOT / "launch/v4l2.yaml"
PLAYED = "pareto depth disturbances endurance methods crowd thin tracking ablation masks".split()


@pytest.mark.parametrize(
    ("command", "arguments", "code", "said"),
    [
        *((name, [LIVE], 2, "record the cameras first") for name in PLAYED),
        ("pareto", [SESSION, "--only", "budgets,speed"], 2, "unknown part 'speed'; choose from budgets"),
        ("pareto", [SESSION, "--frames", 2, "--only", "budgets"], 1, "play more"),
        ("depth", ["--picture", "a.jpg"], 2, "add --ct FOLDER"),
        ("depth", [SESSION, "--faults"], 2, "give one of them"),
        ("depth", [SESSION, "source.frames:=2", "source.reference.depth:=null"], 1, "has no reference depth"),
        ("disturbances", [SESSION, "--from", 3], 2, "choose another --from"),
        ("disturbances", [SESSION, "--from", 38], 2, "choose another --from"),
        ("disturbances", [SESSION, "--only", "earthquake"], 2, "earthquake"),
        ("endurance", ["nothing.yaml"], 2, "nothing.yaml"),
        ("tracking", [SESSION, "--frames", "0,x"], 2, "give numbers above 0"),
        ("recall", [SESSION], 2, "phantom"),
        ("scope", [SESSION], 2, "phantom"),
        ("scope", ["--seconds", 5], 2, "breaths"),
        ("inputs", ["--only", "telepathy"], 2, "the ways are gst, two branches, "),
        ("kernels", ["--check", "list.json", "--out", "new.json"], 2, "give --out or --check"),
        ("kernels", ["--check", "gone.json"], 2, "gone.json"),
        ("kernels", ["--check", "list.json"], 2, "holds no kernel times"),
        ("ablation", [SESSION, "source.frames:=4"], 1, "1 are left to learn from and 0 to test on"),
        ("ablation", [SESSION, "--variant", "fuller"], 2, "full, no_block"),
        ("crowd", ["no_such_key:=1"], 2, "no_such_key"),
    ],
)  # fmt: skip
def test_a_wrong_call_says_why(
    command: str,
    arguments: list[object],
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "list.json").write_text("[1]")
    refused(code, command, *arguments, said=(said,), command=main)


WRITERS = [
    *((name, "--out") for name in main.commands),
    *(("alias", "--picture"), ("pareto", "--plot")),
]


@pytest.mark.parametrize(("name", "option"), WRITERS)
def test_what_it_did_not_make_stays(tmp_path: Path, name: str, option: str) -> None:
    """It says so before any work."""
    mine = tmp_path / "mine.png"
    mine.write_text("source: {kind: videos}")
    refused(2, name, option, mine, said=(str(mine), "exists already", "choose another name"), command=main)
    assert mine.read_text() == "source: {kind: videos}"
