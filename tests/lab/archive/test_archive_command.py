"""`sags archive` as users give it, with real recordings and the real job."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from command_line import pure_json, refused, sags

from sags_lab.archive import cluster as cluster_module
from sags_lab.archive.manifest import Recording, write_manifest
from sags_node.evaluation.measure import MeasureOptions
from sags_node.evaluation.session import evaluate
from sags_node.kernels.threads import configure_threads

SETTINGS = ("mapping.max_gaussians:=2000", "source.frames:=4")


def test_figures_are_those_of_sags_eval(cluster: Any, tiny_session: Path, tmp_path: Path) -> None:
    recordings = [
        Recording(str(tiny_session), str(tmp_path)),
        Recording("nowhere", str(tmp_path)),
    ]
    write_manifest(str(tmp_path / "m.csv"), recordings)
    command = ["archive", "run", tmp_path / "m.csv", "--job", "eval", "--out", tmp_path / "out"]
    command += ["--ray", cluster.address, "--options", "--iterations 1 --hold-out 2 --every 2", *SETTINGS]
    result = sags(*command, "--json")
    assert result.exit_code == 1 and "1 recordings failed" in result.stderr
    state = pure_json(result.stdout)
    assert (state["done"], state["quarantined"], state["missing"]) == (1, 1, 0)

    done, poison = (each.id for each in recordings)
    shown = pure_json(sags("archive", "show", tmp_path / "out", done[:10], "--json").stdout)
    try:
        expected = evaluate(
            tiny_session, ["engine.threads:=1", *SETTINGS], MeasureOptions(2, 2), "step", 1
        ).summary
    finally:
        configure_threads(None)
    for group in ("online", "heldout", "depth", "track", "novel"):
        for name, value in expected[group].items():
            assert shown["figures"][f"{group}.{name}"] == value, (group, name)
    assert shown["state"] == "done" and shown["figures"]["settings.pace"] == "step"
    assert (tmp_path / "out/recordings" / done / "report/report.html").is_file()

    assert shown["log"].splitlines()[-1] == f"report: {tmp_path}/out/recordings/{done}/report/report.html"

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
    shown = pure_json(sags("archive", "show", out, recordings[0].id, "--json").stdout)
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
    said = ("archives need no_such_package", "pip install 'sags-node[lab]'")
    out = tmp_path / "out"
    refused(2, "archive", "run", tmp_path / "m.csv", "--job", "eval", "--out", out, said=said)
    refused(2, "archive", "status", out, said=said)
    assert not out.exists()
