"""Files that claim too much, are no files, or make a C library talk: one message of ours, nothing else."""

import os
import socket
import struct
import threading
import zlib
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numbered_pictures import HEIGHT, WIDTH, picture, recordings

from sags_node.bags.pictures import decode_file
from sags_node.clients.overlay.save import Output
from sags_node.config import schema as cfg
from sags_node.errors import SagsError, UsageError
from sags_node.media import picture_file
from sags_node.media.picture_file import claimed_size, is_whole, native_output
from sags_node.sources.numbered import open_numbered
from sags_node.sources.pictures import read_picture
from sags_node.sources.source import open_source

PIXELS = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
ROWS = b"".join(b"\0" + row.tobytes() for row in PIXELS)


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int = WIDTH, height: int = HEIGHT, data: bytes | None = None, extra: bytes = b"") -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(ROWS) if data is None else data)
    return b"\x89PNG\r\n\x1a\n" + header + extra + body + chunk(b"IEND", b"")


def flipped(file: bytes, at: int) -> bytes:
    return file[:at] + bytes([file[at] ^ 255]) + file[at + 1 :]


def jpeg(width: int = WIDTH, height: int = HEIGHT) -> bytes:
    file = bytearray(cv2.imencode(".jpg", PIXELS)[1].tobytes())
    frame = file.find(b"\xff\xc0")
    file[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    return bytes(file)


BAD = {
    "huge.png": (png(60_000, 60_000), "says that it is 60000x60000 px; at most 64 Mpx are read"),
    "large.png": (png(30_000, 30_000), "says that it is 30000x30000 px"),
    "flat.png": (png(0, 10), "or is damaged"),
    "huge.jpg": (jpeg(60_000, 60_000), "says that it is 60000x60000 px"),
    "short.png": (png(data=zlib.compress(ROWS[:500])), "libpng error: Not enough image data"),
    "garbage.png": (png(data=b"garbage" * 30), "libpng error: IDAT: incorrect header check"),
    "flipped.png": (flipped(png(), 80), "libpng error: "),
    "headless.jpg": (
        b"\xff\xd8\xff\xd9",
        "is no JPEG, PNG, TIFF, BMP, WebP or binary PGM/PPM, or is damaged (",
    ),
}


@pytest.mark.fault("file: an image is damaged or claims to be huge")
@pytest.mark.parametrize("name", BAD)
def test_a_bad_picture_is_one_message_that_names_it(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    content, said = BAD[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SagsError) as caught:
        read_picture(tmp_path / name)
    assert str(caught.value).startswith(f"image {tmp_path / name} ") and said in str(caught.value)
    assert str(caught.value).endswith("replace or remove the pair")
    with pytest.raises(SagsError, match="bag: a compressed image"):
        decode_file(np.frombuffer(content, np.uint8), "bag")
    assert capfd.readouterr() == ("", "")


def test_what_a_decoder_says_of_a_picture_that_it_can_read_is_logged_once(
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(picture_file, "complaints", picture_file.Complaints())
    for name, content in (
        ("1.png", png(extra=chunk(b"iCCP", b"x\0\0garbage"))),
        ("2.png", png(extra=chunk(b"iCCP", b"y\0\0garbage"))),
        ("3.jpg", jpeg()[:-2] + b"padding\xff\xd9"),
    ):
        (tmp_path / name).write_bytes(content)
        assert read_picture(tmp_path / name).shape == PIXELS.shape
    assert "1.png: libpng warning: iCCP" in caplog.text and "2.png" not in caplog.text
    assert "3.jpg: Corrupt JPEG data: " in caplog.text
    assert capfd.readouterr() == ("", "")


KINDS = {".png": [], ".jpg": [], ".tiff": [], ".bmp": [], ".ppm": [], ".webp": [cv2.IMWRITE_WEBP_QUALITY, 90]}


@pytest.mark.parametrize("suffix", KINDS)
@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (1, 700), (1031, 3)])
def test_sizes_are_read_as_opencv_reads_them(suffix: str, size: tuple[int, int]) -> None:
    file = cv2.imencode(suffix, np.zeros((size[1], size[0], 3), np.uint8))[1]
    assert claimed_size(file.data) == size
    for length in range(60):
        claimed_size(file.data[:length])  # no exception


@pytest.mark.parametrize("suffix", KINDS)
def test_all_kinds_of_pictures_are_read_and_cut_off_ones_are_refused(suffix: str, tmp_path: Path) -> None:
    """Also through a link. Drawn smooth, so that lossy kinds keep it; lossless WebP has its own header."""
    smooth = cv2.resize(PIXELS[:4, :5], (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    for options in (KINDS[suffix], [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else []):
        content = cv2.imencode(suffix, smooth, options)[1].tobytes()
        assert claimed_size(memoryview(content)) == (WIDTH, HEIGHT) and is_whole(memoryview(content))
        file = tmp_path / f"one{suffix}"
        file.write_bytes(content)
        link = tmp_path / f"link{suffix}"
        link.unlink(missing_ok=True)
        link.symlink_to(file)
        assert np.abs(read_picture(link)[..., ::-1].astype(int) - smooth).mean() < 8  # of 255
        file.write_bytes(content[: len(content) * 2 // 3])
        with pytest.raises(SagsError, match="damaged or cut off"):
            read_picture(file)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("behind", [b"\0" * 6000, b"\xff" * 700, b"grabber 3.2\n" * 90, PIXELS.tobytes() * 3])
def test_bytes_behind_the_end_of_a_picture_harm_nothing(suffix: str, behind: bytes, tmp_path: Path) -> None:
    """Drivers hand over whole buffers; a preview in front has an end of its own."""
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2] if suffix == ".jpg" else []
    whole = cv2.imencode(suffix, PIXELS, options)[1].tobytes()
    if suffix == ".jpg":
        preview = jpeg(16, 8)
        before = b"\xff\xe1" + struct.pack(">H", len(preview) + 2) + preview
        before += 3 * (b"\xff\xe2" + struct.pack(">H", 65535) + bytes(65533))  # a long profile
        whole = whole[:2] + before + whole[2:]
    assert claimed_size(memoryview(whole)) == (WIDTH, HEIGHT)
    file = tmp_path / f"one{suffix}"
    file.write_bytes(whole)
    alone = read_picture(file)
    file.write_bytes(whole + behind)
    assert np.array_equal(read_picture(file), alone)
    file.write_bytes(whole[: len(whole) * 2 // 3] + behind)
    with pytest.raises(SagsError, match="damaged or cut off"):
        read_picture(file)


def test_gray_pictures_of_sixteen_bit_in_every_kind_that_has_them(tmp_path: Path) -> None:
    depth = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 7
    for suffix in (".png", ".tiff", ".pgm"):
        cv2.imwrite(str(tmp_path / f"depth{suffix}"), depth)
        assert np.array_equal(read_picture(tmp_path / f"depth{suffix}", cv2.IMREAD_UNCHANGED), depth)
    commented = b"P5 # made by hand\n# twice\n3 2\n255\n" + bytes(range(6))
    assert claimed_size(memoryview(commented)) == (3, 2) and is_whole(memoryview(commented))
    assert not is_whole(memoryview(commented[:-1]))


# ---- what is no file -------------------------------------------------------------------------------------


def bound_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(os.path.relpath(path))


NO_FILES: dict[str, Callable[[Path], None]] = {
    "pipe": os.mkfifo,
    "socket": bound_socket,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
}


@pytest.mark.fault("file: a pipe, socket, device or folder in its place")
@pytest.mark.parametrize("kind", NO_FILES)
def test_what_is_no_file_is_not_waited_for(kind: str, tmp_path: Path) -> None:
    recordings(tmp_path)
    (tmp_path / "numbered").mkdir()
    picture, poses, numbered = (tmp_path / name for name in ("r/000a.png", "poses.npz", "numbered/0.json"))
    for file in (picture, poses, numbered):
        NO_FILES[kind](file)
    folders = {"left": tmp_path / "l", "right": tmp_path / "r"}
    with pytest.raises(UsageError, match=r"r/000a\.png has an image's name but is no file; remove it"):
        open_source(cfg.FoldersSource(**folders))
    with pytest.raises(SagsError, match=r"cannot read image .*000a\.png: it is a"):
        read_picture(picture)
    picture.rename(tmp_path / "aside")
    with pytest.raises(UsageError, match=r"poses\.npz is not a readable npz file: .*it is a"):
        open_source(cfg.FoldersSource(**folders, poses=poses))
    with pytest.raises(SagsError, match=r"0\.json: it is a"):
        open_numbered(numbered.parent, ".json", 100).read(0)


# ---- libraries that talk ---------------------------------------------------------------------------------


def test_a_video_that_cannot_be_written_is_one_message(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    output = Output(tmp_path / "video.mp4")
    for number in range(3):  # the overlay goes on
        output.add(np.zeros((64, 20000, 3), np.uint8), True, number)
    with pytest.raises(SagsError, match=r"video\.mp4: 20000x64 px cannot be encoded"):
        output.close()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("steps", "shown"),
    [
        ([0.0333711] * 8, [0.0333711] * 8),
        ([0.02, 0.05, 4.0, 0.033], [0.02, 0.05, 4.0, 0.033]),  # late images, a pause
        ([0.04, -9.0, 0.04, 7200.0, 0.04], [0.04, 1 / 30, 0.04, 1 / 30, 0.04]),  # other recordings
        ([0.0, 1e-9, 0.04], [1 / 30, 1e-9, 0.04]),
    ],
)
def test_a_video_shows_each_picture_for_as_long_as_its_stamps_say(
    steps: list[float], shown: list[float], tmp_path: Path
) -> None:
    output = Output(tmp_path / "video.mp4")
    for number, at in enumerate(np.cumsum([5e9, *np.array(steps) * 1e9])):
        output.add(np.ascontiguousarray(picture(number)), True, round(at))
    output.close()
    with av.open(str(tmp_path / "video.mp4")) as video:
        assert video.streams.video[0].codec_context.name == "h264"
        times = [float(frame.pts * frame.time_base) for frame in video.decode(video=0)]
    np.testing.assert_allclose(np.diff(times), shown, atol=2.1 / 90_000)


@pytest.mark.parametrize("name", ["look.png", "look.mp4"])
def test_a_picture_that_cannot_be_saved_for_none_came_is_told_of(
    name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    Output(tmp_path / name).close()
    assert "is not written: no image came" in caplog.text
    assert not (tmp_path / name).exists()
    Output(None).close()
    assert len(caplog.records) == 1


def test_what_others_say_meanwhile_is_not_lost(capfd: pytest.CaptureFixture[str]) -> None:
    with native_output() as said:
        os.write(2, b"libpng warning: one\n[ WARN:0@1.5] global x.cpp:3 two\n\n")
        os.write(2, b"mine\n")
        thread = threading.Thread(target=lambda: os.write(2, b"and theirs: libpng\n"))
        thread.start()
        thread.join()
    assert said == ["libpng warning: one", "[ WARN:0@1.5] global x.cpp:3 two"]
    assert capfd.readouterr().err == "mine\nand theirs: libpng\n"
    with pytest.raises(ZeroDivisionError), native_output():
        _ = 1 / 0
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"
