"""Red and blue that are exchanged are told by check and run alike; sound images are not called so."""

from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from recorded_session import both, frames_of, opened, play

from sags_node.findings import by_code
from sags_node.media.video import Video
from sags_node.pipeline.session import open_session
from sags_node.tools.calibration.guess import guess_rig
from sags_node.tools.importing.check import check_folder, overrides_of
from sags_node.types import U8
from sags_node.vision.watch.color_watch import is_blue

CODE = "red_blue_exchanged"


def exchanged(picture: U8) -> U8:
    return np.ascontiguousarray(picture[..., ::-1])


def recorded(folder: Path, eyes: str) -> Path:
    """Images of the phantom whose red and blue are as `eyes` says."""
    for frame in frames_of(opened("source.frames:=6")):
        shown = both(frame, exchanged) if eyes == "exchanged" else frame
        for side in ("left", "right"):
            (folder / side).mkdir(exist_ok=True)
            bgr = getattr(shown, side)[..., ::-1]
            cv2.imwrite(str(folder / side / f"{frame.frame_id}.png"), bgr)
    return folder


@pytest.mark.fault("image: red and blue are exchanged")
@pytest.mark.parametrize("eyes", ["exchanged", "as they are"])
def test_a_folder_is_told_by_check_and_run_alike(eyes: str, tmp_path: Path) -> None:
    folder = recorded(tmp_path, eyes)
    said = [each for each in check_folder(folder) if "red and blue" in each.what]
    assert [each.level for each in said] == ["warning"] * (eyes == "exchanged")
    session = open_session(folder, [*overrides_of(folder), "source.pace:=step"], guess=guess_rig)
    _, codes, pipeline = play(session, frames_of(session), 1)
    # One frame tells nothing.
    assert [CODE in each for each in codes] == [False] + [eyes == "exchanged"] * 5
    if eyes == "exchanged":
        text = by_code(pipeline.warnings)[CODE]
        assert text == f"{said[0].what}; {said[0].fix}"


@pytest.mark.parametrize(
    "pattern",
    ["d4d_pull/*.mp4", "endonerf_pulling/pulling.mp4", "hamlyn_invivo*/left/*", "hamlyn_f7*/*_L_*",
     "tmi*/[lr]*t.png"],
)  # fmt: skip
def test_no_real_recording_is_called_so_unless_it_is(pattern: str, data_folder: Path) -> None:
    """A few images of each; of a video the left eye's, in a quarter of the image."""
    files = sorted(data_folder.glob(pattern))
    if pattern.endswith(".mp4"):
        with closing(Video(files[0])) as video:
            read = [video.read(number) for number in range(0, video.count, 20)]
        pictures = [each[: each.shape[0] // 2, : each.shape[1] // 2] for each in read if each is not None]
    else:
        pictures = [cv2.imread(str(file))[..., ::-1] for file in files[:: max(1, len(files) // 5)]]
    assert pictures and not any(map(is_blue, pictures))
    assert all(is_blue(exchanged(each)) for each in pictures)


@pytest.mark.parametrize(
    ("color", "is_so"),
    [
        ((120, 120, 120), False),  # grey
        ((100, 110, 118), False),  # a cold white balance: 0.055 of R + G + B
        ((90, 100, 120), True),  # 0.097
        ((2, 2, 9), False),  # too dark to have a colour
        ((20, 60, 255), False),  # clipped
        ((40, 150, 60), False),  # ICG, or narrow bands
    ],
)
def test_how_blue_is_arithmetic(color: tuple[int, int, int], is_so: bool) -> None:
    assert is_blue(np.full((48, 64, 3), color, np.uint8)) == is_so
