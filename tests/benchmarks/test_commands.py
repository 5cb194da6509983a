"""`python -m benchmarks`: what commands say of a few frames, and how they explain a wrong call."""

from pathlib import Path

import numpy as np
import pytest
from command_line import ran, refused
from places import ROOT, SESSION

from benchmarks.__main__ import main
from benchmarks.tables import tables

# ---- what each says of a few frames ------------------------------------------------------------------------


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
