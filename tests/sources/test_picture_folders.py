"""Folders as people bring them: masks of any values, deep images, times as names, missing partners."""

import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from frames import played
from mistakes import frames_until_error
from numbered_pictures import HEIGHT, WIDTH, number_of, numbers, picture, write_png
from PIL import Image, ImageMath, ImageOps

from sags_node.config import schema as cfg
from sags_node.config.launch_file import section_of
from sags_node.errors import SagsError, UsageError
from sags_node.sources.pictures import read_picture, say
from sags_node.sources.replay import Replay
from sags_node.sources.source import open_source
from sags_node.types import StereoFrame


def eyes(folder: Path, names: list[str], rights: list[str] | None = None) -> cfg.FoldersSource:
    """Images of both eyes, numbered as the names are; those that begin with `-` are not of the right eye,
    with `+` not of the left one. `rights`: the right eye's names, if they are others."""
    for eye, (side, missing, named) in enumerate((("left", "+", names), ("right", "-", rights or names))):
        for number, name in enumerate(named):
            if name[0] != missing:
                write_png(folder / f"{side}/{name.lstrip('+-')}.png", picture(number, eye))
    return folders_of(folder)


def folders_of(folder: Path, **said: object) -> cfg.FoldersSource:
    config = cfg.FoldersSource(left=folder / "left", right=folder / "right", pace="step", rate=20)
    return config.model_copy(update=said)


# ---- masks -----------------------------------------------------------------------------------------------

COUNT = 12
TOOL = np.zeros((96, 128), np.bool_)
TOOL[30:70, :60] = True
SHAFT, TIP = TOOL.copy(), TOOL.copy()
SHAFT[:, 40:] = TIP[:, :40] = False
LOWER, RIM = np.zeros_like(TOOL), np.zeros_like(TOOL)
LOWER[50:] = True
RIM[:, -6:] = True


def grey(*values: tuple[np.ndarray, int], dtype: type = np.uint8) -> np.ndarray:
    mask = np.zeros(TOOL.shape, dtype)
    for where, value in values:
        mask[where] = value
    return mask


def coloured(*values: tuple[np.ndarray, str]) -> np.ndarray:
    mask = np.zeros((*TOOL.shape, 3), np.uint8)
    for where, name in values:
        mask[where] = [int(name[at : at + 2], 16) for at in (5, 3, 1)]
    return mask


def with_alpha(mask: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return np.dstack([mask, mask, mask, alpha])


def with_masks(folder: Path, mask: np.ndarray, suffix: str = "png") -> cfg.FoldersSource:
    for number in range(COUNT):
        for side in ("left", "right"):
            write_png(folder / f"{side}/{number}.png", np.full((*TOOL.shape, 3), 90 + number, np.uint8))
        (folder / "masks").mkdir(exist_ok=True)
        assert cv2.imwrite(str(folder / f"masks/{number}.{suffix}"), mask)
    return folders_of(folder, tools=folder / "masks")


INK = grey((TOOL, 255))
SOFT = cv2.GaussianBlur(INK, (0, 0), 3)
TOLD = {
    "two values": (INK, "png"),
    "soft edges": (SOFT, "png"),
    "made larger": (cv2.resize(cv2.resize(SOFT, None, fx=0.5, fy=0.5), TOOL.shape[::-1]), "png"),
    "a rough JPEG, in colour": (cv2.cvtColor(grey((TOOL, 250)), cv2.COLOR_GRAY2BGR), "jpg"),
    "16 bit": (grey((TOOL, 65535), dtype=np.uint16), "png"),
    "black below what is clear": (with_alpha(INK, INK), "png"),
    "clear where there is none": (with_alpha(grey(), INK), "png"),
    "EndoVis 2018": (coloured((SHAFT, "#00ff00"), (TIP, "#7b0faf"), (RIM, "#7c9b05")), "png"),
}


@pytest.mark.parametrize("name", TOLD)
def test_masks_that_tell_instruments_from_tissue(name: str, tmp_path: Path) -> None:
    mask, suffix = TOLD[name]
    frames = played(with_masks(tmp_path, mask, suffix))
    edge = cv2.morphologyEx(TOOL.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((5, 5))) > 0
    sure = np.ones_like(TOOL) if len(np.unique(mask)) < 9 and suffix == "png" else ~edge
    assert len(frames) == COUNT
    for frame in frames:
        assert frame.tissue is not None and (frame.tissue == ~TOOL)[sure].all()


CLEAR = grey((np.ones_like(TOOL), 255))
EMPTY = {  # a mask with an instrument, one without, and what instruments are
    "opaque": (with_alpha(INK, CLEAR), with_alpha(grey(), CLEAR), "white"),
    "instruments can be seen": (with_alpha(grey(), INK), with_alpha(grey(), grey()), "white"),
    "tissue can be seen": (with_alpha(grey(), CLEAR - INK), with_alpha(grey(), CLEAR), "black"),
}
EMPTY["opaque, of 16 bit"] = *(257 * mask.astype(np.uint16) for mask in EMPTY["opaque"][:2]), "white"


@pytest.mark.fault("file: masks with an alpha channel, and frames without an instrument")
@pytest.mark.parametrize("tools_in", [{0, 3, 6, 9}, set(range(1, COUNT))])
@pytest.mark.parametrize("name", EMPTY)
def test_masks_with_alpha_and_no_instrument(name: str, tools_in: set[int], tmp_path: Path) -> None:
    """An opaque mask is no instrument from edge to edge, and one that is all clear is no tissue."""
    tool, none, instruments = EMPTY[name]
    config = with_masks(tmp_path, tool).model_copy(update={"instruments": instruments})
    for number in set(range(COUNT)) - tools_in:
        cv2.imwrite(str(tmp_path / f"masks/{number}.png"), none)
    for number, frame in enumerate(played(config)):
        assert frame.tissue is not None and (frame.tissue == (~TOOL | (number not in tools_in))).all()


ASKED = {
    "0 and 1": (grey((TOOL, 1)), "png", "0, 1"),
    "one label": (grey((TOOL, 100)), "png", "0, 100"),
    "parts": (grey((TOOL, 255), (SHAFT, 85), (TIP & LOWER, 170)), "png", "0, 85, 170, 255"),
    "labels, and 255 to be ignored": (grey((TOOL, 6), (RIM, 255)), "png", "0, 6, 255"),
    "parts in JPEG": (grey((SHAFT, 85), (TIP, 170)), "jpg", "0, 85, 170"),
    "16 bit labels": (grey((SHAFT, 1), (TIP, 2), dtype=np.uint16), "png", "0, 1, 2"),
    "a palette": (coloured((SHAFT, "#800000"), (TIP, "#008000")), "png", "#000000, #008000, #800000"),
}  # fmt: skip


@pytest.mark.parametrize("name", ASKED)
def test_other_masks_are_asked_about_and_read_as_is_answered(name: str, tmp_path: Path) -> None:
    mask, suffix, said = ASKED[name]
    config = with_masks(tmp_path, mask, suffix)
    with pytest.raises(UsageError, match=f"holds the values {said}, which do not tell") as caught:
        open_source(config)
    answer = re.findall(r"'(source\.instruments:=\[.*?\])'", str(caught.value))
    instruments = section_of(cfg.FoldersSource, [answer[0].removeprefix("source."), "left:=l"]).instruments
    sure = np.ones_like(TOOL) if suffix == "png" else cv2.erode(TOOL.astype(np.uint8), np.ones((9, 9))) > 0
    for frame in played(config.model_copy(update={"instruments": instruments})):
        assert frame.tissue is not None and (frame.tissue == ~TOOL)[sure].all()


def test_a_photograph_is_no_mask(tmp_path: Path) -> None:
    """A wrong folder: it was taken for masks without an instrument."""
    noise = np.random.default_rng(0).integers(0, 256, (*TOOL.shape, 3), np.uint8)
    with pytest.raises(UsageError, match="no area of one colour, so it is no mask; name a folder of masks"):
        open_source(with_masks(tmp_path, noise))


def test_a_label_that_comes_late_is_asked_about_there(tmp_path: Path) -> None:
    config = with_masks(tmp_path, grey((SHAFT, 255)))
    cv2.imwrite(str(tmp_path / "masks/5.png"), grey((SHAFT, 255), (TIP, 85)))
    frames, said = frames_until_error(config)
    assert len(frames) == 5 and "5.png holds the values 0, 85, 255" in said
    tissue = played(config.model_copy(update={"instruments": (255, 85)}))[5].tissue
    assert tissue is not None and (tissue == ~TOOL).all()


@pytest.mark.parametrize("instruments", [("#ffffff", "#ff0000"), (255, "#ff0000")])
def test_a_listed_grey_counts_also_with_colours(instruments: tuple[int | str, ...], tmp_path: Path) -> None:
    """The white shaft is in each frame, the red tip in every other one."""
    config = with_masks(tmp_path, coloured((SHAFT, "#ffffff"))).model_copy(
        update={"instruments": instruments}
    )
    for number in range(0, COUNT, 2):
        mask = coloured((SHAFT, "#ffffff"), (TIP, "#ff0000"), (RIM, "#808080"))
        cv2.imwrite(str(tmp_path / f"masks/{number}.png"), mask)
    for number, frame in enumerate(played(config)):
        assert frame.tissue is not None and (frame.tissue == (~SHAFT if number % 2 else ~TOOL)).all()


@pytest.mark.parametrize("value", ["[]", "[256]", "[-1]", "grey", "[red]", "85"])
def test_values_of_masks_are_checked(value: str) -> None:
    with pytest.raises(UsageError, match="should be white, black, or a list of values"):
        section_of(cfg.FoldersSource, ["left:=l", f"instruments:={value}"])


# ---- more than eight bits --------------------------------------------------------------------------------

RAMP = np.linspace(0, 1, HEIGHT * WIDTH * 3).reshape(HEIGHT, WIDTH, 3)  # BGR, from black to white


def deep(folder: Path, make: Callable[[np.ndarray], np.ndarray], suffix: str = "png") -> cfg.FoldersSource:
    for side, shown in (("left", RAMP), ("right", RAMP[:, ::-1])):
        for number in range(4):
            (folder / side).mkdir(exist_ok=True)
            assert cv2.imwrite(str(folder / f"{side}/{number}.{suffix}"), make(shown))
    return folders_of(folder)


def counts(white: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda shown: np.rint(shown * white).astype(np.uint16 if white > 255 else np.uint8)


DEEP = {
    "10 bits": (counts(1023), "png", "10 of 16 bits: 1023 is"),
    "14 bits": (counts(16383), "ppm", "14 of 16 bits: 16383 is"),
    "12 bits": (counts(4095), "tiff", "12 of 16 bits: 4095 is"),
    "16 bits": (counts(65535), "png", ""),
    "12 bits, moved up": (lambda shown: counts(4095)(shown) << 4, "png", ""),
    "floats to 1": (lambda shown: shown.astype(np.float32), "tiff", "floating numbers: 1 is"),
    "floats to 255": (lambda shown: (255 * shown).astype(np.float32), "tiff", "floating numbers: 255 is"),
    "doubles to 4095": (lambda shown: 4095 * shown, "tiff", "floating numbers: 4095 is"),
}


@pytest.mark.parametrize("name", DEEP)
def test_deep_pictures_are_read(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make, suffix, said = DEEP[name]
    frames = played(deep(tmp_path, make, suffix))
    for frame in frames:
        assert np.abs(frame.left / 255 - RAMP[..., ::-1]).max() < 1 / 255
        assert np.abs(frame.right / 255 - RAMP[:, ::-1, ::-1]).max() < 1 / 255
    assert (f"{said} taken for white" in caplog.text) == bool(said)


TISSUE = {"R": 140, "G": 84, "B": 81}


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG", "GGGG", "RRGG", "RGRG"])
def test_a_mosaic_is_told_of(pattern: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Colours of tissue under a camera's noise; grey images whose rows or columns differ are none."""
    say.cache_clear()  # as a new session does
    rng = np.random.default_rng(0)
    cells = np.array([TISSUE[name] for name in pattern]).reshape(2, 2)
    for side in ("left", "right"):
        shown = np.tile(cells, (48, 64)) + rng.normal(0, 6, (96, 128))
        write_png(tmp_path / f"{side}/0.png", np.clip(shown, 0, 255).astype(np.uint8)[..., None].repeat(3, 2))
    played(folders_of(tmp_path))
    assert ("a Bayer mosaic" in caplog.text) == (set(pattern) == set("RGB"))


HUES = cv2.applyColorMap(np.tile(np.arange(64, dtype=np.uint8) * 4, (48, 1)), cv2.COLORMAP_TURBO)[..., ::-1]
TURNED = Image.Exif()
TURNED[274] = 6  # by a quarter
FILES: dict[str, tuple[str, Callable[[Image.Image], Image.Image], Any]] = {
    "a palette": ("png", lambda shown: shown.quantize(64), {}),
    "one bit": ("tif", lambda shown: shown.convert("1"), {"compression": "group4"}),  # 0 is white in it
    "clear in part": ("png", lambda shown: Image.merge("RGBA", (*shown.split(), shown.getchannel(0))), {}),
    "inks": ("jpg", lambda shown: shown.convert("CMYK"), {"quality": 98}),
    "inks of print": ("tif", lambda shown: shown.convert("CMYK"), {}),
    "turned": ("jpg", lambda shown: shown, {"exif": TURNED, "quality": 98, "subsampling": 0}),
    "turned TIFF": ("tif", lambda shown: shown, {"tiffinfo": {274: 3}}),
    "grey floats": (
        "tif",
        lambda shown: ImageMath.lambda_eval(lambda of: of["L"] / 255.0, L=shown.convert("F")),
        {},
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_files_of_every_form_are_seen_as_another_library_sees_them(name: str, tmp_path: Path) -> None:
    suffix, make, options = FILES[name]
    file = tmp_path / f"0.{suffix}"
    make(Image.fromarray(HUES)).save(file, **options)
    seen = ImageOps.exif_transpose(Image.open(file))
    seen = Image.fromarray(np.asarray(seen) * 255).convert("L") if seen.mode == "F" else seen
    assert np.abs(read_picture(file).astype(int) - np.asarray(seen.convert("RGB"))).max() <= 8


def tag(name: int, said: int) -> bytes:
    """An entry of a TIFF: one number of 16 bits."""
    return struct.pack("<HHII", name, 3, 1, said)


DEEP_TIFF = cv2.imencode(".tif", (RAMP * 65535).astype(np.uint16))[1].tobytes()


@pytest.mark.fault("file: images whose white, colours or upright place OpenCV does not know")
@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        (
            "0.pgm",
            b"P5 # 255\n4 2\n100\n" + bytes(range(92, 100)),
            "would be too dark, as 100 is white in it",
        ),
        ("0.ppm", b"P6\n2 1\n15\n" + bytes(6), "would be too dark, as 15 is white in it; save it as PNG"),
        ("0.tif", DEEP_TIFF.replace(tag(262, 2), tag(262, 0)), "a deep TIFF whose white is 0"),
        ("0.tif", DEEP_TIFF.replace(tag(284, 1), tag(284, 2)), "with one colour behind the other"),
        ("0.tif", DEEP_TIFF.replace(tag(262, 2), tag(262, 8)), "has Lab colours; save it as RGB"),
    ],
)
def test_what_would_be_seen_wrongly_is_refused(name: str, data: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SagsError, match=said):
        read_picture(tmp_path / name)


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp"])
def test_a_mask_that_is_to_be_turned_is_refused(suffix: str, tmp_path: Path) -> None:
    """OpenCV turns images, and leaves masks and depth as they are stored."""
    config = eyes(tmp_path, ["0"])
    (tmp_path / "tools").mkdir()
    Image.fromarray(picture(0)).save(tmp_path / f"tools/0.{suffix}", exif=TURNED)
    with pytest.raises(
        SagsError, match=r"tools/0.\w+ is to be shown turned or mirrored \(EXIF orientation 6\)"
    ):
        open_source(config.model_copy(update={"tools": tmp_path / "tools"}))


@pytest.mark.parametrize("suffix", ["tif", "png", "webp"])
def test_a_stack_is_refused_and_a_thumbnail_passed_over(suffix: str, tmp_path: Path) -> None:
    for behind in (2, suffix == "tif"):
        for eye, side in enumerate(("left", "right")):
            first, *more = (Image.fromarray(picture(number, eye=eye)) for number in range(1 + behind))
            more = more if behind == 2 else [page.resize((16, 12)) for page in more]
            (tmp_path / side).mkdir(exist_ok=True)
            file = tmp_path / f"{side}/0.{suffix}"
            first.save(file, save_all=bool(more), append_images=more, lossless=True)
        if behind == 2:
            with pytest.raises(SagsError, match=r"left/0.\w+ holds 3 images, .*of its own"):
                open_source(folders_of(tmp_path))
    assert numbers(played(folders_of(tmp_path))) == [0]


def test_a_picture_brighter_than_white_is_no_white_one(tmp_path: Path) -> None:
    config = deep(tmp_path, counts(1023))
    for number in range(4, 40):
        for side in ("left", "right"):
            white = 16000 if (side, number) == ("left", 23) else 1023
            cv2.imwrite(str(tmp_path / f"{side}/{number}.png"), counts(white)(RAMP))
    _, said = frames_until_error(config)
    assert re.search(r"23\.png holds 16000, .* 1023 is white", said)


# ---- names -----------------------------------------------------------------------------------------------


def nanoseconds(count: int, step: float = 1e9 / 30) -> list[int]:
    return [1_700_000_000_000_000_000 + round(step * number) for number in range(count)]


def day(form: str) -> list[str]:
    """A second apart, over midnight."""
    seconds = [(86400 - 13 + number) % 86400 for number in range(24)]
    return [form.format(each // 3600, each // 60 % 60, each % 60) for each in seconds]


NAMES = {  # what is said of the names
    "seconds": ([f"{round(0.1 * number / 3, 3)}" for number in range(24)], ""),
    "decimal commas": ([f"{number / 30:.4g}".replace(".", ",") for number in range(24)], ""),
    "letters behind": ([f"f{number // 2}{'ab'[number % 2]}" for number in range(24)], ""),
    "hexadecimal in order": ([f"f{0xA0 + number:x}" for number in range(16)], ""),
    "whole seconds too": ([f"{number / 4:g}" for number in range(24)], ""),
    "behind a word": ([f"frame_{number / 25!r}_l" for number in range(24)], ""),
    "minutes": ([f"12-{n // 12}-{n % 12 * 5 + 0.25 * (n % 2):g}" for n in range(24)], ""),
    "jitter": ([f"{number / 30 + 0.002 * (number % 3):.4g}" for number in range(24)], ""),
    "sec.nsec": ([f"{each // 10**9}.{each % 10**9}" for each in nanoseconds(24)], ""),
    "sec.nsec over seconds": ([f"{each // 10**9}.{each % 10**9}" for each in nanoseconds(24, 2.7e8)], ""),
    "sec.msec": ([f"17.{33 * number}" for number in range(24)], ""),
    "times of one day": ([f"{n // 2:02}{n % 2 * 30:02}00" for n in range(24)], ""),
    "a number of numbers": ([f"case1.{number}" for number in range(24)], ""),
    **{form: (day(form), "midnight")
       for form in ("{:02}{:02}{:02}", "{:02}-{:02}-{:02}.5", "cam_{:02}_{:02}_{:02}_l")},
    # Two halves of a second apart, or seven of something.
    "1.5 and 1.12": (["1.5", "1.12"], "may be whole numbers or fractions"),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_names_give_the_order(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    names, said = NAMES[name]
    assert numbers(played(eyes(tmp_path, names))) == list(range(len(names)))
    assert said in caplog.text and bool(said) == bool(caplog.text)


@pytest.mark.fault("file: images are named by negative or hexadecimal numbers, or two by one")
@pytest.mark.parametrize(
    ("names", "said"),
    [
        ([f"f_{number - 6}" for number in range(12)], "numbers in names have signs; count from 0 up"),
        ([f"t{number - 6:+03}" for number in range(12)], "numbers in names have signs"),
        ([f"f{number:02x}_l" for number in range(24)], "f17_l.png seem to be hexadecimal; use decimal"),
        ([f"0x{number:X}" for number in range(24)], "seem to be hexadecimal"),
        (["f1", "f01", "f2"], "f0?1.png and f0?1.png have one name or number; leave one of them"),
    ],
)
def test_names_that_tell_no_order_are_refused(names: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"left: .*{said}"):
        open_source(eyes(tmp_path, names))


@pytest.mark.fault("file: a folder holds each image as two kinds of file")
def test_a_copy_of_an_image_is_not_the_next_one(tmp_path: Path) -> None:
    config = eyes(tmp_path, ["0", "1"])
    write_png(tmp_path / "right/1.tif", picture(1, 1))
    with pytest.raises(UsageError, match=r"right: 1.\w+ and 1.\w+ have one name or number"):
        open_source(config)


@pytest.mark.parametrize("form", ["{0}000000", "t{0}000_x", "{0}", "{1}.{2:03}", "2023112710{3:04}"])
def test_names_that_are_times_are_the_times(form: str, tmp_path: Path) -> None:
    """20 Hz, with a pause of a second behind the tenth image; a date is no time since 1970."""
    ms = [1_700_000_000_000 + 50 * n + 1000 * (n > 9) for n in range(24)]
    config = eyes(tmp_path, [form.format(t, t // 1000, t % 1000, n) for n, t in enumerate(ms)])
    with open_source(config.model_copy(update={"rate": None})) as source:
        stamps, rate = [frame.t_capture_ns for frame in source], source.rate
        said = [each.what + each.fix for each in source.pairs.findings]
    if form.startswith("2023"):
        assert rate == 30
        return
    assert rate == 20 and stamps == [each * 10**6 for each in ms]
    assert len(said) == 1 and "1 gaps in the numbers" in said[0] and "played by these times" in said[0]


PARTNERS = {
    "one missing each": [f"{'-' if n == 6 else '+' if n == 18 else ''}{n:03}" for n in range(24)],
    "times": [f"{'-' if n in (0, 6) else ''}{n / 30:.4g}" for n in range(24)],
    "many of one": [f"{'+' if 4 <= n < 12 else ''}{n:03}" for n in range(24)],
}


@pytest.mark.fault("file: images of both eyes were deleted before it is played")
@pytest.mark.parametrize("name", PARTNERS)
def test_partners_are_found_by_name(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    names = PARTNERS[name]
    config = eyes(tmp_path, names)
    alone = [number for number, one in enumerate(names) if one[0] in "-+"]
    assert numbers(played(config)) == [number for number in range(24) if number not in alone]
    assert f"{len(alone)} images of" in caplog.text and "have no partner of their name" in caplog.text
    poses = tmp_path / "poses.npz"
    np.savez(poses, T_world_cam=np.tile(np.eye(4), (24, 1, 1)))
    with pytest.raises(UsageError, match="go by number, so every image needs its partners"):
        open_source(config.model_copy(update={"poses": poses}))


def test_eyes_of_other_names_are_paired_in_order(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """An image that is missing on both sides is a gap."""
    config = eyes(tmp_path, [f"{n:03}" for n in range(24)], [f"{n + 7:05}" for n in range(24)])
    assert numbers(played(config)) == list(range(24)) and caplog.text == ""
    sorted(config.left.iterdir())[5].unlink()
    sorted(config.right.iterdir())[15].unlink()
    frames = played(config)
    assert number_of(frames[5].left) == 6 and number_of(frames[5].right) == 5
    assert "is paired with" in caplog.text and "is an image missing?" in caplog.text


def own_times(folder: Path, late: Callable[[int], int]) -> cfg.FoldersSource:
    """The right eye's stamps are later by so many ns, by their place."""
    lefts = nanoseconds(24)
    rights = [str(stamp + late(place)) for place, stamp in enumerate(lefts)]
    return eyes(folder, [str(stamp) for stamp in lefts], rights).model_copy(update={"rate": None})


def skews(frames: list[StereoFrame]) -> set[int]:
    return {frame.t_capture_right_ns - frame.t_capture_ns for frame in frames}


@pytest.mark.fault("file: images of two cameras, named by their own times, are missing")
def test_eyes_are_paired_by_times_of_their_own(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Stamps jitter; the right eye begins two images later, and each lost one; then its clock is wrong."""
    config = own_times(tmp_path, lambda place: 6_000_000 + 300_000 * (place % 4))
    assert skews(played(config)) == {6_000_000 + 300_000 * step for step in range(4)}
    (found,) = Replay(config).pairs.findings
    assert "right images were taken 6.4 ms after the left ones" in found.what
    rights = sorted(config.right.iterdir())
    for file in (*rights[:2], rights[15], sorted(config.left.iterdir())[7]):
        file.unlink()
    frames = played(config)
    assert numbers(frames) == [number for number in range(24) if number not in (0, 1, 7, 15)]
    assert "4 images of" in caplog.text and "have no partner at their time" in caplog.text
    assert skews(played(own_times(tmp_path / "late", lambda place: 3_600_000_000_000))) == {0}
    assert "begins 3.6e+03 s from" in caplog.text and "paired by order" in caplog.text


def test_eyes_of_other_depths_are_refused(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    config = eyes(tmp_path, [f"{number:02}" for number in range(12)])
    for number, file in enumerate(sorted(config.left.iterdir())):
        cv2.imwrite(str(file), picture(number).astype(np.uint16) * 257)
    with pytest.raises(SagsError, match="holds uint8, others uint16; save all images alike"):
        open_source(config)
    assert caplog.text == ""
