"""A pixel means one thing: at whatever size a machine works, what it publishes and is asked for is of one."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sags_node.errors import SagsError
from sags_node.geometry import project
from sags_node.mapping.budget import StepBudget
from sags_node.messaging import content, published, thin, topics
from sags_node.messaging.cdr import Content
from sags_node.messaging.requests import ViewRequest
from sags_node.node.allowance import Allowance
from sags_node.node.operations import NodeState, Operations
from sags_node.node.views import Views
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.pipeline.session import open_session
from sags_node.types import FrameResult

FRAMES = 4
PINNED = (151.0, 118.0)
SCALES = ("0.75", "0.5", "0.37")  # of 320x256: 240x192, 160x128 and 118x95, whose sides shrink differently
PICTURES = [name for name in content.FRAME_CONTENT if topics.BY_NAME[name].type == topics.IMAGE]


@cache
def played(session: Path, *overrides: str) -> tuple[Pipeline, FrameResult]:
    """A pipeline after some frames, and the newest of them."""
    opened = open_session(session, ["source.pace:=step", f"source.frames:={FRAMES}", *overrides])
    pipeline = Pipeline(opened.config, opened.rig)
    with opened.source as source:
        for frame in source:
            result = pipeline.process(frame, StepBudget(2), FrameRequest(right=True))
    return pipeline, result


def array(body: Content) -> np.ndarray:
    return np.frombuffer(body.parts[1], body.dtype).reshape(body.shape)


def said(result: FrameResult) -> Mapping[str, np.ndarray]:
    return {name: array(content.FRAME_CONTENT[name](result)) for name in PICTURES}


def truth(session: Path) -> np.ndarray:
    """Depth [H, W] m of the newest frame, exact."""
    file = sorted((session / "depth").glob("*.png"))[FRAMES - 1]
    depth: np.ndarray = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) * np.float32(2.5e-6)
    return depth


@pytest.mark.parametrize("scale", SCALES)
def test_pictures_and_cameras_are_those_of_the_calibration_at_any_working_size(
    phantom_session: Path, scale: str
) -> None:
    _, full = played(phantom_session, "vision.scale:=1")
    _, small = played(phantom_session, f"vision.scale:={scale}")
    assert small.pair.left.shape != full.pair.left.shape
    whole, shown = said(full), said(small)
    assert {name: picture.shape for name, picture in shown.items()} == {
        name: picture.shape for name, picture in whole.items()
    }
    for eye in ("left", "right"):  # the camera's own images, to the bit
        assert np.array_equal(shown[f"{eye}/image_rect_color"], whole[f"{eye}/image_rect_color"])
        info = f"{eye}/camera_info"
        assert content.FRAME_CONTENT[info](small).cdr() == content.FRAME_CONTENT[info](full).cdr()
    # No depth and no confidence that was not worked out, and each at its own place.
    for name, plane in (
        ("left/render/depth", small.views["left"].depth),
        ("left/depth", small.observation.depth),
        ("left/render/depth_confidence", small.views["left"].confidence),
    ):
        known = shown[name][np.isfinite(shown[name])]
        assert len(known) and np.isin(known, plane).all()
    assert set(np.unique(shown["left/tissue_mask"])) <= {0, 255}
    exact, tissue = truth(phantom_session), whole["left/tissue_mask"] > 0
    error = np.abs(shown["left/render/depth"] - exact)[tissue]
    # As at full size, in pixels; one of them is so much more depth where they are larger.
    assert np.nanmedian(error) < 0.8e-3 / float(scale)
    same = (shown["left/tissue_mask"] > 0) == tissue
    assert same.mean() > 0.93  # what is taken from instruments' rims is as wide in working pixels
    drawn = shown["left/render/image"][..., :3][tissue].astype(np.float32)
    assert np.mean(np.square(drawn - whole["left/image_rect_color"][tissue])) < 255**2 * 10**-2.4  # 24 dB


@pytest.mark.parametrize("scale", ["1", *SCALES])
def test_a_pixel_that_is_asked_for_is_one_of_the_published_picture(phantom_session: Path, scale: str) -> None:
    pipeline, result = played(phantom_session, f"vision.scale:={scale}")
    state: Any = NodeState(None, pipeline, None, None, "")  # type: ignore[arg-type]
    operations = Operations(state, lambda *_: None)
    asked = operations.handlers()["add_anchor"]({"u": PINNED[0], "v": PINNED[1]})
    beyond = operations.handlers()["add_anchor"]({"u": 320, "v": 4})
    operations.for_mapping.serve()
    states = pipeline.anchors.states()
    row = int(np.flatnonzero(states.ids == asked.result()["id"])[0])
    camera = published.camera_of(result.pair)
    place, depth = project(camera, states.points[row].astype(np.float64))
    assert np.allclose(place, PINNED, atol=0.02)
    assert abs(depth - truth(phantom_session)[int(PINNED[1]), int(PINNED[0])]) < 1.5e-3
    assert np.allclose(published.anchors(result.pair, states).pixels[row], PINNED, atol=0.02)
    with pytest.raises(SagsError, match=r"pixel \(320, 4\) is outside the left image of 320x256 px"):
        beyond.result()


def test_the_launch_files_size_is_published_and_thin_pictures_and_views_are_parts_of_it(
    phantom_session: Path,
) -> None:
    _, result = played(phantom_session, "vision.width:=200", "vision.height:=160", "vision.scale:=0.5")
    assert {picture.shape[:2] for picture in said(result).values()} == {(160, 200)}
    names = [f"thin/half/100,80,60,40/{topic}/{form}" for topic, forms in topics.THIN_FORMS.items()
             for form in forms]  # fmt: skip
    made = thin.thin_pictures(result, {name: topics.thin_picture(name) for name in names})
    few = {name: thin.decode(name, body.scale, body.parts[1]) for name, body in made.items()}
    assert {picture.shape[:2] for picture in few.values()} == {(20, 30)}
    part = said(result)["left/render/depth"][80:120:2, 100:160:2]
    depth = few["thin/half/100,80,60,40/left/render/depth/png"]
    assert np.allclose(depth, part, atol=0.51 * thin.DEPTH_STEP, equal_nan=True)
    views = Views(Allowance())
    drawn = views.open(ViewRequest("both", width=200, height=160, stereo=True, depth=True), result)
    assert drawn is not None
    right = content.view("both", drawn)["view/both/right/image"]
    assert np.array_equal(array(right), said(result)["right/render/image"])
