"""Live images from the real GStreamer: pairs, lag, death and return, mistakes; split to the pixel."""

import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from ctypes.util import find_library
from itertools import islice, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from gstreamer import BALL, apart, ball_moment, kill_pipelines, need_gstreamer, pipelines, raw_file
from numbered_pictures import write_video
from places import HELPERS, ROOT
from ports import free_port
from pydantic import ValidationError
from sending import sending
from waiting import beside, until

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import GeometryConfig, GstSource
from sags_node.errors import SagsError, UsageError
from sags_node.sources import gst_child
from sags_node.sources.gst import Sink, open_pipeline
from sags_node.sources.gst_process import GstProcess, in_words
from sags_node.types import StereoFrame
from sags_node.wall_clock import WallClock

pytestmark = pytest.mark.live

CAMERA = (
    "videotestsrc is-live=true pattern=ball "
    "! video/x-raw,format=RGB,width={width},height={height},framerate=30/1"
)
SMALL = CAMERA.format(width=320, height=240)
# The right eye sees the mirrored image: a pair that is none would not fit.
TWO_EYES = "{camera} ! tee name=t  t. ! left.  t. ! queue ! {more} videoflip video-direction=horiz ! right."


@pytest.fixture(scope="module", autouse=True)
def _gstreamer() -> None:
    need_gstreamer()


@pytest.fixture(autouse=True)
def _no_pipeline_is_left() -> Iterator[None]:
    yield
    until(lambda: not pipelines())


def two_eyes(camera: str = SMALL, more: str = "", **said: Any) -> GstSource:
    return GstSource(launch=TWO_EYES.format(camera=camera, more=more), **said)


def take(config: GstSource, count: int, **said: Any) -> tuple[list[StereoFrame], list[int]]:
    """Frames, and when each came."""
    frames, came = [], []
    with open_pipeline(config, **said) as source:
        timer = threading.Timer(60.0, source.stop)
        timer.daemon = True
        timer.start()
        for frame in islice(source, count):
            frames.append(frame)
            came.append(time.time_ns())
        timer.cancel()
    return frames, came


# ---- live ------------------------------------------------------------------------------------------------


def test_no_pair_is_mismatched_also_where_pictures_are_lost() -> None:
    """2 x 1280x1024 at 30 Hz; a quarter of the right images is lost."""
    camera = CAMERA.format(width=1280, height=1024)
    lossy = "identity drop-probability=0.25 !"
    config = two_eyes(camera, more=f"{lossy} queue !")
    frames, came = take(config, 45, size=(1280, 1024))
    for frame in frames:
        assert frame.right is not None and (frame.left == frame.right[:, ::-1]).all()
        assert frame.t_capture_ns == frame.t_capture_right_ns
    assert any((a.left != b.left).any() for a, b in pairwise(frames))  # the ball moves
    steps = np.diff([frame.t_capture_ns for frame in frames]) * 30e-9  # camera periods
    assert (steps > 0.9).all() and np.abs(steps - np.round(steps)).max() < 0.1  # the camera's clock, not ours
    assert frames[-1].frame_id - frames[0].frame_id >= 44  # gaps where a left image found no partner
    ages = np.array(came) - [frame.t_capture_ns for frame in frames]
    assert (ages > -1e6).all()  # a stamp is exact to a millisecond


CHANGED = "concat name=c ! tee name=t  t. ! left.  t. ! right.  "
CHANGED += f"{SMALL.replace('is-live=true', 'num-buffers=45')} ! c.  {SMALL.replace('320', '160')} ! c."


@pytest.mark.fault("camera: one eye falls silent")
@pytest.mark.fault("camera: its stream ends")
@pytest.mark.fault("image: the size changes while it runs")
@pytest.mark.parametrize(
    ("config", "said"),
    [
        # `eos-after` ends one eye's branch; the other goes on.
        (GstSource(left=SMALL, right=f"{SMALL} ! identity eos-after=10", deadline=0.5, pair_tolerance_ms=17),
         "no new image of right for 0.5 s"),
        (two_eyes(SMALL.replace("videotestsrc", "videotestsrc num-buffers=15")), "the stream has ended"),
        # A camera that is set anew: what comes then would not fit the calibration.
        (GstSource(launch=CHANGED), r"the images of (left|right) changed from 320x240 RGB to 160x240 RGB"),
    ],
    ids=["silent", "ended", "another size"],
)  # fmt: skip
def test_a_pipeline_that_fails_is_started_again_and_it_is_told(
    config: GstSource, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    frames: list[StereoFrame] = []
    with open_pipeline(config) as source, beside(lambda: frames.extend(source), source.stop):
        until(lambda: re.search(said, caplog.text))
        until(lambda: "GStreamer is open again" in caplog.text)
        come = len(frames)
        until(lambda: len(frames) > come)


def test_network_cameras_over_rtsp() -> None:
    """The strings of launch/gst_rtsp.yaml and a real server, which is killed in between."""
    need_gstreamer("rtspsrc", "h264parse", "avdec_h264")
    if find_library("gstrtspserver-1.0") is None:
        pytest.skip("there is no RTSP server; install libgstrtspserver-1.0-0")
    port, camera = free_port(), f"{BALL} ! video/x-raw,width=320,height=240,framerate=30/1"
    server = [sys.executable, HELPERS / "rtsp_server.py", port, camera]
    file = load_launch(ROOT / "launch/gst_rtsp.yaml").source
    assert isinstance(file, GstSource) and file.left is not None and file.right is not None
    texts = {"left": file.left, "right": file.right}
    streams = {eye: text.replace("camera/", f"127.0.0.1:{port}/") for eye, text in texts.items()}
    frames: list[StereoFrame] = []
    with ExitStack() as cameras:
        first = cameras.enter_context(sending(server))
        source = cameras.enter_context(open_pipeline(file.model_copy(update=streams)))
        cameras.enter_context(beside(lambda: frames.extend(source), source.stop))
        until(lambda: len(frames) > 30)
        first.kill()
        first.wait(5)
        cameras.enter_context(sending(server))
        killed = time.time_ns()
        until(lambda: frames[-1].t_capture_ns > killed + 100_000_000)
    assert all(a.t_capture_ns < b.t_capture_ns for a, b in pairwise(frames))
    eyes, stamps = [], []
    for frame in frames[10:]:  # the first ones come in a burst
        assert frame.right is not None and frame.left.shape == (240, 320, 3)
        left, right = ball_moment(frame.left), ball_moment(frame.right)
        eyes.append(apart(left, right))
        stamps.append(apart(frame.t_capture_ns * 1e-9, left))
    # A stamp is when an image came: of single ones a busy machine makes anything.
    assert np.median(eyes) < 0.1  # nobody synchronises the two cameras: up to a frame, and the way
    assert np.median(stamps) < 0.25


# ---- mistakes --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("left", "words"),
    [
        ("unheardsrc", 'no element "unheardsrc"; install the plugin that has it'),
        ("v4l2src device=/dev/none", "v4l2src0: Cannot identify device '/dev/none'"),
        ("filesrc location=/none ! decodebin", 'filesrc0: Resource not found .No such file "/none"'),
        ("videotestsrc bogus=1", 'no property "bogus" in element "videotestsrc"; try the string with'),
        ("videotestsrc ! ! x", "syntax error; try the string with gst-launch-1.0"),
        ("videotestsrc ! audioconvert", "could not link videotestsrc0 to audioconvert0; neighbours"),
        ("fakesrc is-live=true", "fakesrc0: Internal data stream error .*not-negotiated.*; neighbours"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_a_line(left: str, words: str) -> None:
    with pytest.raises(SagsError, match=words) as raised:
        open_pipeline(GstSource(left=left, right=SMALL))
    assert "\n" not in str(raised.value)


def test_wrong_sizes_are_refused() -> None:
    with pytest.raises(UsageError, match="are 320x240 px but should be 640x480, as the calibration"):
        open_pipeline(two_eyes(), size=(640, 480))
    other = SMALL.replace("width=320", "width=160")
    with pytest.raises(SagsError, match="left eye's images are 320x240 px but the right eye's 160x240"):
        open_pipeline(GstSource(left=SMALL, right=other))


def test_pictures_without_stamps_are_refused() -> None:
    unstamped: Any = SimpleNamespace(
        bin_get_by_name=lambda pipeline, name: 1,
        app_sink_try_pull_preroll=lambda element, wait_ns: 1,
        picture=lambda sample: gst_child.Picture(gst_child.NONE, 9216),
    )
    sink = gst_child.Sink(unstamped, 1, WallClock(), "left", 0, None)
    with pytest.raises(gst_child.GstError, match="images of left carry no time stamp") as raised:
        sink.show_first()
    assert "add do-timestamp=true" in in_words(str(raised.value), raised.value.debug)


@pytest.mark.fault("stamp: equal, or back")
def test_stamps_that_do_not_rise_are_left_out(caplog: pytest.LogCaptureFixture) -> None:
    said = {"slot": 0, "t_ns": 0, "age_ns": 0}
    sink = Sink("left")
    sink.running_ns = 5
    assert sink.take({**said, "running_ns": 5}) is None
    assert sink.take({**said, "running_ns": 4}) is None
    assert caplog.text.count("the stamps of left do not rise") == 1


@pytest.mark.fault("image: 1.5 s late")
def test_pictures_that_come_late_are_told_of(caplog: pytest.LogCaptureFixture) -> None:
    slow = (
        f"{SMALL} ! queue min-threshold-time=1500000000 max-size-time=0 max-size-bytes=0 max-size-buffers=0"
    )
    frames, came = take(two_eyes(slow), 3)
    assert came[0] - frames[0].t_capture_ns > 1.2e9  # an old image keeps its old stamp
    assert re.search(r"are \d+\.\d s old when they come", caplog.text)


def test_a_source_that_gives_nothing_is_not_waited_for_long() -> None:
    silent = "appsrc is-live=true caps=video/x-raw,format=RGB,width=64,height=48,framerate=30/1"
    with pytest.raises(SagsError, match=r"no image of left and right within 1 s.*source\.start"):
        open_pipeline(GstSource(left=silent, right=silent, start=1.0))


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({}, "name launch"),
        ({"left": "a"}, "name launch"),
        ({"launch": "a ! left.", "left": "b"}, "leave left and right out"),
        ({"launch": "a"}, "needs one branch that ends in '! left.'"),
        ({"launch": "a ! left.  b ! right.", "geometry": {"layout": "over_under"}}, "launch ends open"),
        ({"left": "a", "right": "b", "geometry": {"layout": "over_under"}}, "needs launch, one string"),
    ],
)
def test_strings_that_cannot_be_two_eyes_are_refused(said: Any, words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        GstSource(**said)


def test_a_child_that_crashes_is_told_of_and_a_ctrl_c_in_the_terminal_is_not_its_own() -> None:
    """It goes to all of the terminal's foreground group, and the pipeline's death was told of as a fault."""
    child = GstProcess({"launch": "videotestsrc is-live=true ! fakesink", "sinks": []})
    try:
        (process,) = until(pipelines)
        assert os.getpgid(process) not in (os.getpgid(0), 0)
        kill_pipelines()
        with pytest.raises(SagsError, match="its process was ended by signal 9"):
            for _ in range(100):
                child.hear(0.1)
    finally:
        child.close()


def test_what_only_the_log_says_is_said() -> None:
    said = in_words("the pipeline does not start", "decklinkvideosrc0: Failed to acquire input")
    assert said == "GStreamer: the pipeline does not start (decklinkvideosrc0: Failed to acquire input)"


# ---- to the pixel ----------------------------------------------------------------------------------------


def pictures(count: int, height: int, width: int) -> np.ndarray:
    return np.random.default_rng(2).integers(0, 256, (count, height, width, 3), np.uint8)


def test_a_file_is_played_to_its_end(tmp_path: Path) -> None:
    """Also an encoded one, as launch/gst_file.yaml plays it."""
    shown = pictures(6, 48, 62)  # rows of 186 bytes, which GStreamer pads
    left = raw_file(tmp_path / "left.raw", shown, rate=60)
    right = raw_file(tmp_path / "right.raw", shown[:, ::-1], rate=60)
    frames, came = take(GstSource(left=left, right=right), 99)
    assert len(frames) == 6
    for frame, picture in zip(frames, shown, strict=True):
        assert (frame.left == picture).all() and (frame.right == picture[::-1]).all()
    due = np.array([frame.t_capture_ns for frame in frames])
    assert np.abs(np.diff(due) - 1e9 / 60).max() < 1e6 and (np.array(came) >= due - 1e6).all()  # its own rate
    smooth = cv2.resize(pictures(1, 6, 8)[0], (320, 240), interpolation=cv2.INTER_CUBIC)
    file = f"filesrc location={write_video(tmp_path / 'eye.avi', [smooth] * 5, 30)} ! decodebin"
    frames, _ = take(GstSource(left=file, right=file), 99)
    assert len(frames) == 5
    assert np.abs(frames[0].left.astype(int) - smooth).mean() < 4  # JPEG's loss; exchanged colours: 80


def test_what_nobody_deinterlaces_is_told_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    launch = raw_file(tmp_path / "both.raw", pictures(2, 48, 64), rate=30, interlaced=True)
    take(GstSource(launch=launch, geometry=GeometryConfig(layout="side_by_side")), 99)
    assert "the images are interlaced, so what moves is torn; add ! deinterlace" in caplog.text


@pytest.mark.parametrize(
    ("bits", "through"),
    [(10, ""), (10, "! videoconvert dither=none ! video/x-raw,format=v210"), (12, ""), (16, "")],
)
def test_what_sdi_and_decoders_give_keeps_its_depth(tmp_path: Path, bits: int, through: str) -> None:
    """YUV of 10 and 12 bit, and v210: 876 and 3504 steps from black to white; gray of 16 bit. A quarter is
    chosen: 8 bit would leave 64 tones."""
    black, steps = (0, 65535) if bits == 16 else (64 << (bits - 10), 876 << (bits - 10))
    height, width = 32, 64
    luma = np.linspace(black + steps / 4, black + steps / 2, height * width).round().astype("<u2")
    if bits == 16:
        launch = raw_file(tmp_path / "deep.raw", luma.reshape(1, height, width).repeat(2, axis=0), rate=30)
    else:
        neutral = np.full(height * width // 2, 512 << (bits - 10), "<u2")
        (tmp_path / "deep.raw").write_bytes(2 * (luma.tobytes() + neutral.tobytes()))
        launch = (
            f"filesrc location={tmp_path / 'deep.raw'} ! rawvideoparse format=i420-{bits}le width={width} "
            f"height={height} framerate=30/1 {through}"
        )
    geometry = GeometryConfig(layout="side_by_side", levels=(0.25, 0.5))
    frames, _ = take(GstSource(launch=launch, geometry=geometry), 99)
    both = np.concatenate([frames[0].left, frames[0].right], axis=1)
    expected = ((luma - black) / steps - 0.25).reshape(height, width, 1) / 0.25 * 255
    assert np.abs(both - expected).max() < 2.0  # what 8 bit would be off, with steps of 4
    assert len(np.unique(both)) > 0.95 * min(256, steps / 4)


# ---- commands --------------------------------------------------------------------------------------------
