"""Folders with one thing wrong each: it is found, and nothing else is."""

import json
import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import figures_of, ran, refused
from numbered_pictures import write_video
from places import SESSION
from stamped_videos import write

from sags_node.checks import Finding, parted
from sags_node.config.launch_file import load_launch
from sags_node.errors import SagsError, UsageError
from sags_node.pipeline.session import open_session
from sags_node.rig import read_rig, save_rig
from sags_node.terminal import console as terminal
from sags_node.tools.calibration.guess import guess_rig
from sags_node.tools.importing.check import check_folder, overrides_of
from sags_node.tools.importing.pictures import combing, lit_box
from sags_node.types import U8, StereoRig

WIDTH, HEIGHT, FRAMES, DISPARITY = 160, 120, 4, 9


def texture(seed: int, shift: int = 0) -> U8:
    """Smooth spots; `shift` moves them to the right."""
    rng = np.random.default_rng(seed)
    small = rng.integers(40, 220, (HEIGHT // 4, WIDTH // 2, 3), np.uint8)
    wide = cv2.resize(small, (2 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    cut: U8 = np.ascontiguousarray(wide[:, WIDTH // 2 - shift : WIDTH // 2 - shift + WIDTH])
    return cut


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A sound recording: rectified images of both eyes in two kinds of files, masks and depth in 1e-5 m."""
    folder = tmp_path / "case"
    for side in ("left", "right", "masks", "depth"):
        (folder / side).mkdir(parents=True)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:40, :50] = 255
    depth = np.full((HEIGHT, WIDTH), 8000, np.uint16)
    for number in range(FRAMES):
        cv2.imwrite(str(folder / f"left/{number:03}.bmp"), texture(number))
        cv2.imwrite(str(folder / f"right/{number:03}.tiff"), texture(number, -DISPARITY))
        cv2.imwrite(str(folder / f"masks/{number:03}.png"), mask)
        cv2.imwrite(str(folder / f"depth/{number:03}.png"), depth)
    return folder


def odd(folder: Path, *overrides: str) -> list[Finding]:
    """What is not well, but for the calibration that these folders lack."""
    found = check_folder(folder, overrides)
    return [each for each in found if each.level != "ok" and "no calibration" not in each.what]


def edited(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """All images of that folder are changed."""

    def edit(folder: Path) -> None:
        for file in (folder / name).iterdir():
            cv2.imwrite(str(file), change(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))

    return edit


def test_a_sound_folder(folder: Path) -> None:
    found = check_folder(folder)
    assert [each.what for each in found if each.level != "ok"] == ["no calibration lies beside the images"]
    said = "\n".join(each.what for each in found)
    assert "4 images each" in said and f"disparity {DISPARITY}.0 px, rows agree" in said
    assert "80 mm with 1e-05 m per count" in said and "10% of the image is instrument" in said
    assert "source.left:=" in found[-1].what and "source.tools:=" in found[-1].what


def interlaced(folder: Path) -> None:
    for number in range(FRAMES):
        both = texture(number)
        both[1::2] = texture(number, 6)[1::2]  # the other field, a sixtieth of a second later
        cv2.imwrite(str(folder / f"left/{number:03}.bmp"), both)


def bordered(folder: Path) -> None:
    for side in ("left", "right"):
        edited(side, lambda picture: cv2.rectangle(picture, (0, 0), (19, HEIGHT), (3, 3, 3), -1))(folder)


def gap(folder: Path) -> None:
    for side, suffix in (("left", "bmp"), ("right", "tiff"), ("masks", "png")):
        (folder / f"{side}/003.{suffix}").rename(folder / f"{side}/007.{suffix}")


def exchanged(folder: Path) -> None:
    (folder / "left").rename(folder / "there")
    (folder / "right").rename(folder / "left")
    (folder / "there").rename(folder / "right")


def depth_of_floats(folder: Path) -> None:
    for file in list((folder / "depth").iterdir()):
        file.unlink()
        cv2.imwrite(str(file.with_suffix(".tiff")), np.full((HEIGHT, WIDTH), 0.08, np.float32))


def one_eye_twice(folder: Path) -> None:
    shutil.rmtree(folder / "right")
    shutil.copytree(folder / "left", folder / "right")


def cut_off(folder: Path) -> None:
    (folder / "left/000.bmp").write_bytes((folder / "left/000.bmp").read_bytes()[:5000])


def dead_link(folder: Path) -> None:
    """As in a data set whose files were not all fetched."""
    (folder / "left/000.bmp").unlink()
    (folder / "left/000.bmp").symlink_to("gone")


# What is done to the folder; what is said of it, and its fix.
PLANTED: dict[str, tuple[Callable[[Path], object], str, str]] = {
    "masks_inverted": (
        edited("masks", lambda mask: 255 - mask), "polarity", "source.instruments:=black"
    ),
    "masks_of_ones": (
        edited("masks", lambda mask: mask // 255),
        "masks/000.png holds the values 0, 1, which do not tell", "source.instruments:=[1]",
    ),
    "masks_of_nothing": (
        edited("masks", np.zeros_like),
        "none of 4 masks that were looked at marks an instrument", "leave masks out",
    ),
    "masks_small": (
        edited("masks", lambda mask: mask[::2, ::2]), "masks/000.png is 80x60 px but", "one size"
    ),
    "depth_is_disparity": (
        edited("depth", lambda depth: np.full_like(depth, 2)),
        "no distance in an endoscope's view", "disparity",
    ),
    "depth_coloured": (
        edited("depth", lambda depth: np.dstack([depth] * 3)), "has 3 channels", "grey"
    ),
    "depth_of_floats": (depth_of_floats, "holds floating numbers", "16 bit"),
    "right_one_missing": (
        lambda folder: (folder / "right/002.tiff").unlink(),
        "have no partner of their name, e.g. ", "they are left out",
    ),
    "gap": (gap, "gaps in the numbers, first between 002", "gap"),
    "cut_off": (cut_off, "damaged or cut off", "replace"),
    "dead_link": (dead_link, "cannot read image", "left/000.bmp"),
    "one_eye_twice": (one_eye_twice, "both eyes get the same image", "source.right"),
    "exchanged": (exchanged, "eyes exchanged", "exchange left and right"),
    "interlaced": (interlaced, "left: interlaced", "deinterlace"),
    "borders": (bordered, "black borders; the image is 140x120 px at 20,0", "[20,0,140,120]"),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_oddity_is_named_with_its_fix(name: str, folder: Path) -> None:
    plant, what, fix = PLANTED[name]
    plant(folder)
    found = odd(folder)
    assert any(what in each.what and fix in each.what + each.fix for each in found), found
    other = [each.what for each in found if what not in each.what]
    # One cause may show twice: both eyes have borders, fields in one eye hide its matches.
    assert name in ("interlaced", "borders", "right_one_missing", "gap") or not other, other
    assert is_refused(folder) == any(each.level == "error" for each in found)


@pytest.mark.parametrize("kind", ["pictures", "videos"])
def test_check_says_what_run_says(kind: str, folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    played = folder if kind == "pictures" else folder.with_name("videos")
    gap(folder)
    edited("masks", np.zeros_like)(folder)
    folder.with_name("videos").mkdir()
    shown = [number / 25 + 2 * (number > 9) for number in range(20)]
    for side, shift in (("left", 0), ("right", -DISPARITY)):
        write(folder.with_name("videos") / f"{side}.mkv", moving(20, shift), shown, aspect=Fraction(4, 3))
    assert not is_refused(played)
    said = {record.getMessage() for record in caplog.records}
    checked = {f"{each.what}; {each.fix}" for each in odd(played)}
    once = {each for each in said if "right.mkv" in each}  # the check has said it of the left one
    assert len(said) == 2 + len(once) == (3 if kind == "videos" else 2) and said - checked == once


@pytest.mark.parametrize("has_rig", [True, False])  # else a camera is guessed from some images
def test_a_run_says_it_all_again(has_rig: bool, folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    gap(folder)
    if has_rig:
        shutil.copytree(SESSION / "calib", folder / "calib")
    for _ in range(2):
        check_folder(folder)
        caplog.clear()
        assert not is_refused(folder)
        assert [record.getMessage().count("gaps in the numbers") for record in caplog.records].count(1) == 1


def test_a_rate_that_nobody_told_is_called_assumed(folder: Path) -> None:
    """Names that are times tell it; so does who sets it."""

    def said(*overrides: str) -> str:
        return next(each.what for each in check_folder(folder, overrides) if " Hz" in each.what)

    size = f"{FRAMES} frames of {WIDTH}x{HEIGHT} px at 30 Hz"
    assert said("source.rate:=30") == size
    assert said() == f"{size} (assumed: the files do not say it; set source.rate)"
    for file in list(folder.rglob("*.*")):
        file.rename(file.with_stem(f"{1_700_000_000 + int(file.stem)}"))
    assert said().endswith("at 1 Hz")


def is_refused(folder: Path) -> bool:
    """By `sags run`."""
    try:
        with open_session(folder, overrides_of(folder), guess=guess_rig).source as source:
            next(iter(source))
    except SagsError:
        return True
    return False


def test_a_copy_that_broke_off_is_found_among_many(tmp_path: Path) -> None:
    """The last file, or the smallest one, whichever else is looked at."""
    for broken in ("049.bmp", "023.bmp"):
        folder = tmp_path / broken
        folder.mkdir()
        for number in range(50):
            cv2.imwrite(str(folder / f"{number:03}.bmp"), texture(0))
        assert check_folder(folder)[1].level == "ok", "but for being in one folder"
        file = folder / broken
        file.write_bytes(file.read_bytes()[:-100])
        _, finding = odd(folder)
        assert broken in finding.what and "cut off" in finding.what and "replace" in finding.fix


def test_one_broken_file_is_said_once(folder: Path) -> None:
    (folder / "left/000.bmp").write_bytes(b"")
    shutil.copytree(SESSION / "calib", folder / "calib")
    assert sum("000.bmp" in each.what for each in check_folder(folder)) == 1
    assert check_folder(folder)[-1].what == f"to play it: when that is fixed: sags run {folder}"
    shutil.copy(folder / "left/001.bmp", folder / "left/000.bmp")
    assert overrides_of(folder)[-1] == f"rig:={folder / 'calib'}"


def test_a_semicolon_in_a_name_does_not_part_a_message(folder: Path) -> None:
    there = folder.rename(folder.with_name("case; old")) / "left"
    (there / "000.bmp").rename(there / "000; cut.bmp").write_bytes(b"")
    (error,) = [each for each in check_folder(there.parent) if each.level == "error"]
    assert str(there / "000; cut.bmp") in error.what and error.fix == "replace or remove the pair"
    for message, what, fix in (
        (f"{there}: 2 gaps; see '{there}'; fill them", f"{there}: 2 gaps", f"see '{there}'; fill them"),
        (f"cannot read {there}", f"cannot read {there}", ""),
        (f"images of {there} are odd; {there.parent}", f"images of {there} are odd", str(there.parent)),
        ("one; two; three", "one", "two; three"),
    ):
        assert parted("error", message) == Finding("error", what, fix)


def test_what_macos_writes_beside_files_is_passed_over(folder: Path, tmp_path: Path) -> None:
    videos = write_eyes(tmp_path / "videos", moving(5), moving(5, -DISPARITY))
    for played in (folder, videos):
        for file in [each for each in played.rglob("*") if each.is_file()]:
            file.with_name(f"._{file.name}").write_bytes(b"\0\5\26\7\0\2\0\0Mac OS X")
        assert not odd(played) and not is_refused(played)
    said = check_folder(videos)
    assert f"source.left:={videos / 'left.avi'} source.right:={videos / 'right.avi'}" in said[-1].what
    assert any("disparity" in each.what for each in said)


@pytest.mark.parametrize(
    ("name", "is_used"), [("calib/endoscope.yml", True), ("other.yml", False), ("my_calib.yml", True)]
)
def test_a_calibration_of_any_name_in_its_folder_is_used(name: str, is_used: bool, folder: Path) -> None:
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text("%YAML:1.0\n---\n")
    assert any(name in each.what for each in check_folder(folder) if each.level == "error") == is_used


@pytest.mark.parametrize(
    ("left", "right"), [("image_02", "image_03"), ("image_0", "image_1"), ("cam_left", "cam_right")]
)
def test_folders_of_both_eyes_are_known_and_others_are_asked_for(left: str, right: str, folder: Path) -> None:
    (folder / "left").rename(folder / left)
    (folder / "right").rename(folder / right)
    assert f"source.right:={folder / right}" in overrides_of(folder)
    assert "two folders" in check_folder(folder)[0].what
    (folder / right).rename(folder / "cam7")
    (error,) = check_folder(folder)
    assert error.fix.startswith("name those of both eyes, the left one first: sags new")
    assert "cam7" in error.fix


@pytest.mark.parametrize("names", ["{:03}l {:03}r", "left_{} right_{}", "a_L_{} a_R_{}"])
def test_eyes_are_told_by_names_of_files(names: str, tmp_path: Path) -> None:
    for number in range(FRAMES):
        for name, shift in zip(names.split(), (0, -DISPARITY), strict=True):
            cv2.imwrite(str(tmp_path / f"{name.format(number)}.png"), texture(number, shift))
    cv2.imwrite(str(tmp_path / "mask_left.png"), texture(0))
    found = check_folder(tmp_path)
    assert f"of both eyes, {FRAMES} pairs, in one folder" in found[0].what
    assert any(f"disparity {DISPARITY}" in each.what for each in found), found


def shown(left: U8, right: U8) -> dict[str, tuple[U8, str]]:
    """Both eyes in one image, and how that is played."""
    rows, dark = left.copy(), np.full_like(left, 20)
    rows[1::2] = right[1::2]
    panes, below = "layout:=panes source.geometry.crop", np.hstack([dark, left])
    one, other = (f":=[{x},0,{2 * WIDTH},{2 * HEIGHT}]" for x in (0, 2 * WIDTH))
    return {
        "side by side": (np.hstack([left, right]), "layout:=side_by_side"),
        "exchanged": (np.hstack([right, left]), "layout:=side_by_side source.geometry.first:=right"),
        "above": (np.vstack([left, right]), "layout:=over_under"),
        "rows": (rows, "layout:=row_interleaved"),
        "panes": (
            np.vstack([np.hstack([left, right]), below]), f"{panes}{one} source.geometry.crop_right{other}"
        ),
        "panes exchanged": (
            np.vstack([np.hstack([right, left]), below]), f"{panes}{other} source.geometry.crop_right{one}"
        ),
        "one eye": (left, "layout:=side_by_side shows what is in it"),  # not played: the fix
    }  # fmt: skip


@pytest.mark.parametrize("name", shown(texture(0), texture(0)))
def test_a_video_says_how_it_shows_both_eyes(name: str, tmp_path: Path) -> None:
    pictures = []
    for number in range(3):
        eyes = (texture(number), texture(number, -DISPARITY))
        left, right = (cv2.resize(eye, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC) for eye in eyes)
        picture, play = shown(left.astype(np.uint8), right.astype(np.uint8))[name]
        pictures.append(picture)
    write_video(tmp_path / "case.avi", pictures)
    found = check_folder(tmp_path)
    if name == "one eye":
        assert play in found[2].fix and found[2].level == "error", found
        with pytest.raises(UsageError, match="one eye"):
            overrides_of(tmp_path)
    else:
        assert " ".join(shlex.split(found[-1].what)).endswith(play), found
        for played in (tmp_path, tmp_path / "case.avi"):
            assert " ".join(overrides_of(played)).endswith(play)
    assert found[1].what.startswith("case.avi: 3 frames of ") and "px at 25 Hz, 0.1 s" in found[1].what
    assert ("one eye" in found[2].what) == (name == "one eye")
    assert ("taken for the left eye's" in str(found)) == ("exchanged" in name)
    assert "exchange " not in str(found)


@pytest.mark.parametrize("height", [1471, 1469])
def test_frame_packing_of_hdmi_is_taken_apart(height: int, tmp_path: Path) -> None:
    """720 rows, 30 blank ones, 720 rows; as codecs keep an even height, one row more or less."""
    big = [cv2.resize(texture(0, shift), (1280, 720)) for shift in (0, -DISPARITY)]
    picture = np.vstack([big[0], np.zeros((30, 1280, 3), np.uint8), big[1], big[1][-1:]])[:height]
    write(tmp_path / "scope.mkv", [picture] * 2, codec="ffv1", pixels="bgr0")
    with open_session(tmp_path, overrides_of(tmp_path), guess=guess_rig).source as source:
        frame = next(iter(source))
    rows = min(720, height - 750)
    assert np.array_equal(frame.left, big[0][:rows]) and np.array_equal(frame.right, big[1][:rows])
    assert "frame packing" in check_folder(tmp_path)[2].what


def test_two_parts_of_a_recording_are_no_pair(tmp_path: Path) -> None:
    for part in (1, 2):
        both = [np.hstack([texture(part, 0), texture(part, -DISPARITY)]) for _ in range(3)]
        write_video(tmp_path / f"REC000{part}.avi", [cv2.resize(each, None, fx=2, fy=2) for each in both])
    with pytest.raises(UsageError, match=r"REC0001.avi shows both eyes, side by side, and REC0002"):
        overrides_of(tmp_path)
    assert "side_by_side" in overrides_of(tmp_path / "REC0001.avi")[-1]


@pytest.mark.parametrize("name", ["case: 3 #1", "recorded today"])
def test_what_is_recognised_is_played(name: str, folder: Path, tmp_path: Path) -> None:
    """Also from a folder whose name YAML would read as something else, and by the shell's command."""
    folder = folder.rename(tmp_path / name)
    config = load_launch(folder, overrides_of(folder))
    assert config.source.model_dump(include={"kind", "left", "right", "tools"}) == {
        "kind": "folders", "left": folder / "left", "right": folder / "right", "tools": folder / "masks"
    }  # fmt: skip
    assert config.rig is None
    said = check_folder(folder)[-1].what.partition("to play it: ")[2]
    command, _, launch = said.partition(", which stands for ")
    assert shlex.split(command) == ["sags", "run", str(folder)]
    assert shlex.split(launch) == overrides_of(folder)


def test_noise_is_not_interlaced_and_darkness_is_no_border() -> None:
    fine = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH), np.uint8)
    assert combing(fine) == pytest.approx(combing(np.ascontiguousarray(fine.T)), rel=0.1)  # alike both ways
    assert lit_box(np.zeros((HEIGHT, WIDTH), np.uint8)) == (0, 0, WIDTH, HEIGHT)


def test_a_session_is_checked_with_its_calibration() -> None:
    found = check_folder(SESSION)
    assert {each.level for each in found} == {"ok"}, found
    said = "\n".join(each.what for each in found)
    assert "40 frames of 320x256 px at 10 Hz" in said and "calibration: " in said
    assert found[-1].what == f"to play it: sags run {SESSION}"
    assert overrides_of(SESSION) == []  # it has a launch file


def test_a_camera_that_looks_farther_is_asked_how_far(tmp_path: Path) -> None:
    """A ZED mini: eyes 15 times as far apart as a scope's put the phantom at a metre."""
    for side in ("left", "right"):
        shutil.copytree(SESSION / side, tmp_path / side)
    rig = read_rig(SESSION / "calib")
    wide = [replace(eye, P=eye.P * [1, 1, 1, 15]) for eye in (rig.left, rig.right)]
    save_rig(StereoRig("wide", *wide), tmp_path / "calib")
    (far,) = [each for each in odd(tmp_path) if "nothing is matched beyond 0.3 m" in each.what]
    assert re.search(r"points lie at (0.9|1.0)\d? m", far.what) and "vision.stereo.max_depth" in far.fix
    (left_over,) = odd(tmp_path, "vision.stereo.max_depth:=3")
    assert "is unusual for a stereo endoscope" in left_over.what


def test_folders_that_are_not_played_yet_are_named(tmp_path: Path) -> None:
    clip = "d4d/specimen_1/s/clips/Clip_1"
    for name in ("P2", "P3", "stir/01/left01/seq00/segmentation", f"{clip}/left_images_rect"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("P2/groundtruth.txt", "P2/StereoCalibration.ini", "P3/track_pts.pckl"):
        (tmp_path / name).touch()
    of_d4d = ("d4d", "d4d/specimen_1", "d4d/specimen_1/s", clip)
    named = {"P2": "StereoMIS", "P3": "StereoMIS-Tracking", "stir": "STIR", **dict.fromkeys(of_d4d, "D4D")}
    for name, said in named.items():
        assert said in check_folder(tmp_path / name)[0].what
    assert f"stereomis {tmp_path / 'P2'} measures it" in check_folder(tmp_path / "P2")[0].fix
    (unknown,) = check_folder(tmp_path)
    assert unknown.level == "error" and "nothing that is known" in unknown.what
    assert "P2, P3, d4d, stir" in unknown.fix


def test_the_command(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = figures_of("import", "--check", folder, "--json")
    assert found[0]["what"] == "case is two folders of images"
    monkeypatch.setattr(terminal, "SAY_EVERY", 0.0)
    code, out, said = ran("import", folder, "--json")
    assert code == 0 and json.loads(out) == found and "playing it: 1 of 3" in said
    refused(2, "import", "--check", tmp_path / "none", said=("does not exist",))
    refused(2, "import", said=("sags import my_folder",))


# ---- what sags run would refuse --------------------------------------------------------------------------


def write_eyes(folder: Path, left: list[U8], right: list[U8], right_rate: float = 25.0) -> Path:
    folder.mkdir()
    write_video(folder / "left.avi", left)
    write_video(folder / "right.avi", right, right_rate)
    return folder


def moving(count: int, shift: int = 0) -> list[U8]:
    """Images of a texture that goes up and down; truth is the arithmetic of where it is."""
    wide = np.vstack([texture(0, shift)] * 2)
    t = np.arange(count)
    places = np.round(20 + 12 * np.sin(0.7 * t) + 6 * np.sin(1.9 * t)).astype(int)
    return [np.ascontiguousarray(wide[place : place + HEIGHT]) for place in places]


@pytest.mark.parametrize("as_session", [False, True], ids=["videos", "a launch.yaml of them"])
@pytest.mark.parametrize(
    ("right", "rate", "said"),
    [
        (40, 30.0, ("25 frames/s", "has 30", "one rate is wrong")),
        (25, 25.0, ("right.avi has 25 images, ", "left.avi 40", "source.frames:=25")),
    ],
    ids=["another rate", "too short"],
)
def test_videos_that_cannot_be_played_are_refused(
    tmp_path: Path, right: int, rate: float, said: tuple[str, ...], as_session: bool
) -> None:
    folder = write_eyes(tmp_path / "case", moving(40), moving(40, -DISPARITY)[:right], rate)
    if as_session:
        source = "{kind: videos, left: left.avi, right: right.avi}"
        (folder / "launch.yaml").write_text(f"source: {source}\nrig: {SESSION / 'calib'}\n")
    code, out, error = ran("import", "--check", folder, "--json")
    assert code == 1 and "cannot be played" in error and all(part in out for part in said)


@pytest.mark.fault("file: a video is cut off")
@pytest.mark.parametrize(
    ("shown", "suffix", "how"),
    [
        ("both eyes", "mp4", {"muxer": {"movflags": "faststart"}}),
        ("right", "mkv", {}),
    ],
)
def test_a_video_that_is_cut_off_is_refused_alike(shown: str, suffix: str, how: Any, tmp_path: Path) -> None:
    """As any damaged file; what is there can be played."""
    pictures = [[cv2.resize(each, (256, 160)) for each in moving(150, shift)] for shift in (0, -DISPARITY)]
    named = dict(zip(("left", "right"), pictures, strict=True))
    if shown == "both eyes":
        named = {shown: [np.hstack(pair) for pair in zip(*pictures, strict=True)]}
    for name, each in named.items():
        write(tmp_path / f"{name}.{suffix}", each, options={"g": "10"}, **how)
    file = tmp_path / f"{shown}.{suffix}"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2 | 1])
    (error,) = [each for each in check_folder(tmp_path) if each.level == "error"]
    assert file.name in error.what and "is cut off" in error.what
    with pytest.raises(UsageError, match=r"is cut off.*copy it again"):
        open_session(tmp_path, overrides_of(tmp_path), guess=guess_rig)
    remedy = error.fix.split()[-1]
    assert 50 < int(remedy.removeprefix("source.frames:=")) < 149
    assert "error" not in {each.level for each in check_folder(tmp_path, [remedy])}
    overrides = [*overrides_of(tmp_path), remedy, "source.pace:=step"]
    with open_session(tmp_path, overrides, guess=guess_rig).source as source:
        assert len(list(source)) == int(remedy.removeprefix("source.frames:="))


@pytest.mark.parametrize("late", [3, 1, 0, -2])
@pytest.mark.parametrize("how", ["videos", "pictures", "a session"])
def test_an_eye_that_is_late_is_found(tmp_path: Path, late: int, how: str) -> None:
    """The right eye shows at frame t what the left one shows at t - late."""
    left, right = moving(60), moving(60, -DISPARITY)
    left, right = left[max(0, late) : 50 + min(0, late)], right[max(0, -late) : 50 - max(0, late)]
    folder = tmp_path / "case"
    if how == "videos":
        write_eyes(folder, left, right)
    for side, pictures in (("left", left), ("right", right)) if how != "videos" else ():
        (folder / side).mkdir(parents=True)
        for number, picture in enumerate(pictures):
            cv2.imwrite(str(folder / side / f"{number:03}.bmp"), picture)
    if how == "a session":
        (folder / "launch.yaml").write_text("source: {kind: folders, left: left, right: right}\n")
    said = [each.what.partition(":")[0] for each in check_folder(folder) if "frames late" in each.what]
    assert said == [f"the {'right' if late > 0 else 'left'} eye is {abs(late)} frames late"] * (late != 0)


@pytest.mark.parametrize("late", [0, 14, -14])
def test_of_videos_of_other_lengths_it_is_told_whether_one_was_begun_later(tmp_path: Path, late: int) -> None:
    """Both count from zero: only their images tell. 0: the right one was ended sooner."""
    left, right = moving(60), moving(60, -DISPARITY)
    folder = write_eyes(tmp_path / "case", left[max(0, -late) :], right[max(0, late) : 60 - 14 * (late == 0)])
    found = check_folder(folder)
    said = [f"{each.what}: {each.fix}" for each in found if "frames late" in each.what]
    assert len(said) == (late != 0) and is_refused(folder) == (late >= 0)
    if late:
        eye = "left" if late > 0 else "right"
        assert f"the {eye} eye is 14 frames late" in said[0] and f"first 14 frames off the {eye}" in said[0]
    else:
        assert not odd(folder, "source.frames:=46")


def test_where_nothing_moves_no_eye_is_late(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    still = [cv2.add(texture(0), noise.integers(0, 9, (HEIGHT, WIDTH, 3), np.uint8)) for _ in range(80)]
    found = check_folder(write_eyes(tmp_path / "case", still[:40], still[40:]))
    assert "frames late" not in str(found)


@pytest.mark.parametrize(
    ("name", "content"),
    [("folder", None), ("a.png", "one eye"), ("launch.yaml", "sorce: {}"), ("notes.txt", "mine")],
)
def test_what_cannot_be_played_has_exit_code_1(tmp_path: Path, name: str, content: str | None) -> None:
    if content is None:
        (tmp_path / name).mkdir()
    elif name == "a.png":
        cv2.imwrite(str(tmp_path / name), texture(0))
    else:
        (tmp_path / name).write_text(content)
    code, out, error = ran("import", "--check", tmp_path)
    assert code == 1 and "cannot be played" in error and "error" in out


def test_a_calibration_beside_videos_is_compared_with_them(tmp_path: Path) -> None:
    folder = write_eyes(tmp_path / "case", moving(40), moving(40, -DISPARITY))
    shutil.copytree(SESSION / "calib", folder / "calib")  # of 320x256 px
    (wrong,) = (each for each in check_folder(folder) if each.level == "error")
    assert "the calibration is for 320x256 px, the images are 160x120" in wrong.what


@pytest.mark.parametrize("names", [
    ["camchain.yaml"], ["ost.yaml"], ["cam0_info.yml"], ["a.yml", "b.xml"],
    ["files/a.xml"], ["stereoParams.mat"], ["StereoCalibration.ini"], ["intrinsics.txt"], ["more/calib.json"],
])  # fmt: skip
def test_a_calibration_that_is_not_used_is_named(names: list[str], folder: Path) -> None:
    (folder / "calib_board.png").write_bytes((folder / "masks/000.png").read_bytes())
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("%YAML:1.0\n---\n" if Path(name).stem in "ab" else "")
    (said,) = (each for each in check_folder(folder) if each.level != "ok")
    assert said.what == f"no calibration is used, though {', '.join(names)} lies there"
    assert f"set rig:={folder / names[0]} if sags calib check {folder / names[0]} takes" in said.fix
