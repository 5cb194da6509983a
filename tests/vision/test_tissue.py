"""Tissue masks from outside: the session's, a network's, another process's, and when they are wrong."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

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
from sags_node.types import Bool, StereoFrame, StereoRig
from sags_node.vision.rectify import Rectifier
from sags_node.vision.tissue import FIRST_FRAMES, TissueMask


class Sender:
    """Stands for the socket: masks by stamp."""

    def __init__(self) -> None:
        self.sent: dict[int, np.ndarray] = {}

    def __call__(self, stamp_ns: int) -> tuple[int, np.ndarray] | None:
        nearest = min(self.sent, key=lambda sent: abs(sent - stamp_ns), default=None)
        return None if nearest is None else (nearest, self.sent[nearest])


K = np.array([[300.0, 0, WIDTH / 2], [0, 300.0, HEIGHT / 2], [0, 0, 1]])
RIG = rectified_rig("test", WIDTH, HEIGHT, K, 0.004)


class Masks:
    """A `TissueMask`, asked as the pipeline asks it."""

    def __init__(self, sender: Sender | None = None, rig: StereoRig = RIG, **config: Any) -> None:
        self._rectifier = Rectifier(rig, rig.left.width, rig.left.height)
        self._masks = TissueMask(TissueConfig.model_validate(config), self._rectifier, sender)

    def __call__(self, frame: StereoFrame) -> Bool:
        return self._masks(frame, self._rectifier(frame))

    @property
    def problem(self) -> str:
        return self._masks.problem


# ---- the session's masks ---------------------------------------------------------------------------------

SIZE = 540, 675
EVERYWHERE = np.ones(SIZE, np.bool_)
D4D = load_rig(ROOT / "calib/d4d")


def flat_frame(tissue: Bool | None) -> StereoFrame:
    return make_frame(np.full((*SIZE, 3), (180, 90, 90), np.uint8), tissue)


def test_session_masks_are_dilated_and_boxes_left_out() -> None:
    tissue = EVERYWHERE.copy()
    tissue[200:300, 400:] = False
    mask = Masks(rig=D4D, dilate=3, exclude=((10, 20, 30, 40),))(flat_frame(tissue))
    expected = EVERYWHERE.copy()
    expected[197:303, 397:] = False
    expected[20:60, 10:40] = False
    assert (mask != expected).sum() < 30  # the ellipse rounds the corners
    assert not mask[~tissue].any()


def test_no_method_uses_every_pixel_but_the_boxes() -> None:
    mask = Masks(rig=D4D, method="none", exclude=((0, 0, 5, 5),))(flat_frame(~EVERYWHERE))
    assert (~mask).sum() == 25


@pytest.mark.parametrize("box", [(670, 0, 6, 5), (0, 0, 0, 5), (0, 539, 5, 2)])
def test_a_box_outside_the_picture_is_refused(box: tuple[int, int, int, int]) -> None:
    with pytest.raises(UsageError, match="675x540"):
        Masks(rig=D4D, exclude=(box,))


def test_masks_upside_down_are_refused_with_a_hint() -> None:
    tissue = ~EVERYWHERE
    tissue[200:300, 400:] = True
    masks = Masks(rig=D4D)
    for _ in range(FIRST_FRAMES - 1):
        masks(flat_frame(tissue))
    with pytest.raises(UsageError, match=r"over half.*upside down.*source\.instruments.*method:=classical"):
        masks(flat_frame(tissue))


def test_an_instrument_may_come_close_for_a_while() -> None:
    """One ordinary mask among the first is enough, and later ones are not judged."""
    masks = Masks(rig=D4D)
    for ordinary in [False] * (FIRST_FRAMES - 1) + [True] + [False] * FIRST_FRAMES:
        assert masks(flat_frame(EVERYWHERE if ordinary else ~EVERYWHERE)).any() == ordinary


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
    label = g("Cast", g("Greater", logit, floats(0)), to=FLOAT)
    made = {
        "logit": lambda: logit,
        "probability": lambda: g("Sigmoid", logit),
        "scores": lambda: g("Concat", g("Neg", logit), nothing, logit, axis=1),
        "labels": lambda: label,
        "numbers": lambda: g("Add", g("Mul", label, floats(2)), floats(1)),
        "half": lambda: g("AveragePool", logit, kernel_shape=[2, 2], strides=[2, 2]),
    }[answer]()
    g.named("mask", made)
    return g.save(path, {"picture": (FLOAT, [1, 3, "h", "w"])}, ["mask"])


TRUTH = np.ones((HEIGHT, WIDTH), np.bool_)  # where `INSIDE` shows tissue
TRUTH[SHAFT] = False
INSIDE = make_frame(np.where(TRUTH[..., None], textured_tissue(), np.array((150, 150, 152), np.uint8)))


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
    path = save_segmenter(tmp_path / "net.onnx", answer)
    masks = Masks(method="onnx", path=path, tissue_is=tissue_is, dilate=0)
    assert iou(~masks(INSIDE), ~TRUTH) > 0.97
    assert masks.problem == ""


def test_a_network_read_the_wrong_way_round_is_refused(tmp_path: Path) -> None:
    path = save_segmenter(tmp_path / "net.onnx", "logit")
    masks = Masks(method="onnx", path=path, tissue_is="black")
    with pytest.raises(UsageError, match=r"set vision\.tissue\.tissue_is to white, it is black"):
        for _ in range(FIRST_FRAMES):
            masks(INSIDE)


def test_where_the_network_fails_instruments_are_found_without(tmp_path: Path) -> None:
    path = save_segmenter(tmp_path / "net.onnx", "logit", fault=True)
    masks = Masks(method="onnx", path=path, tissue_is="white", dilate=0)
    dim = make_frame((INSIDE.left * 0.3).astype(np.uint8))
    assert iou(~masks(dim), ~TRUTH) > 0.9
    assert "not finite" in masks.problem
    masks(INSIDE)
    assert masks.problem == ""


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
        Masks(method="onnx", path=path, tissue_is="white")


# ---- another process's -----------------------------------------------------------------------------------

TOPIC = {"method": "topic", "endpoint": "ipc:///run/masks.ipc", "tissue_is": "white", "dilate": 0}
SENT = TRUTH.view(np.uint8) * np.uint8(255)  # white = tissue


@pytest.fixture
def sender() -> Sender:
    return Sender()


def shown(number: int = 0) -> StereoFrame:
    """Without an instrument: masks are known by theirs."""
    return make_frame(textured_tissue(), number=number)


@pytest.mark.parametrize("tissue_is", ["white", "black"])
def test_the_mask_of_the_nearest_picture_is_taken(tissue_is: str, sender: Sender) -> None:
    masks = Masks(sender, **TOPIC | {"tissue_is": tissue_is})
    sent = SENT if tissue_is == "white" else 255 - SENT
    sender.sent = {0: np.roll(sent, 30, 0), FRAME_NS: sent, 3 * FRAME_NS: np.roll(sent, 60, 0)}
    assert np.array_equal(masks(shown(1)), TRUTH) and masks.problem == ""


def test_a_late_mask_is_carried_along_until_its_tolerance_is_over(sender: Sender) -> None:
    """Then instruments are found without it, with a word about why, until masks come again."""
    masks = Masks(sender, **TOPIC, tolerance=0.1)
    assert masks(shown(0)).all()  # as the classical default: no instrument
    assert "no mask has come on masks/left/tissue_mask from ipc:///run/masks.ipc" in masks.problem
    sender.sent = {0: SENT}
    for number in range(4):  # 100 ms
        assert np.array_equal(masks(shown(number)), TRUTH) and masks.problem == ""
    assert masks(shown(4)).all()
    assert "0.133 s older than the image; vision.tissue.tolerance is 0.1 s" in masks.problem
    sender.sent[5 * FRAME_NS] = SENT
    assert np.array_equal(masks(shown(5)), TRUTH) and masks.problem == ""
    sender.sent = {20 * FRAME_NS: SENT}
    assert masks(shown(5)).all()
    assert "newer than the image" in masks.problem


@pytest.mark.parametrize("size", [(160, 128), (640, 512), (96, 77)])
def test_masks_of_another_size_are_resized(size: tuple[int, int], sender: Sender) -> None:
    masks = Masks(sender, **TOPIC)
    sender.sent = {0: cv2.resize(SENT, size, interpolation=cv2.INTER_NEAREST)}
    assert iou(~masks(shown()), ~TRUTH) > 0.85 and masks.problem == ""


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
def test_what_is_no_mask_is_named_and_not_used(values: np.ndarray, said: str, sender: Sender) -> None:
    masks = Masks(sender, **TOPIC)
    sender.sent = {0: values}
    assert masks(shown()).all()
    assert said in masks.problem


def test_a_topic_upside_down_is_refused_with_a_hint(sender: Sender) -> None:
    """One bad mask that is carried along for several frames is one, not several."""
    masks = Masks(sender, **TOPIC)
    for number in range(2 * FIRST_FRAMES - 2):
        sender.sent = {(number - number % 2) * FRAME_NS: 255 - SENT}
        masks(shown(number))
    sender.sent = {2 * FIRST_FRAMES * FRAME_NS: 255 - SENT}
    with pytest.raises(UsageError, match=r"topic's masks.*vision\.tissue\.tissue_is to black, it is white"):
        masks(shown(2 * FIRST_FRAMES))


@pytest.mark.fault("masks: a live node begins outside the patient, or reads them the wrong way round")
@pytest.mark.parametrize("method", ["topic", "onnx"])
def test_masks_of_a_live_node_are_not_taken_before_an_ordinary_one(
    method: str, tmp_path: Path, sender: Sender
) -> None:
    path = save_segmenter(tmp_path / "net.onnx", "logit") if method == "onnx" else None
    masks = Masks(sender, **TOPIC | {"method": method, "path": path})
    outside = make_frame(np.full_like(INSIDE.left, 90))  # all grey: no tissue
    for number in range(2 * FIRST_FRAMES):
        stamp = (number + 1) * FRAME_NS
        is_inside = number in (FIRST_FRAMES + 1, FIRST_FRAMES + 3)
        sender.sent = {stamp: SENT if is_inside else np.zeros_like(SENT)}
        mask = masks(replace(INSIDE if is_inside else outside, t_capture_ns=stamp, t_arrival_ns=stamp + 1))
        if number <= FIRST_FRAMES:
            assert "scope is outside" in masks.problem and "tissue_is to black" in masks.problem
        else:
            assert masks.problem == ""
            assert iou(mask, TRUTH) > 0.97 if is_inside else not mask.any()


def test_a_topic_needs_an_address_a_polarity_and_a_node() -> None:
    for said in (["vision.tissue.endpoint:=tcp://127.0.0.1:1"], ["vision.tissue.tissue_is:=white"]):
        with pytest.raises(UsageError, match="topic needs endpoint"):
            load_launch(None, ["vision.tissue.method:=topic", *said])
    with pytest.raises(UsageError, match="topic is for a running node"):
        Masks(**TOPIC)
    with pytest.raises(UsageError, match=r"tissue\.endpoint: tcp://10\.0\.0\.1:5600 is not on this machine"):
        MaskSubscriber("tcp://10.0.0.1:5600", "masks")
