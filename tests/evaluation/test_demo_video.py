"""The demo's video: what the overlay kept of each frame, and the image that a display showed."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from av.video.reformatter import Colorspace
from small_disk import small_disk

from sags_node.clients.bridge.h264 import Encoder
from sags_node.clients.overlay.draw import over
from sags_node.clients.overlay.save import Layers, read_layers
from sags_node.errors import SagsError
from sags_node.media.video import Video
from sags_node.media.video_file import VideoFile
from sags_node.tools.demo import Shown
from sags_node.types import U8

RATE, HEIGHT, WIDTH = 30.0, 64, 81


def drawn(rng: np.random.Generator) -> U8:
    rgba = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    rgba[10:30, 20:51] = rng.integers(0, 256, (20, 31, 4))
    rgba[15, 21, 3] = 0  # a hole
    return rgba


def test_a_display_shows_what_was_drawn_and_for_a_missed_frame_what_was_there_before(tmp_path: Path) -> None:
    """Layers leave out what is empty; over the image nothing is different for it."""
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 256, (4, HEIGHT, WIDTH, 3), np.uint8)
    rgba = drawn(rng)
    layers = Layers(tmp_path / "layers")
    layers.add(1, rgba)
    layers.add(3, None)
    layers.close()
    assert (tmp_path / "layers").stat().st_size < rgba.nbytes / 4
    kept: list[U8] = []
    into: Any = SimpleNamespace(add=lambda picture: kept.append(picture.copy()))
    shown = Shown(into, read_layers(tmp_path / "layers"))
    for frame_id, picture in enumerate(pictures):
        shown.add(frame_id, picture)
    with_it = over(pictures[1], rgba)
    assert (with_it != pictures[1]).any()
    for got, expected in zip(kept, (pictures[0], with_it, with_it, pictures[3]), strict=True):
        np.testing.assert_array_equal(got, expected)


def test_an_overlay_that_was_killed_leaves_what_it_had_written(tmp_path: Path) -> None:
    file, rgba = tmp_path / "layers", drawn(np.random.default_rng(0))
    layers = Layers(file)
    for frame_id in (4, 5):
        layers.add(frame_id, rgba)
    layers.close()
    whole = file.read_bytes()
    for length in range(len(whole) // 2, len(whole), 101):
        file.write_bytes(whole[:length])
        assert set(read_layers(file)) == {4}


@pytest.mark.parametrize(
    ("pause", "length", "said"), [(59, 60, ""), (90, 2, "pause of 90 s is left out at 1.0 s")]
)
def test_a_long_pause_is_left_out_and_said(
    pause: int, length: int, said: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = VideoFile(tmp_path / "video.mp4", 1, (WIDTH, HEIGHT))
    for second in (0, 1, 1 + pause):
        file.add(np.zeros((HEIGHT, WIDTH, 3), np.uint8), 10**9 * second)
    file.finish()
    stamps = Video(tmp_path / "video.mp4").stamps
    assert stamps is not None and stamps[-1] - stamps[0] == 10**9 * length
    assert said in caplog.text and ("pause" in caplog.text) == bool(said)


def test_a_full_disk_ends_the_layers_and_not_the_overlay(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 1 << 20) as disk:
        layers = Layers(disk / "layers")
        for frame_id in range(6):
            layers.add(frame_id, np.full((300, 300, 4), 255, np.uint8))
        with pytest.raises(SagsError, match=r"cannot write .*layers: No space left"):
            layers.close()
        assert [*read_layers(disk / "layers")] == [0, 1]


def test_a_picture_of_another_size_is_shown_whole(tmp_path: Path) -> None:
    """As after a restart of the node with another size."""
    file, halves = VideoFile(tmp_path / "video.mp4", RATE, (64, 48)), np.repeat([200, 20], 48)
    file.add(np.zeros((48, 64, 3), np.uint8))
    file.add(np.broadcast_to(halves[:, None, None], (96, 128, 3)).astype(np.uint8))
    file.finish()
    with av.open(str(tmp_path / "video.mp4")) as video:
        *_, last = (frame.to_ndarray(format="rgb24") for frame in video.decode(video=0))
    assert last.shape == (48, 64, 3)
    np.testing.assert_allclose(last[[8, 40]].mean((1, 2)), (200, 20), atol=4)


def test_its_file_is_what_browsers_play(tmp_path: Path) -> None:
    """H.264 in yuv420p, whose sides are even; its index stands first."""
    file = VideoFile(tmp_path / "video.mp4", RATE, (WIDTH, HEIGHT))
    for level in range(0, 200, 10):
        file.add(np.full((HEIGHT, WIDTH, 3), level, np.uint8))
    file.finish()
    with av.open(str(tmp_path / "video.mp4")) as video:
        stream = video.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height, stream.average_rate) == (WIDTH - 1, HEIGHT, RATE)
        levels = [frame.to_ndarray(format="rgb24").mean() for frame in video.decode(video=0)]
    np.testing.assert_allclose(levels, range(0, 200, 10), atol=4)
    data = (tmp_path / "video.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


@pytest.mark.parametrize("size", [(640, 512), (1280, 720)])
def test_it_says_how_its_colours_are_coded(tmp_path: Path, size: tuple[int, int]) -> None:
    """Players take HD that says nothing for BT.709; we write BT.601, and red would be 12 of 255 brighter."""
    red = np.array([200, 60, 40], np.uint8)
    file = VideoFile(tmp_path / "video.mp4", RATE, size)
    file.add(np.full((size[1], size[0], 3), red, np.uint8))
    file.finish()
    shown = Video(tmp_path / "video.mp4").read(0)
    assert shown is not None
    np.testing.assert_allclose(shown[::9, ::9], np.broadcast_to(red, shown[::9, ::9].shape), atol=2)
    (coded,) = av.CodecContext.create("h264", "r").decode(
        av.Packet(Encoder().encode(np.full((size[1], size[0], 3), red, np.uint8)))
    )
    assert coded.colorspace == Colorspace.ITU601
