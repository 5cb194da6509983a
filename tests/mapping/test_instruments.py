"""Instruments found without masks: by their colour, and by what they hide of the model."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from tissue_pictures import FRAME_NS, GOLD, HEIGHT, JAW, SHAFT, WIDTH, iou, textured_tissue

from sags_node.config.schema import LaunchConfig
from sags_node.mapping.budget import StepBudget
from sags_node.phantom.scene import Phantom, PhantomScene
from sags_node.pipeline.pipeline import Pipeline
from sags_node.types import U8, Bool, Camera, Colours, RenderedView, StereoFrame
from sags_node.vision.tissue_classical import LONGEST_DOUBT, InstrumentFinder


def noisy(picture: U8, seed: int) -> U8:
    noise = np.random.default_rng(seed).normal(0, 5, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def drawn(picture: U8) -> RenderedView:
    """A model that looks like this image."""
    camera = Camera(WIDTH, HEIGHT, np.eye(3), np.eye(4))
    plane = np.ones((HEIGHT, WIDTH), np.float32)
    return RenderedView(0, 0, camera, Colours(picture), plane, plane)


def with_shaft(tissue: U8, wrist: tuple[int, int, int] | None = None) -> U8:
    picture = tissue.copy()
    picture[SHAFT] = (150, 150, 152)
    if wrist is not None:
        picture[GOLD] = wrist
    return picture


def test_grey_and_gold_that_come_in_from_the_edge_are_instruments() -> None:
    found = InstrumentFinder()(with_shaft(textured_tissue(), (170, 140, 50)))
    truth = np.zeros((HEIGHT, WIDTH), np.bool_)
    truth[SHAFT] = truth[GOLD] = True
    assert iou(found, truth) > 0.9


def test_a_jaw_that_mirrors_tissue_is_found_by_what_it_hides() -> None:
    tissue = textured_tissue()
    picture = with_shaft(tissue, (150, 150, 152))
    jaw = np.zeros((HEIGHT, WIDTH), np.bool_)
    jaw[JAW[0] : JAW[1], JAW[2] : JAW[3]] = True
    picture[jaw] = (150, 100, 97)
    assert InstrumentFinder()(picture)[jaw].mean() < 0.2
    found = InstrumentFinder()(picture, drawn(tissue))
    assert found[jaw].mean() > 0.85  # its corners are rounded
    assert found[:, :140].mean() == 0


def test_highlights_stay_tissue_also_beside_an_instrument() -> None:
    tissue = textured_tissue()
    picture = with_shaft(tissue)
    picture[125:135, 260:300] = 255  # on the instrument
    lights = np.zeros((HEIGHT, WIDTH), np.bool_)
    lights[40:52, 60:72] = True
    lights[150:180, 250:258] = True  # touches the shaft
    lights[0:10, 30:45] = True  # at the image's edge
    picture[lights] = 255
    for expected in (None, drawn(tissue)):
        found = InstrumentFinder()(picture, expected)
        assert found[lights].mean() < 0.1
        assert found[SHAFT].mean() > 0.9


def test_a_shaft_so_bright_that_it_is_white_is_an_instrument() -> None:
    """It blooms into the tissue beside it. Nothing of a surface shows there; small highlights are another
    matter."""
    tissue = textured_tissue()
    light = np.zeros((HEIGHT, WIDTH), np.float32)
    cv2.line(light, (250, -10), (210, 110), 1.0, 34)
    cv2.circle(light, (60, 150), 7, 1.0, -1)
    shaft = light > 0
    shaft[120:] = False
    bloom = cv2.GaussianBlur(light, (0, 0), 5) + light
    picture = np.clip(tissue + 300 * bloom[..., None], 0, 255).astype(np.uint8)
    for expected in (None, drawn(tissue)):
        found = InstrumentFinder()(picture, expected)
        assert found[shaft].mean() > 0.85
        assert not found[130:].any()


def test_a_dark_cavity_is_tissue_and_a_black_shaft_is_not() -> None:
    """A cavity sends back a sixth of the light, and what it sends is red."""
    picture = textured_tissue()
    cavity, shaft = np.s_[140:, 40:130], np.s_[:90, 200:240]
    picture[cavity] = (picture[cavity] * (0.16, 0.10, 0.09)).astype(np.uint8)
    picture[shaft] = (10, 10, 11)
    found = InstrumentFinder()(picture)
    assert not found[cavity].any()
    assert found[shaft].mean() > 0.85  # its rim is averaged with the tissue beside it


def test_a_pale_patch_inside_and_a_dark_picture() -> None:
    picture = textured_tissue()
    picture[60:120, 100:180] = (190, 170, 160)  # gauze
    assert not InstrumentFinder()(picture).any()
    assert InstrumentFinder()(np.full((60, 80, 3), 3, np.uint8)).all()


def test_tissue_that_the_model_does_not_know_is_let_go_in_time() -> None:
    """Pale tissue moves in from the edge over a redder model that would never be fixed."""
    tissue = textured_tissue()
    picture = with_shaft(tissue)
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
    before, find = with_shaft(tissue), InstrumentFinder()
    assert find(before, drawn(before), 0)[SHAFT].mean() > 0.9
    assert find(tissue, drawn(before), FRAME_NS)[SHAFT].mean() == 0


def test_noise_makes_a_remembered_mask_flicker_less() -> None:
    """A part in doubt: half of its evidence is noise."""
    picture = with_shaft(textured_tissue(), (150, 138, 130))
    picture[GOLD][::2] = (150, 128, 120)
    flickering = []
    for remembers in (True, False):
        find, masks = InstrumentFinder(), []
        for number in range(24):
            each = find if remembers else InstrumentFinder()
            masks.append(each(noisy(picture, number), drawn(picture), number * FRAME_NS))
        flickering.append(np.mean([(a != b)[:, 150:].mean() for a, b in pairwise(masks)]))
    remembered, alone = flickering
    assert alone > 0.0005
    assert remembered < 0.7 * alone


class Masks:
    """Masks of instruments against the truth, pixel by pixel, over many frames."""

    def __init__(self) -> None:
        self.both = self.either = self.lost = self.missed = self.tools = self.others = 0

    def add(self, found: Bool, truth: Bool, usable: Bool) -> None:
        self.both += np.count_nonzero(found & truth & usable)
        self.either += np.count_nonzero((found | truth) & usable)
        self.lost += np.count_nonzero(found & ~truth & usable)
        self.missed += np.count_nonzero(truth & ~found)
        self.tools += np.count_nonzero(truth)
        self.others += np.count_nonzero(usable & ~truth)


def test_instruments_of_the_phantom_while_it_is_mapped() -> None:
    """The masks shape the model, and the model the masks."""
    source = PhantomScene(width=WIDTH, height=HEIGHT, seconds=4.0, noise=0.02)
    phantom = Phantom(source)
    vision, mapping = {"tissue": {"method": "classical", "dilate": 0}}, {"max_gaussians": 8000}
    config = LaunchConfig.model_validate({"source": source, "vision": vision, "mapping": mapping})
    pipeline, budget, masks = Pipeline(config, phantom.rig), StepBudget(1), Masks()
    for number in range(30, 54):
        frame, stamp = phantom.frame(number, 120), number * FRAME_NS
        stereo = StereoFrame(number, stamp, stamp, frame.left, frame.right, 0, frame.T_world_cam)
        found = ~pipeline.process(stereo, budget).observation.tissue
        truth, usable = map(pipeline.rectifier.mask, (frame.tool, np.ones_like(frame.tool)))
        masks.add(found, truth, usable)
    assert masks.both / masks.either > 0.8
    assert masks.lost / masks.others < 0.01
    assert masks.missed / masks.tools < 0.2


def test_instruments_of_a_real_session_by_colour_alone(data_folder: Path) -> None:
    """D4D, every 20th frame: a steel grasper, a gold wrist, a grey spleen at the edge, a large highlight."""
    folder = data_folder / "d4d_pull"
    if not folder.is_dir():
        pytest.skip(f"recording d4d_pull is not under SAGS_DATA ({data_folder})")
    video, masks, index = cv2.VideoCapture(str(folder / "2025_03_06-16_49_40_combined_2x2.mp4")), Masks(), 0
    while video.grab():
        if index % 20 == 0:
            left = cv2.cvtColor(video.retrieve()[1], cv2.COLOR_BGR2RGB)[:540, :675]
            tool = cv2.imread(str(folder / f"toolmask/{index:04d}.png"), cv2.IMREAD_GRAYSCALE) > 127
            masks.add(InstrumentFinder()(left), tool, np.ones_like(tool))
        index += 1
    video.release()
    assert masks.both / masks.either > 0.7
    assert masks.lost / masks.others < 0.01
