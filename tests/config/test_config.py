"""Launch files: every key is known, paths are found, mistakes are explained."""

import re
from collections.abc import Iterable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import pytest
from annotated_types import Ge, Gt, Le
from places import ROOT

from sags_node.config.launch_file import load_launch, with_parameters
from sags_node.config.schema import LaunchConfig, MappingConfig, Section, VisionConfig
from sags_node.errors import UsageError


@pytest.mark.parametrize("file", sorted((ROOT / "launch").glob("*.yaml")), ids=lambda f: f.stem)
def test_every_launch_file_loads(file: Path) -> None:
    config = load_launch(file)
    if config.rig is not None:
        assert (config.rig / "left.yaml").is_file()


def found_in(config: LaunchConfig, keys: Iterable[str]) -> dict[str, Any]:
    return {key: attrgetter(key)(config) for key in keys}


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("source: {kind: folders, left: left, right: $EYES/right}\nrig: calib",
         {"source.left": Path("sub/left"), "source.right": Path("/eyes/right"), "rig": Path("sub/calib")}),
        # No shell expands the user's home behind `:=`.
        ("source: {kind: folders, left: ~/left, right: right}\nrig: ~/calib",
         {"source.left": Path("/me/left"), "source.right": Path("sub/right"), "rig": Path("/me/calib")}),
        # Of a section of several kinds those of its kind.
        ("robot: {kind: push, key: a.key, allow: clients, hand_eye: he.yaml}\n"
         "publish: {key: node.key, allow: [clients, one.pub]}",
         {"robot.key": Path("sub/a.key"), "robot.allow": (Path("sub/clients"),),
          "robot.hand_eye": Path("sub/he.yaml"), "publish.key": Path("sub/node.key"),
          "publish.allow": (Path("sub/clients"), Path("sub/one.pub"))}),
        # One that stands in two places: they become relative to the file once.
        ("source: &n {kind: push, key: a.key, allow: [b]}\nrobot: *n",
         {"source.key": Path("sub/a.key"), "robot.key": Path("sub/a.key")}),
        # `right` of a source is a path, of publish it is not; `left` of a live source is no path either.
        ("source: {kind: v4l2, left: a, right: b}\npublish: {right: auto, run_dir: here}",
         {"source.left": "a", "publish.right": "auto", "publish.run_dir": Path("sub/here")}),
    ],
    ids=["variable", "home", "kinds", "twice", "no path"],
)  # fmt: skip
def test_paths_are_relative_to_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str, found: dict[str, Any]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EYES", "/eyes")
    monkeypatch.setenv("HOME", "/me")
    Path("sub").mkdir()
    Path("sub/launch.yaml").write_text(content)
    assert found_in(load_launch(Path("sub")), found) == found


@pytest.mark.parametrize(
    ("launch", "overrides", "found"),
    [
        (None, [], {"source.kind": "phantom"}),
        (None, ["rig:=null"], {"rig": None}),
        (None, ["source:={kind: folders, left: ~/left, right: a}", "rig:=~/calib"],
         {"source.left": Path("/me/left"), "rig": Path("/me/calib")}),
        ("d4d_pull.yaml", ["mapping.budget_ms:=50", "source.tools:=[1, 2, 300, 200]"],
         {"mapping.budget_ms": 50, "source.tools": (1, 2, 300, 200)}),
        # It sends each eye by itself, or both in one image: no key too many.
        (None, ["source:={kind: push, geometry: {first: right}}"], {"source.geometry.first": "right"}),
        # Where a method is said, others' keys may stay.
        (None, ["vision.tissue:={method: classical, path: net.onnx}"], {"vision.tissue.method": "classical"}),
        # A word of the command line has no comments.
        *((None, ["source.kind:=folders", "source.right:=right", f"source.left:={word}"],
           {"source.left": Path(name)})
          for name in ("/data/Case #3/left", "#2", "&abc def", "a # b", "left")
          for word in (name, f"'{name}'")),
    ],
)  # fmt: skip
def test_overrides_win_over_the_file(
    monkeypatch: pytest.MonkeyPatch, launch: str | None, overrides: list[str], found: dict[str, Any]
) -> None:
    monkeypatch.setenv("HOME", "/me")
    config = load_launch(launch and ROOT / "launch" / launch, overrides)
    assert found_in(config, found) == found


PANES = "{layout: panes, first: right, crop: [0, 0, 8, 8], crop_right: [8, 0, 8, 8]}"


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("mapping.budgt_ms:=3", "did you mean 'budget_ms'"),
        ("publish.data:=tcp://127.0.0.1:5", "publish.data: Input should be a list, e.g. [a, b] (got 'tcp:"),
        ("source.secnds:=3", "did you mean 'seconds'"),
        ("vision.stereo.scal:=2", "did you mean 'scale'"),
        ("zzz:=3", "known keys: "),
        ("source:={kind: folders, left: a, fps: 25}", "known keys: frames"),
        ("vision.stereo.min_depth:=30", "(got 30); docs/launch.md: m; nothing is looked for nearer"),
        ("mapping.budget_ms:=-1", "greater than or equal to 1"),
        ("mapping.budget_ms:=0.033", "greater than or equal to 1"),  # in seconds
        ("device:=gpu", "'auto', 'cpu' or 'cuda' (got 'gpu')"),
        ("vision.pose:=magic", "'session', 'fixed', 'estimate' or 'refine'"),
        ("vision.stereo:={min_depth: 0.2, max_depth: 0.1}", "must be below max_depth"),
        ("source.kind:=carrier_pigeon", "'folders'"),
        ("mapping.budget_ms:=yes", "mapping: budget_ms should be a number, not true or false"),
        ("engine.threads:=true", "engine: threads should be a number"),
        ("source:={kind: videos, left: a, geometry: {levels: [no, 1]}}", "levels should be a number"),
        ("segments:={motion: [yes, 20]}", "segments should be a number, not true or false"),
        ("vision.onnx.scale:=0", "vision.onnx.scale: should not be 0"),
        ("source:={kind: videos, left: a, right: b, geometry: {first: right}}", "exchange source.left and"),
        ("source:={kind: v4l2, geometry: {first: right}}", "exchange source.left and source.right"),
        (f"source:={{kind: videos, left: a, geometry: {PANES}}}", "exchange crop and crop_right"),
        ("vision.tissue.path:=net.onnx", "path is for method onnx, which is not set"),
        ("vision.tissue.endpoint:=tcp://127.0.0.1:5600", "endpoint is for method topic"),
        ("vision.tissue.exclude:=[[-1,0,5,5]]", "greater than or equal to 0 (got -1"),
        ("vision.tissue:={method: onnx, path: net.onnx}", "tissue_is"),
        ("publish.key:=a.key", "belong together"),
        ("publish.allow:=clients", "belong together"),
        ("mapping.budget_ms", "key:=value"),
        ("mapping.budget_ms.x:=3", "mapping.budget_ms"),
    ],
)
def test_a_mistake_is_named_with_its_fix(override: str, said: str) -> None:
    with pytest.raises(UsageError) as caught:
        load_launch(None, [override])
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("- a\n- b\n", "map of sections"),
        ("a: [", "not valid YAML"),
        ("a: \xff", "unknown key"),
        ("source: {kind: [videos]}", "source.kind: should be one of"),
        ("robot: {kind: foo}", "robot.kind: should be one of 'ros2', 'push', 'bag'"),
        ("source: {kind: folders, left: a, poses: b}\nrobot: {kind: push}", "source.poses too: leave one"),
        ("robot: {kind: bag, hand_eyes: a}", "robot.hand_eyes.; did you mean .hand_eye."),
        ("robot: {kind: ros2, topic: a, tools: [{topic: /a}]}", "/a is named twice: the scope and each tool"),
        ("robot: {kind: push, tools: [{topic: b}, {topic: /b}]}", "/b is named twice"),
    ],
)
def test_files_that_are_no_launch_files(tmp_path: Path, content: str, said: str) -> None:
    file = tmp_path / "launch.yaml"
    file.write_text(content, encoding="utf-8")
    with pytest.raises(UsageError, match=said):
        load_launch(file)


def test_a_frame_takes_less_than_the_time_until_the_next_unless_that_is_set() -> None:
    """Whatever takes all of it never makes up for a late frame."""

    def ms(rate: float | None, **mapping: Any) -> float:
        return MappingConfig(**mapping).frame_ms(rate)

    assert ms(60) == pytest.approx(15) and ms(25) == 36 and ms(10) == 90
    assert ms(2) == 100  # else what is shown would be half a second old
    assert ms(60, budget_ms=25) == ms(None, budget_ms=25) == 25
    assert ms(None) == ms(10, iterations=2) == 33  # what is not played in real time does not depend on rates


@pytest.mark.parametrize(
    ("asked", "size"),
    [({}, (960, 768)), ({"width": 480}, (480, 384)), ({"height": 256}, (320, 256)),
     ({"width": 640, "height": 400}, (640, 400)), ({"scale": 0.75}, (720, 576)),
     ({"width": 480, "scale": 0.5}, (240, 192))],
)  # fmt: skip
def test_one_side_of_the_working_size_keeps_the_proportions(
    asked: dict[str, int], size: tuple[int, int]
) -> None:
    assert VisionConfig(**asked).working_size(960, 768) == size  # type: ignore[arg-type]


def numbers(kind: Any, key: str, limits: tuple[object, ...] = ()) -> Iterator[tuple[str, tuple[object, ...]]]:
    """Every number of the configuration: its key, and what limits it."""
    if get_origin(kind) is Annotated:
        inner, *more = get_args(kind)
        yield from numbers(inner, key, (*limits, *more))
    elif isinstance(kind, type) and issubclass(kind, Section):
        for name, field in kind.model_fields.items():
            yield from numbers(field.annotation, f"{kind.__name__}.{name}", tuple(field.metadata))
    elif kind in (int, float):
        yield key, limits
    else:
        for inner in get_args(kind):
            yield from numbers(inner, key, limits)


def test_every_number_has_a_lower_and_an_upper_limit() -> None:
    every = dict(numbers(LaunchConfig, ""))
    assert {"MappingConfig.budget_ms", "GeometryConfig.crop", "LaunchConfig.segments"} <= set(every)
    for key, limits in every.items():
        assert any(isinstance(one, Ge | Gt) for one in limits), key
        assert any(isinstance(one, Le) for one in limits), key


@pytest.mark.parametrize("number", [".inf", "-.inf", ".nan", "1.0e300"])
def test_a_number_beyond_its_limits_is_told(number: str) -> None:
    for key in ("source.start", "source.rate", "vision.stereo.max_depth", "mapping.budget_ms"):
        with pytest.raises(UsageError, match=re.escape(key)):
            load_launch(None, [f"{key}:={number}"])


def test_parameters_are_validated_like_a_file() -> None:
    config = LaunchConfig()
    assert with_parameters(config, {"mapping.budget_ms": 20}).mapping.budget_ms == 20
    with pytest.raises(UsageError, match="budget_ms"):
        with_parameters(config, {"mapping.budget_ms": "soon"})
    with pytest.raises(UsageError, match="less than or equal to 1000"):
        with_parameters(config, {"mapping.budget_ms": 33000})
