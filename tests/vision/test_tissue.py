"""Tissue masks from outside: the session's, a network's, another process's, and when they are wrong."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from onnx_networks import FLOAT, Graph, floats
from places import ROOT
from tissue_pictures import FRAME_NS, HEIGHT, SHAFT, WIDTH, iou, make_frame, textured_tissue

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import TissueConfig
from sags_node.errors import UsageError
from sags_node.messaging.masks import MaskSubscriber
from sags_node.rig import load_rig, rectified_rig
from sags_node.types import Bool, RectifiedPair, StereoFrame
from sags_node.vision.rectify import Rectifier
from sags_node.vision.tissue import FIRST_FRAMES, TissueMask

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


@pytest.mark.parametrize("box", [(670, 0, 6, 5), (0, 0, 0, 5), (0, 539, 5, 2)])
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


# ---- a network's -----------------------------------------------------------------------------------------


def save_segmenter(path: Path, answer: str, fault: bool = False) -> Path:
    """Redness R - G of an image fed as for ImageNet: tissue where it is above 40 grey levels.

    Args:
        answer: logit, probability, scores (of grey, nothing, tissue), labels, or half (the logit, coarser);
            numbers: of classes, 1 an instrument and 3 tissue, as floats.
        fault: not finite where the image is nearly black.
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
        "numbers": lambda: g(
            "Add", g("Mul", g("Cast", g("Greater", logit, floats(0)), to=FLOAT), floats(2)), floats(1)
        ),
        "half": lambda: g("AveragePool", logit, kernel_shape=[2, 2], strides=[2, 2]),
    }[answer]()
    g.named("mask", made)
    return g.save(path, {"picture": (FLOAT, [1, 3, "h", "w"])}, ["mask"])


def rig_of_tests() -> Rectifier:
    K = np.array([[300.0, 0, WIDTH / 2], [0, 300.0, HEIGHT / 2], [0, 0, 1]])
    return Rectifier(rectified_rig("test", WIDTH, HEIGHT, K, 0.004), WIDTH, HEIGHT)


TRUTH = np.ones((HEIGHT, WIDTH), np.bool_)  # where `instrument_frame` shows tissue
TRUTH[SHAFT] = False


def instrument_frame() -> StereoFrame:
    picture = textured_tissue()
    picture[SHAFT] = (150, 150, 152)
    return make_frame(picture)


@pytest.mark.parametrize(
    ("answer", "tissue_is"),
    [
        *((answer, "white") for answer in ("logit", "probability", "labels", "half", "scores")),
        ("scores", (2,)),
        ("scores", (1, 2)),
        ("numbers", (0, 3)),
    ],
)
def test_a_networks_mask(tmp_path: Path, answer: str, tissue_is: str | tuple[int, ...]) -> None:
    rectifier = rig_of_tests()
    path = save_segmenter(tmp_path / "net.onnx", answer)
    config = TissueConfig(method="onnx", path=path, tissue_is=tissue_is, dilate=0)
    frame = instrument_frame()
    find_tissue = TissueMask(config, rectifier)
    mask = find_tissue(frame, rectifier(frame))
    assert iou(~mask, ~TRUTH) > 0.97
    assert find_tissue.problem == ""


def test_a_network_read_the_wrong_way_round_is_refused(tmp_path: Path) -> None:
    rectifier = rig_of_tests()
    path = save_segmenter(tmp_path / "net.onnx", "logit")
    find_tissue = TissueMask(TissueConfig(method="onnx", path=path, tissue_is="black"), rectifier)
    frame = instrument_frame()
    with pytest.raises(UsageError, match=r"set vision\.tissue\.tissue_is to white, it is black"):
        for _ in range(FIRST_FRAMES):
            find_tissue(frame, rectifier(frame))


def test_where_the_network_fails_instruments_are_found_without(tmp_path: Path) -> None:
    rectifier = rig_of_tests()
    path = save_segmenter(tmp_path / "net.onnx", "logit", fault=True)
    find_tissue = TissueMask(TissueConfig(method="onnx", path=path, tissue_is="white", dilate=0), rectifier)
    frame = instrument_frame()
    dim = make_frame((frame.left * 0.3).astype(np.uint8))
    assert iou(~find_tissue(dim, rectifier(dim)), ~TRUTH) > 0.9
    assert "not finite" in find_tissue.problem
    find_tissue(frame, rectifier(frame))
    assert find_tissue.problem == ""


def save_a_number(path: Path) -> None:
    g = Graph()
    g.named("out", g("ReduceMean", "picture", axes=[2, 3]))
    g.save(path, {"picture": (FLOAT, [1, 3, "h", "w"])}, ["out"])


@pytest.mark.parametrize(
    ("save", "said"),
    [
        (lambda path: None, r"net\.onnx is no file"),
        (lambda path: path.write_bytes(b"this is no network"), r"net\.onnx is no ONNX model"),
        (save_a_number, "no output is a mask of the 320x256 px"),
    ],
)
def test_what_is_no_network_of_masks_is_named_by_its_own_setting(
    save: Callable[[Path], object], said: str, tmp_path: Path
) -> None:
    """A mask's network is not looked for under vision.onnx, where the depth's is set."""
    path = tmp_path / "net.onnx"
    save(path)
    with pytest.raises(UsageError, match=rf"^vision\.tissue\.path: .*{said}"):
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


SENT = TRUTH.view(np.uint8) * np.uint8(255)  # white = tissue


@pytest.mark.parametrize("tissue_is", ["white", "black"])
def test_the_mask_of_the_nearest_picture_is_taken(tissue_is: str) -> None:
    sender = Sender()
    find_tissue, rectifier = topic_mask(sender, tissue_is=tissue_is)
    sent = SENT if tissue_is == "white" else 255 - SENT
    sender.sent = {0: np.roll(sent, 30, 0), FRAME_NS: sent, 3 * FRAME_NS: np.roll(sent, 60, 0)}
    frame = make_frame(textured_tissue(), number=1)
    assert np.array_equal(find_tissue(frame, rectifier(frame)), TRUTH)
    assert find_tissue.problem == ""


def test_a_late_mask_is_carried_along_until_its_tolerance_is_over() -> None:
    """Then instruments are found without it, with a word about why, until masks come again."""
    sender = Sender()
    find_tissue, rectifier = topic_mask(sender, tolerance=0.1)
    picture = textured_tissue()
    frames = [make_frame(picture, number=number) for number in range(6)]
    assert find_tissue(frames[0], rectifier(frames[0])).all()  # as the classical default: no instrument
    assert "no mask has come on masks/left/tissue_mask from ipc:///run/masks.ipc" in find_tissue.problem
    sender.sent = {0: SENT}
    for frame in frames[:4]:  # 100 ms
        assert np.array_equal(find_tissue(frame, rectifier(frame)), TRUTH)
        assert find_tissue.problem == ""
    assert find_tissue(frames[4], rectifier(frames[4])).all()
    assert "0.133 s older than the image; vision.tissue.tolerance is 0.1 s" in find_tissue.problem
    sender.sent[5 * FRAME_NS] = SENT
    assert np.array_equal(find_tissue(frames[5], rectifier(frames[5])), TRUTH)
    assert find_tissue.problem == ""
    sender.sent = {20 * FRAME_NS: SENT}
    assert find_tissue(frames[5], rectifier(frames[5])).all()
    assert "newer than the image" in find_tissue.problem


def test_masks_of_another_size_are_resized() -> None:
    sender = Sender()
    find_tissue, rectifier = topic_mask(sender)
    frame = make_frame(textured_tissue())
    for size in ((160, 128), (640, 512), (96, 77)):
        sender.sent = {0: cv2.resize(SENT, size, interpolation=cv2.INTER_NEAREST)}
        mask = find_tissue(frame, rectifier(frame))
        assert find_tissue.problem == "" and iou(~mask, ~TRUTH) > 0.85


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.full((HEIGHT, WIDTH, 3), 255, np.uint8), "is no mask: mono8 is expected"),
        (np.ones((HEIGHT, WIDTH), np.float32), "is no mask"),
        (np.full((WIDTH, HEIGHT), 255, np.uint8), "has 256x320 px, the image 320x256"),
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
    for number in range(FIRST_FRAMES - 1):
        sender.sent = {2 * number * FRAME_NS: 255 - SENT}
        for again in range(2):
            frame = make_frame(textured_tissue(), number=2 * number + again)
            find_tissue(frame, rectifier(frame))
    sender.sent = {2 * FIRST_FRAMES * FRAME_NS: 255 - SENT}
    frame = make_frame(textured_tissue(), number=2 * FIRST_FRAMES)
    with pytest.raises(
        UsageError, match=r"topic's masks.*set vision\.tissue\.tissue_is to black, it is white"
    ):
        find_tissue(frame, rectifier(frame))


@pytest.mark.fault("masks: a live node begins outside the patient, or reads them the wrong way round")
@pytest.mark.parametrize("method", ["topic", "onnx"])
def test_masks_of_a_live_node_are_not_taken_before_an_ordinary_one(method: str, tmp_path: Path) -> None:
    sender = Sender()
    path = save_segmenter(tmp_path / "net.onnx", "logit") if method == "onnx" else None
    find_tissue, rectifier = topic_mask(sender, method=method, path=path)
    inside = instrument_frame()
    outside = make_frame(np.full_like(inside.left, 90))  # all grey: no tissue
    for number in range(2 * FIRST_FRAMES):
        stamp = (number + 1) * FRAME_NS
        is_inside = number in (FIRST_FRAMES + 1, FIRST_FRAMES + 3)
        sender.sent = {stamp: SENT if is_inside else np.zeros_like(SENT)}
        shown = inside if is_inside else outside
        frame = replace(shown, t_capture_ns=stamp, t_arrival_ns=stamp + 1)
        mask = find_tissue(frame, rectifier(frame))
        if number <= FIRST_FRAMES:
            assert "scope is outside" in find_tissue.problem and "tissue_is to black" in find_tissue.problem
        else:
            assert find_tissue.problem == ""
            assert iou(mask, TRUTH) > 0.97 if is_inside else not mask.any()


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
