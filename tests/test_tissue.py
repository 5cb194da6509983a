"""Tissue masks: the session's, a network's, and those found by colour and by misfit to the model."""

import os
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from onnx_networks import FLOAT, Graph, floats

from sags_node.calibration import load_rig, rectified_rig
from sags_node.config import LaunchConfig, PhantomSource, TissueConfig
from sags_node.errors import UsageError
from sags_node.launch_file import load_launch
from sags_node.mapping.budget import StepBudget
from sags_node.messaging.masks import MaskSubscriber
from sags_node.phantom.scene import Phantom
from sags_node.pipeline import Pipeline
from sags_node.types import U8, Bool, Camera, RectifiedPair, RenderedView, StereoFrame
from sags_node.vision.rectify import Rectifier
from sags_node.vision.tissue import FIRST_FRAMES, TissueMask
from sags_node.vision.tissue_classical import LONGEST_DOUBT, InstrumentFinder

ROOT = Path(__file__).parent.parent
DATA = Path(os.environ.get("SAGS_DATA", ROOT / "../shared/data"))
WIDTH, HEIGHT = 320, 256
FRAME_NS = 33_333_333
SHAFT, GOLD, JAW = (
    (slice(110, 150), slice(240, 320)),
    (slice(112, 148), slice(200, 240)),
    (120, 140, 150, 200),
)


def make_frame(left: U8, tissue: Bool | None = None, number: int = 0) -> StereoFrame:
    return StereoFrame(number, number * FRAME_NS, number * FRAME_NS, left, left, tissue=tissue)


def textured_tissue(seed: int = 0) -> U8:
    rng = np.random.default_rng(seed)
    shade = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)), (0, 0), 5)
    shade = 1 + 0.12 * shade / shade.std()
    return np.clip(shade[..., None] * (170, 88, 84), 0, 255).astype(np.uint8)


def noisy(picture: U8, seed: int) -> U8:
    noise = np.random.default_rng(seed).normal(0, 5, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def drawn(picture: U8) -> RenderedView:
    """A model that looks like this picture."""
    camera = Camera(WIDTH, HEIGHT, np.eye(3), np.eye(4))
    plane = np.ones((HEIGHT, WIDTH), np.float32)
    return RenderedView(0, 0, camera, picture.astype(np.float32) / 255, plane, plane)


def iou(a: Bool, b: Bool) -> float:
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


# ---- the session's masks ---------------------------------------------------------------------------------


def flat_frame(tissue: Bool | None) -> tuple[StereoFrame, Rectifier, RectifiedPair]:
    rectifier = Rectifier(load_rig(ROOT / "calib/d4d"), 675, 540)
    frame = make_frame(np.full((540, 675, 3), (180, 90, 90), np.uint8), tissue)
    return frame, rectifier, rectifier(frame)


def test_session_masks_are_dilated_and_boxes_left_out() -> None:
    tissue = np.ones((540, 675), np.bool_)
    tissue[200:300, 400:] = False
    frame, rectifier, pair = flat_frame(tissue)
    mask = TissueMask(TissueConfig(dilate=3, exclude=((10, 20, 30, 40),)), rectifier)(frame, pair)
    expected = np.ones((540, 675), np.bool_)
    expected[197:303, 397:] = False
    expected[20:60, 10:40] = False
    assert (mask != expected).sum() < 30  # the ellipse rounds the corners
    assert not mask[~tissue].any()


def test_no_method_uses_every_pixel_but_the_boxes() -> None:
    frame, rectifier, pair = flat_frame(np.zeros((540, 675), np.bool_))
    mask = TissueMask(TissueConfig(method="none", exclude=((0, 0, 5, 5),)), rectifier)(frame, pair)
    assert (~mask).sum() == 25


@pytest.mark.parametrize("box", [(-1, 0, 5, 5), (670, 0, 6, 5), (0, 0, 0, 5), (0, 539, 5, 2)])
def test_a_box_outside_the_picture_is_refused(box: tuple[int, int, int, int]) -> None:
    with pytest.raises(UsageError, match="675x540"):
        TissueMask(TissueConfig(exclude=(box,)), Rectifier(load_rig(ROOT / "calib/d4d"), 640, 512))


def test_masks_upside_down_are_refused_with_a_hint() -> None:
    tissue = np.zeros((540, 675), np.bool_)
    tissue[200:300, 400:] = True
    frame, rectifier, pair = flat_frame(tissue)
    find_tissue = TissueMask(TissueConfig(), rectifier)
    for _ in range(FIRST_FRAMES - 1):
        find_tissue(frame, pair)
    with pytest.raises(UsageError, match=r"over half.*upside down.*source\.instruments.*method:=classical"):
        find_tissue(frame, pair)


def test_an_instrument_may_come_close_for_a_while() -> None:
    """One ordinary mask among the first is enough, and later ones are not judged."""
    upside_down, rectifier, pair = flat_frame(np.zeros((540, 675), np.bool_))
    ordinary, _, _ = flat_frame(np.ones((540, 675), np.bool_))
    find_tissue = TissueMask(TissueConfig(), rectifier)
    for frame in [upside_down] * (FIRST_FRAMES - 1) + [ordinary] + [upside_down] * FIRST_FRAMES:
        assert find_tissue(frame, pair).any() == (frame is ordinary)


# ---- found without masks ---------------------------------------------------------------------------------


def test_grey_and_gold_that_come_in_from_the_edge_are_instruments() -> None:
    picture = textured_tissue()
    picture[SHAFT] = (150, 150, 152)
    picture[GOLD] = (170, 140, 50)
    found = InstrumentFinder()(picture)
    truth = np.zeros((HEIGHT, WIDTH), np.bool_)
    truth[SHAFT] = truth[GOLD] = True
    assert iou(found, truth) > 0.9


def test_a_jaw_that_mirrors_tissue_is_found_by_what_it_hides() -> None:
    tissue = textured_tissue()
    picture = tissue.copy()
    picture[SHAFT] = picture[GOLD] = (150, 150, 152)
    jaw = np.zeros((HEIGHT, WIDTH), np.bool_)
    jaw[JAW[0] : JAW[1], JAW[2] : JAW[3]] = True
    picture[jaw] = (150, 100, 97)
    assert InstrumentFinder()(picture)[jaw].mean() < 0.2
    found = InstrumentFinder()(picture, drawn(tissue))
    assert found[jaw].mean() > 0.85  # its corners are rounded
    assert found[:, :140].mean() == 0


def test_highlights_stay_tissue_also_beside_an_instrument() -> None:
    tissue = textured_tissue()
    picture = tissue.copy()
    picture[SHAFT] = (150, 150, 152)
    picture[125:135, 260:300] = 255  # on the instrument
    lights = np.zeros((HEIGHT, WIDTH), np.bool_)
    lights[40:52, 60:72] = True
    lights[150:180, 250:258] = True  # touches the shaft
    lights[0:10, 30:45] = True  # at the picture's edge
    picture[lights] = 255
    for expected in (None, drawn(tissue)):
        found = InstrumentFinder()(picture, expected)
        assert found[lights].mean() < 0.1
        assert found[SHAFT].mean() > 0.9


def test_a_pale_patch_inside_and_a_dark_picture() -> None:
    picture = textured_tissue()
    picture[60:120, 100:180] = (190, 170, 160)  # gauze
    assert not InstrumentFinder()(picture).any()
    assert InstrumentFinder()(np.full((60, 80, 3), 3, np.uint8)).all()


def test_tissue_that_the_model_does_not_know_is_let_go_in_time() -> None:
    """Pale tissue moves in from the edge over a redder model that would never be mended."""
    tissue = textured_tissue()
    picture = tissue.copy()
    picture[SHAFT] = (150, 150, 152)
    moved = np.zeros((HEIGHT, WIDTH), np.bool_)
    moved[150:200, 240:] = True
    picture[moved] = (150, 104, 100)
    find = InstrumentFinder()
    held = [find(picture, drawn(tissue), number * FRAME_NS)[moved].mean() for number in range(90)]
    assert held[0] > 0.9
    longest = round(LONGEST_DOUBT * 30)
    assert min(held[longest : longest + 3]) < 0.1
    released = np.flatnonzero(np.array(held) < 0.1)
    assert np.diff(released).max() <= longest + 1  # again and again
    model, number = drawn(picture), 90  # what was let go was learnt: it stays tissue
    assert all(find(picture, model, (number + i) * FRAME_NS)[moved].mean() < 0.1 for i in range(60))
    assert find(picture, model, 151 * FRAME_NS)[SHAFT].mean() > 0.9  # an instrument is not let go


def test_tissue_that_an_instrument_has_left_is_tissue_at_once() -> None:
    """Where the model drew the instrument itself, which it should not have learnt."""
    tissue = textured_tissue()
    with_shaft = tissue.copy()
    with_shaft[SHAFT] = (150, 150, 152)
    find = InstrumentFinder()
    assert find(with_shaft, drawn(with_shaft), 0)[SHAFT].mean() > 0.9
    assert find(tissue, drawn(with_shaft), FRAME_NS)[SHAFT].mean() == 0


def test_noise_makes_a_remembered_mask_flicker_less() -> None:
    """A part in doubt: half of its evidence is noise."""
    picture = textured_tissue()
    picture[SHAFT] = (150, 150, 152)
    picture[GOLD] = (150, 138, 130)
    picture[GOLD][::2] = (150, 128, 120)
    flickering = {}
    for name in ("remembered", "alone"):
        find = InstrumentFinder()
        masks = []
        for number in range(24):
            if name == "alone":
                find = InstrumentFinder()
            masks.append(find(noisy(picture, number), drawn(picture), number * FRAME_NS))
        flickering[name] = np.mean([(a != b)[:, 150:].mean() for a, b in pairwise(masks)])
    assert flickering["alone"] > 0.0005
    assert flickering["remembered"] < 0.7 * flickering["alone"]


def test_instruments_of_the_phantom_while_it_is_mapped() -> None:
    """The masks shape the model, and the model the masks."""
    source = PhantomSource(width=WIDTH, height=HEIGHT, seconds=4.0, noise=0.02)
    phantom = Phantom(source)
    config = LaunchConfig.model_validate(
        {
            "source": source,
            "vision": {"tissue": {"method": "classical", "dilate": 0}},
            "mapping": {"max_gaussians": 8000},
        }
    )
    pipeline, budget = Pipeline(config, phantom.rig), StepBudget(1)
    both = either = lost = missed = pixels = tools = 0
    for number in range(30, 54):
        frame = phantom.frame(number, 120)
        stereo = StereoFrame(
            number, number * FRAME_NS, number * FRAME_NS, frame.left, frame.right, 0, frame.T_world_cam
        )
        found = ~pipeline.process(stereo, budget).observation.tissue
        truth = pipeline.rectifier.mask(frame.tool)
        usable = pipeline.rectifier.mask(np.ones_like(frame.tool))
        both += np.count_nonzero(found & truth & usable)
        either += np.count_nonzero((found | truth) & usable)
        lost += np.count_nonzero(found & ~truth & usable)
        missed += np.count_nonzero(truth & ~found)
        pixels += np.count_nonzero(usable & ~truth)
        tools += np.count_nonzero(truth)
    assert both / either > 0.8
    assert lost / pixels < 0.01
    assert missed / tools < 0.2


def test_instruments_of_a_real_session_by_colour_alone() -> None:
    """D4D, every 20th frame: a steel grasper, a gold wrist, a grey spleen at the edge, a large highlight."""
    folder = DATA / "d4d_pull"
    if not folder.is_dir():
        pytest.skip(f"recording d4d_pull is not under SAGS_DATA ({DATA})")
    video = cv2.VideoCapture(str(folder / "2025_03_06-16_49_40_combined_2x2.mp4"))
    both = either = lost = pixels = index = 0
    while video.grab():
        if index % 20 == 0:
            left = cv2.cvtColor(video.retrieve()[1], cv2.COLOR_BGR2RGB)[:540, :675]
            tool = cv2.imread(str(folder / f"toolmask/{index:04d}.png"), cv2.IMREAD_GRAYSCALE) > 127
            found = InstrumentFinder()(left)
            both += np.count_nonzero(found & tool)
            either += np.count_nonzero(found | tool)
            lost += np.count_nonzero(found & ~tool)
            pixels += np.count_nonzero(~tool)
        index += 1
    video.release()
    assert both / either > 0.7
    assert lost / pixels < 0.01


# ---- a network's -----------------------------------------------------------------------------------------


def save_segmenter(path: Path, answer: str, fault: bool = False) -> Path:
    """Redness R - G of a picture fed as for ImageNet: tissue where it is above 40 grey levels.

    Args:
        answer: logit, probability, scores (of grey, nothing, tissue), labels, or half (the logit, coarser).
        fault: not finite where the picture is nearly black.
    """
    g = Graph()
    weights = np.array([0.229, -0.224, 0.0], np.float32)[None, :, None, None] * 255
    redness = g("Add", g("Conv", "picture", weights), floats(255 * (0.485 - 0.456)))
    logit = g("Mul", g("Sub", redness, floats(40)), floats(0.1))
    if fault:
        brightest = g("ReduceMax", "picture", keepdims=0)
        logit = g("Add", logit, g("Mul", g("Sqrt", g("Add", brightest, floats(0.9))), floats(0)))
    nothing = g("Sub", g("Neg", g("Abs", logit)), floats(1))
    made = {
        "logit": lambda: logit,
        "probability": lambda: g("Sigmoid", logit),
        "scores": lambda: g("Concat", g("Neg", logit), nothing, logit, axis=1),
        "labels": lambda: g("Mul", g("Cast", g("Greater", logit, floats(0)), to=FLOAT), floats(1)),
        "half": lambda: g("AveragePool", logit, kernel_shape=[2, 2], strides=[2, 2]),
    }[answer]()
    g.named("mask", made)
    return g.save(path, {"picture": (FLOAT, [1, 3, "h", "w"])}, ["mask"])


def rig_of_tests() -> Rectifier:
    K = np.array([[300.0, 0, WIDTH / 2], [0, 300.0, HEIGHT / 2], [0, 0, 1]])
    return Rectifier(rectified_rig("test", WIDTH, HEIGHT, K, 0.004), WIDTH, HEIGHT)


def instrument_frame() -> tuple[StereoFrame, Bool]:
    picture = textured_tissue()
    picture[SHAFT] = (150, 150, 152)
    truth = np.ones((HEIGHT, WIDTH), np.bool_)
    truth[SHAFT] = False
    return make_frame(picture), truth


@pytest.mark.parametrize(
    ("answer", "tissue_is"),
    [
        ("logit", "white"),
        ("probability", "white"),
        ("labels", "white"),
        ("half", "white"),
        ("scores", "white"),
        ("scores", (2,)),
        ("scores", (1, 2)),
    ],
)
def test_a_networks_mask(tmp_path: Path, answer: str, tissue_is: str | tuple[int, ...]) -> None:
    rectifier = rig_of_tests()
    path = save_segmenter(tmp_path / "net.onnx", answer)
    config = TissueConfig(method="onnx", path=path, tissue_is=tissue_is, dilate=0)
    frame, truth = instrument_frame()
    find_tissue = TissueMask(config, rectifier)
    mask = find_tissue(frame, rectifier(frame))
    assert iou(~mask, ~truth) > 0.97
    assert find_tissue.problem == ""


def test_a_network_read_the_wrong_way_round_is_refused(tmp_path: Path) -> None:
    rectifier = rig_of_tests()
    path = save_segmenter(tmp_path / "net.onnx", "logit")
    find_tissue = TissueMask(TissueConfig(method="onnx", path=path, tissue_is="black"), rectifier)
    frame, _ = instrument_frame()
    with pytest.raises(UsageError, match=r"set vision\.tissue\.tissue_is to white, it is black"):
        for _ in range(FIRST_FRAMES):
            find_tissue(frame, rectifier(frame))


def test_where_the_network_fails_instruments_are_found_without(tmp_path: Path) -> None:
    rectifier = rig_of_tests()
    path = save_segmenter(tmp_path / "net.onnx", "logit", fault=True)
    find_tissue = TissueMask(TissueConfig(method="onnx", path=path, tissue_is="white", dilate=0), rectifier)
    frame, truth = instrument_frame()
    dim = make_frame((frame.left * 0.3).astype(np.uint8))
    assert iou(~find_tissue(dim, rectifier(dim)), ~truth) > 0.9
    assert "not finite" in find_tissue.problem
    find_tissue(frame, rectifier(frame))
    assert find_tissue.problem == ""


def test_the_launch_file_says_what_is_tissue(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="tissue_is"):
        load_launch(None, ["vision.tissue.method:=onnx", f"vision.tissue.path:={tmp_path / 'net.onnx'}"])
    missing = TissueConfig(method="onnx", path=tmp_path / "none.onnx", tissue_is="white")
    with pytest.raises(UsageError, match=r"vision\.tissue\.path.*none\.onnx"):
        TissueMask(missing, rig_of_tests())


def test_a_network_that_gives_no_mask_is_refused(tmp_path: Path) -> None:
    g = Graph()
    g.named("out", g("ReduceMean", "picture", axes=[2, 3]))
    path = g.save(tmp_path / "net.onnx", {"picture": (FLOAT, [1, 3, "h", "w"])}, ["out"])
    with pytest.raises(UsageError, match="no output is a mask of the 320x256 px"):
        TissueMask(TissueConfig(method="onnx", path=path, tissue_is="white"), rig_of_tests())


def test_a_file_that_is_no_network_is_named_by_its_own_setting(tmp_path: Path) -> None:
    """A mask's network is not looked for under vision.onnx, where the depth's is set."""
    path = tmp_path / "net.onnx"
    path.write_bytes(b"this is no network")
    with pytest.raises(UsageError, match=r"^vision\.tissue\.path: .*net\.onnx is no ONNX model"):
        TissueMask(TissueConfig(method="onnx", path=path, tissue_is="white"), rig_of_tests())


# ---- another process's -----------------------------------------------------------------------------------

TOPIC = TissueConfig(method="topic", endpoint="ipc:///run/masks.ipc", tissue_is="white", dilate=0)


class Sender:
    """Stands for the socket: masks by stamp."""

    def __init__(self) -> None:
        self.sent: dict[int, np.ndarray] = {}

    def __call__(self, stamp_ns: int) -> tuple[int, np.ndarray] | None:
        nearest = min(self.sent, key=lambda sent: abs(sent - stamp_ns), default=None)
        return None if nearest is None else (nearest, self.sent[nearest])


def topic_mask(sender: Sender, **changes: object) -> tuple[TissueMask, Rectifier]:
    rectifier = rig_of_tests()
    return TissueMask(TOPIC.model_copy(update=changes), rectifier, sender), rectifier


def shaft_mask() -> tuple[U8, Bool]:
    """As it is sent, white = tissue, and what it means."""
    truth = np.ones((HEIGHT, WIDTH), np.bool_)
    truth[SHAFT] = False
    return truth.view(np.uint8) * np.uint8(255), truth


@pytest.mark.parametrize("tissue_is", ["white", "black"])
def test_the_mask_of_the_nearest_picture_is_taken(tissue_is: str) -> None:
    sender = Sender()
    find_tissue, rectifier = topic_mask(sender, tissue_is=tissue_is)
    values, truth = shaft_mask()
    sent = values if tissue_is == "white" else 255 - values
    sender.sent = {0: np.roll(sent, 30, 0), FRAME_NS: sent, 3 * FRAME_NS: np.roll(sent, 60, 0)}
    frame = make_frame(textured_tissue(), number=1)
    assert np.array_equal(find_tissue(frame, rectifier(frame)), truth)
    assert find_tissue.problem == ""


def test_a_late_mask_is_carried_along_until_its_tolerance_is_over() -> None:
    """Then instruments are found without it, with a word about why, until masks come again."""
    sender = Sender()
    find_tissue, rectifier = topic_mask(sender, tolerance=0.1)
    values, truth = shaft_mask()
    picture = textured_tissue()
    frames = [make_frame(picture, number=number) for number in range(6)]
    assert find_tissue(frames[0], rectifier(frames[0])).all()  # as the classical default: no instrument
    assert "no mask has come on masks/left/tissue_mask from ipc:///run/masks.ipc" in find_tissue.problem
    sender.sent = {0: values}
    for frame in frames[:4]:  # 100 ms
        assert np.array_equal(find_tissue(frame, rectifier(frame)), truth)
        assert find_tissue.problem == ""
    assert find_tissue(frames[4], rectifier(frames[4])).all()
    assert "0.133 s older than the picture; vision.tissue.tolerance is 0.1 s" in find_tissue.problem
    sender.sent[5 * FRAME_NS] = values
    assert np.array_equal(find_tissue(frames[5], rectifier(frames[5])), truth)
    assert find_tissue.problem == ""
    sender.sent = {20 * FRAME_NS: values}
    assert find_tissue(frames[5], rectifier(frames[5])).all()
    assert "newer than the picture" in find_tissue.problem


def test_masks_of_another_size_are_resized() -> None:
    sender = Sender()
    find_tissue, rectifier = topic_mask(sender)
    values, truth = shaft_mask()
    frame = make_frame(textured_tissue())
    for size in ((160, 128), (640, 512), (96, 77)):
        sender.sent = {0: cv2.resize(values, size, interpolation=cv2.INTER_NEAREST)}
        mask = find_tissue(frame, rectifier(frame))
        assert find_tissue.problem == "" and iou(~mask, ~truth) > 0.85


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.full((HEIGHT, WIDTH, 3), 255, np.uint8), "is no mask: mono8 is expected"),
        (np.ones((HEIGHT, WIDTH), np.float32), "is no mask"),
        (np.full((WIDTH, HEIGHT), 255, np.uint8), "has 256x320 px, the picture 320x256"),
        (np.full((16 * HEIGHT, 16 * WIDTH), 255, np.uint8), "has 5120x4096 px"),
        (np.ones((HEIGHT, WIDTH), np.uint8), "no value above 1: 255 is white"),
        (np.empty((0, 0), np.uint8), "is no mask"),
    ],
)
def test_what_is_no_mask_is_named_and_not_used(values: np.ndarray, said: str) -> None:
    sender = Sender()
    find_tissue, rectifier = topic_mask(sender)
    sender.sent = {0: values}
    frame = make_frame(textured_tissue())
    assert find_tissue(frame, rectifier(frame)).all()
    assert said in find_tissue.problem


def test_a_topic_upside_down_is_refused_with_a_hint() -> None:
    """One bad mask that is carried along for several frames is one, not several."""
    sender = Sender()
    find_tissue, rectifier = topic_mask(sender)
    values, _ = shaft_mask()
    for number in range(FIRST_FRAMES - 1):
        sender.sent = {2 * number * FRAME_NS: 255 - values}
        for again in range(2):
            frame = make_frame(textured_tissue(), number=2 * number + again)
            find_tissue(frame, rectifier(frame))
    sender.sent = {2 * FIRST_FRAMES * FRAME_NS: 255 - values}
    frame = make_frame(textured_tissue(), number=2 * FIRST_FRAMES)
    with pytest.raises(
        UsageError, match=r"topic's masks.*set vision\.tissue\.tissue_is to black, it is white"
    ):
        find_tissue(frame, rectifier(frame))


def test_a_topic_needs_an_address_a_polarity_and_a_node() -> None:
    for said in (["vision.tissue.endpoint:=tcp://127.0.0.1:1"], ["vision.tissue.tissue_is:=white"]):
        with pytest.raises(UsageError, match="topic needs endpoint"):
            load_launch(None, ["vision.tissue.method:=topic", *said])
    with pytest.raises(UsageError, match="topic is for a running node"):
        TissueMask(TOPIC, rig_of_tests())
    with pytest.raises(
        UsageError, match=r"vision\.tissue\.endpoint: tcp://10\.0\.0\.1:5600 is not on this machine"
    ):
        MaskSubscriber("tcp://10.0.0.1:5600", "masks")
