"""`sags new`: what is odd about a recording is set right in the launch file that it writes."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from command_line import figures_of, ran, refused
from places import SESSION
from user_files import write_video

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import VideosSource
from sags_node.errors import UsageError
from sags_node.sources.source import open_source
from sags_node.tools.importing.proposal import propose
from sags_node.types import U8

FRAMES = 6
EYES = "left", "right"
LEFT, RIGHT = (
    [cv2.imread(str(file)) for file in sorted((SESSION / side).iterdir())[:FRAMES]] for side in EYES
)


def videos(folder: Path, left: list[U8], right: list[U8]) -> tuple[Path, Path]:
    folder.mkdir(parents=True, exist_ok=True)
    for name, pictures in (("a.mp4", left), ("b.mp4", right)):
        write_video(folder / name, pictures)
    return folder / "a.mp4", folder / "b.mp4"


def set_by(launch: list[str]) -> dict[str, str]:
    return dict(each.split(":=", 1) for each in launch)


def test_exchanged_videos_are_put_in_order(tmp_path: Path) -> None:
    left, right = videos(tmp_path, LEFT, RIGHT)
    for named in ((left, right), (right, left)):
        found = propose(named)
        assert set_by(found.launch)["source.left"] == str(left)
        assert ("exchanged" in str(found.findings)) == (named[0] == right)
        assert not [each for each in found.findings if each.level == "error"]


def test_both_eyes_in_one_picture_and_which_is_first(tmp_path: Path) -> None:
    file = tmp_path / "both.mp4"
    write_video(file, [np.vstack(pair) for pair in zip(RIGHT, LEFT, strict=True)])
    said = set_by(propose([file]).launch)
    assert said["source.geometry.layout"] == "over_under" and said["source.geometry.first"] == "right"


def test_panes_that_are_exchanged_are_put_in_order(tmp_path: Path) -> None:
    write_video(tmp_path / "both.mp4", [np.hstack(pair) for pair in zip(RIGHT, LEFT, strict=True)])
    one, other = "[0, 0, 320, 256]", "[320, 0, 320, 256]"
    keys = {"layout": "panes", "first": "left", "crop": one, "crop_right": other}
    found = propose([tmp_path / "both.mp4"], [f"source.geometry.{key}:={said}" for key, said in keys.items()])
    said = set_by(found.launch)
    assert (said["source.geometry.crop"], said["source.geometry.crop_right"]) == (other, one)
    assert said["source.geometry.first"] == "left" and "are exchanged" in str(found.findings)


def framed(left: int, right: int, eye: list[U8], rows: int = 0) -> list[U8]:
    """Images with black borders of so many columns and rows, of the same size."""
    pictures = [picture.copy() for picture in eye]
    for picture in pictures:
        picture[:, :left] = picture[:, picture.shape[1] - right :] = 0
        picture[:rows] = picture[picture.shape[0] - rows :] = 0
    return pictures


@pytest.mark.parametrize("left", [(32, 32), (16, 0)], ids=["alike", "the eyes' differ"])
def test_black_borders_are_cut_off_and_both_eyes_get_one_crop(left: tuple[int, int], tmp_path: Path) -> None:
    right = left if left[1] else (0, 24)
    both = framed(*left, LEFT, rows=16), framed(*right, RIGHT, rows=16)
    found = propose(videos(tmp_path, *both))
    x, y, width, height = yaml.safe_load(set_by(found.launch)["source.geometry.crop"])
    assert abs(x - left[0]) <= 2 and abs(y - 16) <= 2  # compressed: the edge is soft
    assert abs(x + width - (320 - right[1])) <= 2 and abs(height - (256 - 32)) <= 4
    assert not [each for each in found.findings if "borders; the image" in each.what and each.level != "ok"]


@pytest.mark.parametrize("flip", ["none", "horizontal", "both"])
def test_borders_within_a_crop_are_those_of_the_whole_picture(flip: str, tmp_path: Path) -> None:
    both = videos(tmp_path, framed(32, 32, LEFT), framed(32, 32, RIGHT))
    found = propose(both, ["source.geometry.crop:=[20,10,290,240]", f"source.geometry.flip:={flip}"])
    x, y, width, height = yaml.safe_load(set_by(found.launch)["source.geometry.crop"])
    assert abs(x - 32) <= 2 and abs(x + width - (320 - 32)) <= 2 and (y, height) == (10, 240)


def test_borders_stay_where_the_calibration_is_of_whole_pictures(tmp_path: Path) -> None:
    both = videos(tmp_path, framed(12, 12, LEFT), framed(12, 12, RIGHT))
    found = propose(both, [f"rig:={SESSION / 'calib'}"])
    assert "source.geometry.crop" not in set_by(found.launch)
    stay = [each for each in found.findings if "borders; the image" in each.what]
    assert {(each.level, each.fix.partition(":")[0]) for each in stay} == {("ok", "the borders stay")}
    assert not [each for each in found.findings if each.level == "error"]


def test_the_file_plays_from_wherever_it_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also without a terminal; the calibration is compared."""
    videos(tmp_path / "case", LEFT, RIGHT)
    monkeypatch.chdir(tmp_path)
    rig = f"rig:={os.path.relpath(SESSION / 'calib', tmp_path)}"
    report = figures_of("new", "case", rig, "mapping.max_gaussians:=5000", "-o", "mine.yaml", "--json")
    assert report["launch"] == "mine.yaml"
    said = " ".join(row["what"] for row in report["found"])
    assert f"{FRAMES} frames of 320x256 px at 10 Hz" in said and "rows agree" in said
    monkeypatch.chdir("/")
    config = load_launch(tmp_path / "mine.yaml")
    assert config.rig is not None and config.mapping.max_gaussians == 5000
    with open_source(config.source.model_copy(update={"pace": "step"}), references=False) as source:
        assert len(list(source)) == FRAMES
    refused(2, "new", tmp_path / "case", "-o", tmp_path / "mine.yaml", said=("exists already", "--force"))


def test_what_is_odd_is_said_once_however_often_it_is_opened(tmp_path: Path) -> None:
    for side, pictures in zip(EYES, (LEFT, RIGHT), strict=True):
        (tmp_path / "case" / side).mkdir(parents=True)
        for number, picture in enumerate(pictures):
            if (side, number) != ("left", 3):
                cv2.imwrite(str(tmp_path / "case" / side / f"{number}.png"), picture)
    shutil.copytree(SESSION / "calib", tmp_path / "case/calib")
    said = [each.what for each in propose([tmp_path / "case"]).findings]
    assert len(said) == len(set(said)) and sum("no partner" in each for each in said) == 1


def test_what_cannot_be_played_gets_no_file(tmp_path: Path) -> None:
    left, right = videos(tmp_path, LEFT, RIGHT[:3])
    file = tmp_path / "mine.yaml"
    code, out, said = ran("new", left, right, "-o", file)
    assert code == 1 and "source.frames:=3" in out and "cannot be played" in said and not file.exists()
    refused(2, "new", "-o", file, said=("name a folder, a video or a device",))  # there is nobody to ask
    refused(2, "new", tmp_path / "gone", "-o", file, said=("does not exist",))
    refused(2, "new", left, SESSION, "-o", file, said=("neither two videos nor two folders",))
    refused(2, "new", SESSION, "-o", file, said=("has a launch file already",))
    refused(1, "new", "/dev/no-camera", "-o", file, said=("/dev/no-camera", "does not exist"))
    with pytest.raises(UsageError, match="two of one kind"):
        propose([left, right, left])


@pytest.mark.parametrize("name", ["data$", "a $SAGS_DATA b", "${HOME}", "$$", "a\tb", "videos", "bag"])
def test_paths_are_paths_and_words_words(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names with a dollar or a tab, and folders that are called as values of keys are."""
    left, right = videos(tmp_path / name, LEFT, RIGHT)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "step").mkdir()
    code, _, said = ran("new", f"{name}/a.mp4", f"{name}/b.mp4", "source.pace:=step", "-o", "my own.yaml")
    assert code == 0 and "sags run 'my own.yaml'" in said
    for place in (tmp_path, Path("/")):
        monkeypatch.chdir(place)
        source = load_launch(tmp_path / "my own.yaml").source
        assert isinstance(source, VideosSource) and source.pace == "step"
        assert (source.left, source.right) == (left, right)


def test_a_name_that_is_no_text_is_refused_before_anything_is_told_of_it(tmp_path: Path) -> None:
    left, right = videos(tmp_path / "utf-8", LEFT, RIGHT)
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/lat\xe9in"))
    left.parent.rename(folder)
    both = folder / left.name, folder / right.name
    of_both = "source.kind:=videos", *(f"source.{eye}:={file}" for eye, file in zip(EYES, both, strict=True))
    for command in (("run", folder), ("new", *both), ("import", "--check", folder), ("doctor", *of_both)):
        code, _, said = ran(*command)
        assert code == 2 and "holds bytes that are no UTF-8 text" in said and "rename it" in said
    (folder / "case.mcap").touch()
    with pytest.raises(UsageError, match=r"no UTF-8 text.*rename it"):
        load_launch(folder / "case.mcap")


def test_a_variable_that_is_not_set_says_how_a_dollar_is_written(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("source: {kind: videos, left: $gone/a.mp4, right: b.mp4}\n")
    with pytest.raises(UsageError, match=r"export gone first, or write \$\$"):
        load_launch(tmp_path / "a.yaml")
    (tmp_path / "a.yaml").write_text("source: {kind: videos, left: $$gone/a.mp4, right: c$.mp4}\n")
    source = load_launch(tmp_path / "a.yaml").source
    assert isinstance(source, VideosSource)
    assert (source.left, source.right) == (tmp_path / "$gone/a.mp4", tmp_path / "c$.mp4")
