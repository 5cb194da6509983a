"""Depth by networks of every convention, in real ONNX Runtime sessions, and what happens when one fails."""

import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import yaml
from frames import played
from numbered_pictures import write_video
from onnx_networks import save_matcher, save_odd, save_table

from sags_node.confidence import SURE, confidence_of
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import OnnxConfig, StereoConfig
from sags_node.errors import SagsError, UsageError
from sags_node.findings import by_code
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.types import F32, U8, Bool, FrameResult, StereoFrame
from sags_node.vision.mono_depth import MonoDepth, fit_scale_shift
from sags_node.vision.onnx_depth import DepthNetwork
from sags_node.vision.onnx_session import DepthNetworkError
from sags_node.vision.rectify import Rectifier
from sags_node.vision.watch.pair_watch import PairWatch
from sags_node.vision.watch.scene_watch import SceneWatch

WIDTH, HEIGHT = 320, 256
FRAMES = 30


class Scene(NamedTuple):
    """What a network is shown, and the truth."""

    left: U8  # [H, W, 3]
    right: U8
    disparity: F32  # [H, W] px, 0 unknown
    seen: Bool  # [H, W] known, and seen by both eyes
    focal_baseline: float  # px m


@pytest.fixture(scope="module")
def frames(phantom_session: Path) -> list[StereoFrame]:
    return played(load_launch(phantom_session, ["source.pace:=step", f"source.frames:={FRAMES}"]).source)


@pytest.fixture(scope="module")
def scene(phantom_session: Path, frames: list[StereoFrame]) -> Scene:
    rectifier = Rectifier(open_session(phantom_session).rig, WIDTH, HEIGHT)
    pair = rectifier(frames[5])
    focal_baseline = float(rectifier.camera.K[0, 0]) * rectifier.baseline
    depth = truth(frames[5])
    disparity = np.divide(focal_baseline, depth, out=np.zeros_like(depth), where=depth > 0)
    seen = (depth > 0) & (np.arange(WIDTH) > disparity + 4)
    assert pair.right is not None
    return Scene(pair.left, pair.right, disparity, seen, focal_baseline)


def truth(frame: StereoFrame) -> F32:
    assert frame.reference is not None and frame.reference.depth is not None
    return frame.reference.depth


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "network.onnx"


def load(path: Path, scene: Scene, **said: Any) -> DepthNetwork:
    return DepthNetwork(OnnxConfig(path=path, threads=2, **said), (WIDTH, HEIGHT), scene.focal_baseline)


def error(network: DepthNetwork, scene: Scene) -> float:
    found = network(scene.left, scene.right)
    assert found.shape == scene.disparity.shape and found.dtype == np.float32
    return float(np.median(np.abs(found - scene.disparity)[scene.seen]))


# ---- stereo networks -------------------------------------------------------------------------------------

PAIR: dict[str, Any] = {"inputs": ("first", "second"), "meaning": "disparity", "normalization": "bytes"}
OPEN = {**PAIR, "multiple": 32}  # a network that takes any size
HITNET = {"meaning": "disparity", "normalization": "unit"}
LIGHT_STEREO = {"inputs": ("left_img", "right_img"), "meaning": "disparity", "normalization": "imagenet"}
GUIDED = ("init_left", "init_right", "first", "second")
FIXED = (WIDTH, HEIGHT)
NETWORKS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # how they are made, and described
    "any size": ({}, OPEN),
    "any size, one is chosen": ({}, PAIR | {"size": (256, 192)}),
    "only the width is fixed": ({"size": (300, "h")}, OPEN),
    "larger than the image": ({"size": (448, 320)}, PAIR),
    "LightStereo's": ({"expects": "imagenet", "size": FIXED, "names": LIGHT_STEREO["inputs"]}, LIGHT_STEREO),
    "HITNet's": ({"concatenated": True, "expects": "unit", "size": FIXED}, HITNET),
    "HITNet's, in grey": (
        {"concatenated": True, "channels": 1, "expects": "unit"}, HITNET | {"multiple": 1}
    ),
    "CREStereo's": ({"size": FIXED, "guided": True}, PAIR | {"inputs": GUIDED}),
    "RAFT-Stereo's: negative": ({"factor": -1.0}, OPEN | {"scale": -1}),
    "channels last": ({"nhwc": True, "expects": "symmetric"}, OPEN | {"normalization": "symmetric"}),
    "channels last, whole levels": ({"nhwc": True, "uint8": True}, {**OPEN, "normalization": None}),
    "half the size, in its px": ({"output": "half", "factor": 0.5}, OPEN | {"scale": 2}),
    "one of several outputs": ({"output": "several"}, OPEN | {"output": "final"}),
    "depth of this rig, in mm": ({"depth_of": 1000.0}, OPEN | {"meaning": "depth", "scale": 1e-3}),
}  # fmt: skip


@pytest.mark.parametrize("name", NETWORKS)
def test_a_stereo_network_is_fed_and_read_as_it_is_described(name: str, scene: Scene, path: Path) -> None:
    made, said = NETWORKS[name]
    if "depth_of" in made:
        made = {"depth_of": made["depth_of"] * scene.focal_baseline}
    network = load(save_matcher(path, **made), scene, **said)
    assert network.is_stereo and network.processor == "cpu"
    assert error(network, scene) < 0.6


def test_a_size_that_is_no_multiple_is_padded_and_cut_off_again(scene: Scene, path: Path) -> None:
    config = OnnxConfig(path=save_matcher(path), threads=2, **OPEN)
    odd = Scene(scene.left[:-3, :-5], scene.right[:-3, :-5], *(a[:-3, :-5] for a in scene[2:4]), 1.0)
    assert error(DepthNetwork(config, (WIDTH - 5, HEIGHT - 3), scene.focal_baseline), odd) < 0.6


# ---- what is said, and what is missing -------------------------------------------------------------------


def test_metadata_sidecar_and_launch_file_say_more_in_this_order(scene: Scene, path: Path) -> None:
    said = {"inputs": "[first, second]", "meaning": "disparity", "multiple": "32", "scale": "-1"}
    save_matcher(path, metadata={**said, "normalization": "unit", "author": "somebody"})
    assert error(load(path, scene, normalization="bytes", scale=1.0), scene) < 0.6
    assert error(load(path, scene), scene) > 5
    path.with_suffix(".yaml").write_text("normalization: bytes\nscale: 1\n")
    assert error(load(path, scene), scene) < 0.6
    assert error(load(path, scene, scale=-1.0), scene) > 5


def test_a_name_of_digits_is_a_name(scene: Scene, path: Path) -> None:
    """PyTorch gives such names; in YAML they are numbers."""
    more = {key: value for key, value in OPEN.items() if key != "inputs"}
    for metadata, sidecar in [
        ({"inputs": "[10, 11]", "output": "6187"}, "{}"),
        ({}, "{inputs: [10, 11], output: 6187}"),
    ]:
        save_matcher(path, names=("10", "11"), output="6187", metadata=metadata)
        path.with_suffix(".yaml").write_text(sidecar)
        assert error(load(path, scene, **more), scene) < 0.6
    vision = load_launch(None, ["vision.onnx.inputs:=[10, 11]", "vision.onnx.output:=6187"]).vision
    assert (vision.onnx.inputs, vision.onnx.output) == (("10", "11"), "6187")


@pytest.mark.parametrize("key", ["inputs", "normalization", "multiple", "output", "meaning"])
def test_what_is_missing_is_named_with_what_the_file_says(key: str, scene: Scene, path: Path) -> None:
    said = {**OPEN, "output": "final"}
    with pytest.raises(UsageError) as caught:
        load(save_matcher(path, output="several"), scene, **{**said, key: None})
    text = str(caught.value)
    assert "inputs: first 1x3xhxw tensor(float), second 1x3xhxw" in text and "outputs: certainty " in text
    _, _, missing = text.partition(" beside it: ")
    named = [each for each in (*said, "layout") if f"{each} (" in missing or f"or {each} (" in missing]
    assert named == [key] and "\n" not in text and "docs/networks.md" in text


def test_an_open_shape_does_not_say_where_the_channels_are(scene: Scene, path: Path) -> None:
    save_odd(path, {"a": [1, "a", "b", "c"]}, "same")
    said = {"normalization": "unit", "meaning": "inverse_depth", "multiple": 1}
    with pytest.raises(UsageError, match=r"layout \(nchw or nhwc\)"):
        load(path, scene, **said)
    assert load(path, scene, **said, layout="nchw")(scene.left, None).shape == (HEIGHT, WIDTH)


def odd(output: str = "same", **inputs: Sequence[Any]) -> Callable[[Path], None]:
    """A network of those inputs, and beside it what it needs but for the size."""

    def save(path: Path) -> None:
        said = {"normalization": "unit", "meaning": "disparity", "inputs": list(inputs)}
        save_odd(path, inputs, output).with_suffix(".yaml").write_text(yaml.safe_dump(said))

    return save


def too_large(path: Path) -> None:
    """It is not opened: that would be said to be no model."""
    with path.open("wb") as sparse:
        sparse.truncate(2**31 + 1)


PICTURE = [1, 3, "h", "w"]
SMALL = odd(x=[1, 3, 64, 96])


@pytest.mark.parametrize(
    ("save", "said", "words"),
    [
        (lambda path: None, "", "is no file; check the path"),
        (lambda path: path.write_text("not a model\n"), "", "is no ONNX model that can be run"),
        (too_large, "", "2 GB at most"),
        (save_matcher, "normalisation: unit", "unknown key 'normalisation'; did you mean 'normalization'"),
        (save_matcher, "normalization: half", "normalization: .*one of unit, bytes, imagenet, symmetric"),
        (save_matcher, "meaning: inverse_depth", "meaning: a stereo network gives disparity or depth"),
        (save_matcher, "inputs: [left, right]", "inputs: its inputs are first, second"),
        (save_matcher, "output: depth", "output: its outputs are disparity"),
        (save_matcher, "scale: 0", "network.yaml: scale: .*should not be 0"),
        (save_matcher, "{size: [128, 96], multiple: 10}", "multiple: 10 px, but file or size fix 128x96"),
        (SMALL, "size: [128, 96]", "size: 128x96 px, but its file takes 96x64 alone"),
        (odd("sequence", x=[1, 3, 64, 96]), "multiple: 32", "network.onnx gives no tensor: outputs: out seq"),
        (odd(x=[1, 10]), "multiple: 1", "network.onnx: input x is 1x10; an image is"),
        (odd(x=[4, 3, "h", "w"]), "multiple: 1", "network.onnx: .*batch size 1"),
        (odd(a=PICTURE, b=PICTURE, c=PICTURE), "multiple: 1", r"network.onnx takes 3 inputs \(a, b, c\)"),
        (odd(a=[1, 5, 64, 64], b=[1, 5, 64, 64]), "multiple: 1", "network.onnx: .*a (has 5|is 1x5x64x64)"),
        (odd("small", a=PICTURE, b=PICTURE), "multiple: 1", "network.onnx: .*out is not a map of the 320"),
        (odd(a=[1, 3, 5000, 5000]), "multiple: 1", "network.onnx: .*more than 4096 px"),
    ],
    ids=lambda value: "" if callable(value) else value,
)  # fmt: skip
def test_a_wrong_network_or_description_is_refused_in_one_line_with_its_fix(
    save: Callable[[Path], object], said: str, words: str, scene: Scene, path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    save(path)
    sidecar = path.with_suffix(".yaml")
    if said:
        sidecar.write_text(f"{sidecar.read_text() if sidecar.exists() else ''}{said}\n")
    with pytest.raises(UsageError, match=words) as caught:
        load(path, scene)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")  # the runtime says nothing of its own


def test_a_provider_that_is_not_there_is_passed_over(scene: Scene, path: Path) -> None:
    import onnxruntime

    save_matcher(path)
    assert load(path, scene, **OPEN, providers=("cuda", "cpu")).processor in ("cuda", "cpu")
    if "CUDAExecutionProvider" not in onnxruntime.get_available_providers():
        with pytest.raises(UsageError, match="none of cuda"):
            load(path, scene, providers=("cuda",))


# ---- through the pipeline --------------------------------------------------------------------------------

Build = Callable[..., Pipeline]


@pytest.fixture
def build(phantom_session: Path, path: Path) -> Build:
    """A pipeline with the monocular network of a file, or with a matcher that is made so."""

    def build(network: Path | None, *overrides: str, **made: Any) -> Pipeline:
        said = {"path": network or save_matcher(path, **made), "threads": 2}
        said |= {"normalization": "imagenet", "meaning": "inverse_depth"} if network else OPEN
        shown = [f"vision.onnx.{key}:={list(v) if key == 'inputs' else v}" for key, v in said.items()]
        opened = open_session(phantom_session, ["source.pace:=step", *shown, *overrides])
        return Pipeline(opened.config, opened.rig)

    return build


def play(pipeline: Pipeline, frames: Sequence[StereoFrame]) -> list[FrameResult]:
    budget = StepBudget(1)
    return [pipeline.process(frame, budget) for frame in frames]


def depth_error(result: FrameResult, frame: StereoFrame) -> tuple[float, float]:
    """Median error, as a share of the depth, and how much of the tissue it was measured on."""
    found, true = result.observation.depth, truth(frame)
    both = (found > 0) & (true > 0)
    return float(np.median(np.abs(found - true)[both] / true[both])), both.sum() / (true > 0).sum()


def check_depth(results: list[FrameResult], frames: list[StereoFrame], most: float) -> None:
    """Of all frames and nearly all of their tissue, wrong by at most so much."""
    figures = [depth_error(result, frame) for result, frame in zip(results, frames, strict=False)]
    assert not any(result.skipped for result in results)
    assert max(off for off, _ in figures) < most, figures
    assert min(share for _, share in figures) > 0.8, figures


def dark(frame: StereoFrame) -> StereoFrame:
    """Where a network of these tests fails; see `unwatched`."""
    return replace(frame, left=frame.left // 8, right=frame.right // 8)


def one_eye(frame: StereoFrame) -> StereoFrame:
    return replace(frame, right=None)


@pytest.fixture
def unwatched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dark images are taken in: else no network would ever see one."""
    for watch in (PairWatch, SceneWatch):
        monkeypatch.setattr(watch, "judge", lambda self, evidence, judged: judged)


@pytest.mark.fault("network: a depth network fails or gives NaN")
@pytest.mark.usefixtures("unwatched")
@pytest.mark.parametrize(("fault", "words"), [("nan", "not finite"), ("error", "failed: .*(Gather|indices)")])
def test_a_network_replaces_the_matcher_which_takes_over_where_it_fails_and_says_so(
    fault: str, words: str, build: Build, frames: list[StereoFrame], caplog: pytest.LogCaptureFixture
) -> None:
    pipeline = build(None, fault=fault)
    shown = [frames[0], dark(frames[1]), frames[2], *map(dark, frames[3:7]), frames[7]]
    with caplog.at_level(logging.WARNING):
        results = play(pipeline, shown)
    failed = [bool(result.skipped.get("network")) for result in results]
    assert failed == [False, True, False, True, True, True, True, True]  # the last: not tried any more
    matched = [pipeline.depth.stereo(each.pair, each.observation.tissue)[0] for each in results[:2]]
    seen = results[0].observation
    off, share = depth_error(results[0], frames[0])
    assert off < 0.02 and share > 0.6 and not np.array_equal(matched[0], seen.depth)
    assert ((seen.depth_confidence > 0) <= (seen.depth > 0)).all() and seen.depth_confidence.max() <= 1
    depth = results[1].observation.depth
    kept = depth > 0  # all but specks, of which so dark an image has some
    assert np.array_equal(depth[kept], matched[1][kept])
    assert np.count_nonzero(kept) > 0.5 * np.count_nonzero(matched[1])
    reason = results[1].skipped["network"]
    assert re.search(words, reason) and reason.startswith("network.onnx") and "\n" not in reason
    assert by_code(pipeline.warnings)["network_failed"].startswith("network.onnx")
    assert [record.levelname for record in caplog.records] == ["WARNING"] * 3  # twice news, once the end
    assert "3 times in a row: not tried again" in results[-1].skipped["network"]


@pytest.mark.fault("network: its sign, scale or order of eyes is described wrongly")
@pytest.mark.parametrize(
    ("made", "said"),
    [
        ({"factor": -1.0}, ()),
        ({"output": "half", "factor": 0.5}, ()),  # px of the smaller map
        ({"factor": 1 / 320}, ()),  # widths of the image
        ({"names": ("second", "first")}, ()),  # the eyes are exchanged
        ({}, ("vision.onnx.scale:=1.2",)),
    ],
    ids=str,
)
def test_a_network_that_is_described_wrongly_is_told_of_and_not_used(
    made: dict[str, Any], said: tuple[str, ...], build: Build, frames: list[StereoFrame]
) -> None:
    pipeline = build(None, *said, **made)
    for result, frame in zip(play(pipeline, frames[:4]), frames, strict=False):
        assert "check vision.onnx: meaning, scale" in result.skipped["network"]
        off, share = depth_error(result, frame)
        assert off < 0.02 and share > 0.6  # it is matched
    assert "network_failed" in by_code(pipeline.warnings)


# ---- one eye ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pictures(phantom_session: Path, frames: list[StereoFrame]) -> np.ndarray:
    """[N, H, W, 3] as the network sees them."""
    rectifier = Rectifier(open_session(phantom_session).rig, WIDTH, HEIGHT)
    return np.stack([rectifier(frame).left for frame in frames])


@pytest.fixture(scope="module")
def knowing(
    pictures: np.ndarray, frames: list[StereoFrame], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A monocular network that is right but for scale and shift, which differ from frame to frame."""
    rng = np.random.default_rng(0)
    maps = []
    for place, frame in enumerate(frames):
        depth = truth(frame)
        inverse = np.divide(1, depth, out=np.full_like(depth, 1 / 0.04), where=depth > 0)
        shift = 0.0 if place == 0 else rng.uniform(-5, 5)
        maps.append(rng.uniform(0.02, 0.05) * (inverse + shift) + rng.normal(0, 0.002, depth.shape))
    return save_table(tmp_path_factory.mktemp("mono") / "network.onnx", pictures, np.stack(maps))


def declared(frames: list[StereoFrame], times: float = 1.0) -> str:
    """The distance of the first frame's tissue, or a wrong one."""
    known = truth(frames[0])
    return f"vision.onnx.declared_depth:={times * float(np.median(known[known > 0]))}"


def test_a_monocular_network_takes_one_picture(knowing: Path, scene: Scene) -> None:
    network = load(knowing, scene, normalization="imagenet", meaning="inverse_depth")
    assert not network.is_stereo
    relative = network(scene.left, None)
    assert np.corrcoef(relative[scene.seen], scene.disparity[scene.seen])[0, 1] > 0.99
    with pytest.raises(UsageError, match="meaning: a monocular network gives inverse_depth or depth"):
        load(knowing, scene, meaning="disparity")


def test_scale_and_shift_are_found_among_outliers_and_a_map_turned_round_is_refused() -> None:
    rng = np.random.default_rng(0)
    inverse = rng.uniform(10, 30, (100, 120))
    relative = (0.03 * inverse - 0.2 + rng.normal(0, 0.003, inverse.shape)).astype(np.float32)
    depth = (1 / inverse).astype(np.float32)
    depth[:40] = rng.uniform(0.02, 0.06, (40, 120))  # moved, or wrong
    depth[90:] = 0
    relative[50, 50] = np.nan
    everywhere = np.ones(depth.shape, bool)
    found = fit_scale_shift(relative, depth, everywhere)
    assert found.scale == pytest.approx(1 / 0.03, rel=0.02)
    assert found.shift == pytest.approx(0.2 / 0.03, abs=0.3)
    assert fit_scale_shift(np.ones_like(relative), depth, everywhere) is None
    assert fit_scale_shift(relative, depth * (np.arange(120) == 3), everywhere) is None  # 90 px
    with pytest.raises(DepthNetworkError, match="does not rise"):
        MonoDepth(None, StereoConfig())(-np.nan_to_num(relative), everywhere, lambda: depth)


def knocked(frame: StereoFrame, aside: int) -> StereoFrame:
    """The right eye turned: its image stands 3 px lower."""
    assert frame.right is not None
    height, width = frame.right.shape[:2]
    shift = np.array([[1, 0, aside], [0, 1, 3]], np.float32) * (1, 1, height / HEIGHT)
    moved = cv2.warpAffine(frame.right, shift, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return replace(frame, right=np.asarray(moved, np.uint8))


@pytest.mark.fault("network: a monocular one beside eyes whose matches are no depth")
@pytest.mark.parametrize("aside", [0, -4])
def test_a_monocular_network_is_laid_onto_matches_but_not_where_they_are_no_depth(
    aside: int, knowing: Path, build: Build, frames: list[StereoFrame]
) -> None:
    """That is no failure of the network: it goes on with the first match that is sound."""
    shown = [knocked(frame, aside) if 15 <= frame.frame_id < 23 else frame for frame in frames]
    results = play(build(knowing), shown)
    check_depth(results[:15] + results[23:], frames[:15] + frames[23:], 0.02)
    for result in results[15:23]:
        assert not result.observation.depth.any() and "network" not in result.skipped
        assert "so there is no depth" in result.skipped["depth"]


def test_one_camera_alone_keeps_the_declared_scale(
    knowing: Path, build: Build, frames: list[StereoFrame]
) -> None:
    results = play(build(knowing, declared(frames)), list(map(one_eye, frames)))
    check_depth(results, frames, 0.04)
    assert all(result.snapshot.loss < 0.05 for result in results[1:])


@pytest.mark.fault("depth: one camera alone, its distance declared wrong")
@pytest.mark.parametrize(("shown", "is_sure"), [(one_eye, False), (lambda frame: frame, True)])
def test_a_declared_scale_makes_no_depth_sure(
    shown: Callable[[StereoFrame], StereoFrame], is_sure: bool, knowing: Path, build: Build,
    frames: list[StereoFrame],
) -> None:  # fmt: skip
    """Nothing tells that it is off by a half, but beside a right eye, which measures it."""
    pipeline = build(knowing, declared(frames, times=1.5))
    last = play(pipeline, list(map(shown, frames[:12])))[-1]
    view, errors = last.views["left"], last.snapshot.gaussians.depth_errors
    assert last.observation.depth.any() and view.confidence is not None and errors is not None
    row, column = divmod(int(np.argmax(view.confidence * last.observation.tissue)), WIDTH)
    pinned = pipeline.anchors.add_pixel(column, row, last.observation, last.snapshot, view)
    most = [view.confidence.max(), confidence_of(errors).max(), pipeline.anchor_confidence(pinned)]
    assert [sure >= SURE for sure in most] == 3 * [is_sure]
    assert ("scale_declared" in by_code(pipeline.warnings)) != is_sure


@pytest.mark.usefixtures("unwatched")
@pytest.mark.parametrize(
    ("stereo", "shown", "override", "error", "words"),
    [
        (True, dark, "vision.onnx.fallback:=false", DepthNetworkError, "not finite"),
        (True, one_eye, "vision.onnx.fallback:=true", UsageError, "has no right eye; name a monocular one"),
        (False, one_eye, "vision.onnx.fallback:=true", UsageError, r"set vision\.onnx\.declared_depth"),
    ],
    ids=["no fallback", "one eye for two", "no distance"],
)
def test_what_no_other_depth_can_replace_ends_the_run(
    stereo: bool, shown: Callable[[StereoFrame], StereoFrame], override: str, error: type[SagsError],
    words: str, knowing: Path, build: Build, frames: list[StereoFrame],
) -> None:  # fmt: skip
    pipeline = build(None, override, fault="nan") if stereo else build(knowing, override)
    with pytest.raises(error, match=words):
        play(pipeline, [shown(frames[0])])


def test_where_one_camera_s_network_fails_depth_is_unknown(
    pictures: np.ndarray, build: Build, frames: list[StereoFrame], path: Path
) -> None:
    maps = np.full((2, HEIGHT, WIDTH), np.linspace(1, 2, WIDTH))
    maps[1] = np.nan
    pipeline = build(save_table(path, pictures[:2], maps), "vision.onnx.declared_depth:=0.07")
    good, bad = play(pipeline, list(map(one_eye, frames[:2])))
    assert good.observation.depth.any() and "network" not in good.skipped
    assert not bad.observation.depth.any() and "not finite" in bad.skipped["network"]
    assert len(bad.snapshot.gaussians) > 200  # the model goes on


@pytest.mark.parametrize("kind", ["folders", "videos"])
def test_a_recording_of_one_camera_is_played(
    kind: str, knowing: Path, phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = phantom_session / "left"
    if kind == "videos":
        pictures = [cv2.imread(str(file))[..., ::-1] for file in sorted(left.iterdir())[:3]]
        left = write_video(tmp_path / "film.avi", pictures, 10.0)
    (tmp_path / "network.onnx").write_bytes(knowing.read_bytes())
    (tmp_path / "ost.yaml").write_text((phantom_session / "calib/left.yaml").read_text())
    onnx = {"path": "network.onnx", "normalization": "imagenet", "meaning": "inverse_depth", "threads": 2}
    tree = {
        "source": {"kind": kind, "left": str(left), "pace": "step"},
        "rig": "ost.yaml",
        "vision": {"onnx": onnx | {"declared_depth": 0.07}},
    }
    launch = tmp_path / "launch.yaml"
    launch.write_text(yaml.safe_dump(tree))
    monkeypatch.chdir("/")  # its paths are those of its own folder
    session = open_session(launch, ["source.frames:=2"])
    assert session.config.publish.right is False  # as `auto` is where there is none
    results = play(Pipeline(session.config, session.rig), played(session.config.source))
    assert len(results) == 2
    for result in results:
        depth = result.observation.depth
        assert result.pair.right is None and not result.skipped
        assert np.median(depth[depth > 0]) == pytest.approx(0.07, rel=0.02)
        assert len(result.snapshot.gaussians) > 200
    for override, words in [
        ("vision.onnx.path:=null", r"source\.right is missing: .*vision\.onnx\.path"),
        ("publish.right:=true", r"publish\.right: there is no right eye"),
        ("rig:=/nowhere/ost.yaml", r"cannot read calibration|does not exist"),
    ]:
        with pytest.raises(UsageError, match=words):
            open_session(launch, [override])
