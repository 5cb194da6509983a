"""`sags archive` as users give it, with real recordings and the real job."""

import json
from pathlib import Path
from typing import Any

import pytest
from command_line import figures_of, pure_json, refused, sags
from tiny_archive import TINY_FRAMES

from sags_lab.archive import cluster as cluster_module
from sags_lab.archive.costs import Cost, of_an_hour
from sags_lab.archive.manifest import Recording, write_manifest
from sags_node.kernels.threads import configure_threads
from sags_node.tools.evaluation.measure import MeasureOptions
from sags_node.tools.evaluation.session import evaluate

SETTINGS = ("mapping.max_gaussians:=2000", "source.frames:=4")


def test_figures_are_those_of_sags_eval(cluster: Any, tiny_session: Path, tmp_path: Path) -> None:
    recordings = [Recording(str(tiny_session), str(tmp_path)), Recording("nowhere", str(tmp_path))]
    write_manifest(str(tmp_path / "m.csv"), recordings)
    command = ["archive", "run", tmp_path / "m.csv", "--job", "eval", "--out", tmp_path / "out"]
    command += ["--ray", cluster.address, "--options", "--iterations 1 --hold-out 2 --every 2", *SETTINGS]
    result = sags(*command, "--json")
    assert result.exit_code == 1 and "1 recordings failed" in result.stderr
    state = pure_json(result.stdout)
    assert (state["done"], state["quarantined"], state["missing"]) == (1, 1, 0)

    done, poison = (each.id for each in recordings)
    shown = figures_of("archive", "show", tmp_path / "out", done[:10], "--json")
    try:
        found = evaluate(tiny_session, ["engine.threads:=1", *SETTINGS], MeasureOptions(2, 2), "step", 1)
    finally:
        configure_threads(None)
    for group in ("online", "heldout", "depth", "track", "novel"):
        for name, value in found.summary[group].items():
            assert shown["figures"][f"{group}.{name}"] == value, (group, name)
    assert shown["state"] == "done" and shown["figures"]["settings.pace"] == "step"
    report = tmp_path / "out/recordings" / done / "report/report.html"
    assert report.is_file() and shown["log"].splitlines()[-1] == f"report: {report}"

    why = sags("archive", "show", tmp_path / "out", poison).stdout
    assert "quarantined" in why and "nowhere" in why and "sags eval /" in why
    page = (tmp_path / "out/report.html").read_text()
    assert poison in page and page.count("data:image/svg") >= 7 and "data:image/jpeg" in page
    again = sags(*command)
    assert again.exit_code == 1 and "2 recordings   1 done, 1 quarantined, 0 missing" in again.stdout


def test_episodes_become_a_data_set(cluster: Any, tiny_session: Path, tmp_path: Path) -> None:
    recordings = [Recording(str(tiny_session), str(tmp_path), overrides=("source.frames:=2",))]
    write_manifest(str(tmp_path / "m.csv"), recordings)
    out, dataset = tmp_path / "out", tmp_path / "dataset"
    sags(
        *("archive", "run", tmp_path / "m.csv", "--job", "lerobot", "--out", out, "--ray", cluster.address),
        "mapping.iterations:=1",
    )
    shown = figures_of("archive", "show", out, recordings[0].id, "--json")
    assert (shown["state"], shown["figures"]["lerobot.holds"]) == ("done", 2)
    sags("archive", "dataset", out, dataset, "--lerobot-version", "v2.1")
    info = json.loads((dataset / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"]) == ("v2.1", 1, 2)
    refused(2, "archive", "dataset", out, dataset, said=("is not empty",))


def test_mistakes_are_said_in_one_line(tmp_path: Path) -> None:
    out = ("--job", "eval", "--out", tmp_path / "out")
    refused(2, "archive", "run", *out, said=("name a manifest",))
    refused(2, "archive", "run", tmp_path / "none.csv", *out, said=("none.csv cannot be read",))
    refused(2, "archive", "run", tmp_path, *out, said=("holds no recording",))
    refused(2, "archive", "run", tmp_path, *out, "engine.threads:=many", said=("engine.threads:=many",))
    refused(2, "archive", "status", tmp_path, said=("holds no archive",))
    refused(2, "archive", "status", "nowhere://x", said=("nowhere",))


def test_without_the_extra_the_command_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster_module, "NEEDED", ("fsspec", "no_such_package"))
    said = ("archives need no_such_package", "pip install '.[lab]'")
    out = tmp_path / "out"
    refused(2, "archive", "run", tmp_path / "m.csv", "--job", "eval", "--out", out, said=said)
    refused(2, "archive", "status", out, said=said)
    assert not out.exists()


# ---- what an hour of video costs, from two lengths of a recording --------------------------------------


def test_a_start_counts_once_and_each_frame_the_same() -> None:
    """3 s to start and 0.1 s for a frame; an hour at 30 Hz has 108,000 frames."""
    short, long = (Cost(3 + 0.1 * n, 4 + 0.2 * n, 300.0, 50 + 1000 * n) for n in (30, 120))
    assert of_an_hour("depth", short, long, 120, 30.0) == {
        "cpu_s": 10_803,
        "wall_s": 21_604,
        "bytes": 108_000_050,
    }
    assert of_an_hour("fit", long, long, 120, 30.0)["cpu_s"] == 900 * 15  # so many clips
    fewer_bytes = Cost(15, 28, 300.0, 40)  # a report of more frames that is smaller
    assert of_an_hour("eval", short, fewer_bytes, 120, 30.0)["bytes"] == 40


def test_the_command_measures_a_recording(tiny_session: Path) -> None:
    asked = ("--job", "depth", "--frames", TINY_FRAMES, "--json")
    (row,) = figures_of("archive", "costs", tiny_session, "mapping.iterations:=1", *asked)
    assert (row["job"], row["frames"], row["seconds_of_video"]) == ("depth", 6, 0.6)
    assert row["cpu_s"] > 0.1 and row["peak_mb"] > 50
    pictures = 2 * 160 * 128 * TINY_FRAMES  # bytes, before they are compressed
    assert 0 < row["bytes"] < pictures + 10_000
    refused(2, "archive", "costs", tiny_session, "--frames", 7, said=("7 frames", "has 6", "--frames"))
