"""YAML as users, programs and pranksters write it: values, or one short line: what is wrong, and where."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from places import ROOT

from sags_node.bags.bag import storage_files
from sags_node.clients.overlay.scene import read_scene
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import OnnxConfig
from sags_node.config.yaml_reader import MOST_VALUES, parse_word, parse_yaml, read_yaml
from sags_node.errors import UsageError
from sags_node.rig import load_rig, read_rig
from sags_node.vision.onnx_session import read_format

LONGEST = 300  # characters of a message, without the name of the file

BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


def refusal(read: Callable[[], object]) -> str:
    with pytest.raises(UsageError) as caught:
        read()
    said = str(caught.value)
    assert "\n" not in said and len(said) < LONGEST, said
    return said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("source: &a\n  kind: *a\n", "line 1: it contains itself, through an alias"),
        ("&a [*a]", "line 1: it contains itself, through an alias"),
        (BOMB, f"more than {MOST_VALUES} values"),
        ("a: 1\nb: 2\na: 3\n", "line 3: the key 'a' is given twice, first in line 1"),
        ("s: {kind: x, kind: y}", "the key 'kind' is given twice"),
        ("1: a\n0x1: b\n", "the key 1 is given twice"),
        ('a: "b\\0c"', "line 1: a text holds a zero character"),
        ('"a\\0b": c', "a text holds a zero character"),
        ('"a\\udce9b"', "line 1: 'a\\udce9b' holds bytes that are no UTF-8 text"),
        ("a: b: c", "line 1: mapping values are not allowed here"),
        ("a:\n  b: 1\n   c: 2\n", "line 3: mapping values are not allowed here; give keys of one section"),
        ("a:\n  b: 1\n c: 2\n", "give keys of one section the same indent"),
        ("a:\n\tb: 1\n", "line 2: found character '\\t' that cannot start any token; indent with spaces"),
        ("a: 1\nb\nc: 3\n", "line 2: could not find expected ':'; write 'key: value'"),
        ("a: [", "line 1: "),
        ("a: *b", "found undefined alias"),
        ("[" * 3000, "nested too deeply"),
        ("a: " + "9" * 5000, "a value is not what it looks like"),
        ("a: 2001-99-99", "a value is not what it looks like"),
        ("a: !!int x", "a value is not what it looks like"),
        ("a: !!bool x", "a value is not what it looks like"),
        ("a: !!python/object/apply:os.system ['true']", "could not determine a constructor"),
        ("? [a, b]\n: c", "line 1: found unhashable key"),
        ("a: 1\n---\nb: 2\n", "line 2: but found another document"),
        ("a: \x07", "character"),
        (b"\xff\xfe\x00", "not UTF-8"),
        ("*" + "x" * 5000, "found undefined alias"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_what_is_refused(text: str | bytes, said: str) -> None:
    message = refusal(lambda: parse_yaml(text, "file"))
    assert message.startswith("file is not valid YAML: ") and said in message


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a: 1\nb: [1, 2.5, x]\n",
        "base: &b {x: 1, y: 2}\nmine: {<<: *b, y: 3}\n",  # y is given once on each side of the merge
        "deep: {inner: &m {<<: {x: 1}, x: 2}}\ntop: {<<: *m, z: 1}\n",
        "a: &a 5\nb: *a\n",
        "- {k: 1}\n- {k: 2}\n",
    ],
)
def test_everything_else_is_what_pyyaml_reads(text: str) -> None:
    assert parse_yaml(text, "file") == yaml.safe_load(text)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *((text, text) for text in ("000100", "000180", "-010", "0_20")),
        *(("007", 7), ("00", 0), ("0x10", 16), ("1:30", 90), ("010.5", 10.5)),
    ],
)
def test_numbers_with_zeros_in_front_are_not_octal(text: str, value: object) -> None:
    assert parse_yaml(f"{{{text}: [{text}]}}", "file") == {value: [value]}
    assert parse_word(text, "word") == value


def test_zeros_in_front_do_not_change_numbers_of_a_launch_file(tmp_path: Path) -> None:
    """A folder of such a name is found, too."""
    config: Any = as_launch(
        "source: {kind: folders, left: '0', right: 0100, start: 010, frames: 0100}\n"
        "segments: {pull: [000100, 000180]}\n",
        tmp_path,
    )
    assert config.segments == {"pull": (100, 180)}
    assert (config.source.start, config.source.frames) == (10, 100)
    assert config.source.right == tmp_path / "0100"
    assert load_launch(tmp_path, ["source.frames:=0200"]).source.frames == 200  # type: ignore[union-attr]


def test_parts_are_not_shared() -> None:
    tree = parse_yaml("a: &a {x: [1]}\nb: *a\n", "file")
    tree["a"]["x"].append(2)
    assert tree["b"] == {"x": [1]}


# ---- files -----------------------------------------------------------------------------------------------


def as_launch(text: str, folder: Path) -> object:
    (folder / "launch.yaml").write_text(text)
    return load_launch(folder)


def network_format(folder: Path) -> object:
    return read_format(OnnxConfig(path=folder / "net.onnx"), {})


LEFT = (ROOT / "calib/d4d/left.yaml").read_text()
READERS: dict[str, tuple[str, str, Callable[[Path], object]]] = {  # file, what stands before, who reads it
    "launch file": ("launch.yaml", "", load_launch),
    "calibration": ("left.yaml", LEFT, load_rig),
    "calibration of OpenCV": ("rig.yml", "%YAML:1.0\n---\n", lambda folder: read_rig(folder / "rig.yml")),
    "scene": ("scene.yaml", "", lambda folder: read_scene(folder / "scene.yaml")),
    "bag": ("metadata.yaml", "", storage_files),
    "network": ("net.yaml", "", network_format),
    "override": ("none", "", lambda folder: load_launch(None, [f"source:={(folder / 'none').read_text()}"])),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\na: 2\n", "given twice"),
        ("a: &a\n  kind: *a\n", "it contains itself, through an alias"),
        (BOMB, "values, with its aliases unfolded"),
    ],
    ids=["twice", "itself", "bomb"],
)
def test_every_reader_is_this_one(reader: str, text: str, said: str, tmp_path: Path) -> None:
    name, before, read = READERS[reader]
    (tmp_path / name).write_text(before + text)
    shutil.copy(ROOT / "calib/d4d/right.yaml", tmp_path)  # the other eye of a rig
    assert said in refusal(lambda: read(tmp_path)).replace(str(tmp_path), "")


def test_a_value_of_any_size_is_shown_in_short(tmp_path: Path) -> None:
    many = ", ".join(["[x, y]"] * 2000)
    message = refusal(lambda: as_launch(f"mapping: {{budget_ms: [{many}]}}", tmp_path))
    assert "mapping.budget_ms" in message


def test_a_thousand_mistakes_are_not_all_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        as_launch("".join(f"key{number}: 1\n" for number in range(1000)), tmp_path)
    lines = str(caught.value).splitlines()
    assert len(lines) == 11 and lines[-1].endswith("and 990 more")


def test_what_is_no_plain_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "folder.yaml").mkdir()
    for name, said in (("pipe.yaml", "a pipe"), ("folder.yaml", "a folder"), ("gone.yaml", "No such file")):
        assert said in refusal(lambda name=name: read_yaml(tmp_path / name, "launch file"))  # type: ignore[misc]
    assert "a device" in refusal(lambda: read_yaml(Path("/dev/zero"), "launch file"))
    (tmp_path / "large.yaml").write_bytes(b"#" * (1 << 20) + b"\n")
    assert "bytes" in refusal(lambda: read_yaml(tmp_path / "large.yaml", "launch file"))
