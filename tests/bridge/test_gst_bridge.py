"""The overlay on GStreamer's side: every pixel of both eyes, and nothing old."""

import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
import pytest
from gstreamer import need_gstreamer
from waiting import beside, repeating, until

from sags_node.clients.bridge.gst import GstOptions, run_gst
from sags_node.clients.overlay.draw import color_key
from sags_node.clients.overlay.stream import OverlayStream
from sags_node.errors import SagsError
from sags_node.messaging.address import NodeAddress

pytestmark = pytest.mark.live

HEIGHT, WIDTH, KEY = 48, 70, (10, 200, 30)


def overlay_of(eye: int) -> np.ndarray:
    """Every value and every opacity, and otherwise nothing."""
    rgba = np.random.default_rng(eye).integers(0, 256, (HEIGHT, WIDTH, 4), np.uint8)
    rgba[: HEIGHT // 2] = 0
    return rgba


def bgrx(rgb: np.ndarray) -> np.ndarray:
    return np.concatenate([rgb[..., ::-1], np.full((*rgb.shape[:2], 1), 255, np.uint8)], axis=2)


def drawing(stream: OverlayStream, paused: threading.Event) -> AbstractContextManager[None]:
    """An overlay's thread; while `paused` it says nothing, as one that hangs."""

    def draw(number: int) -> None:
        time.sleep(1 / 30)
        if not paused.is_set():
            stream.serve()
            pictures = {eye: overlay_of(n) for n, eye in enumerate(("left", "right"))}
            stream.show(pictures, number, time.time_ns(), 0)
            stream.tell({})

    return repeating(draw)


@contextmanager
def displays(run_dir: Path, **launches: str) -> Iterator[None]:
    options, stop = GstOptions(NodeAddress("overlay", run_dir=run_dir), **launches), threading.Event()
    with beside(lambda: run_gst(options, lambda: None, stop), stop.set):
        yield


def shown(file: Path) -> np.ndarray:
    """All whole images that the pipeline has put out."""
    data = np.fromfile(file, np.uint8) if file.exists() else np.empty(0, np.uint8)
    size = HEIGHT * WIDTH * 4
    return data[: len(data) // size * size].reshape(-1, HEIGHT, WIDTH, 4)


def test_both_eyes_come_to_the_pixel_and_what_is_old_becomes_the_key(tmp_path: Path) -> None:
    need_gstreamer()
    files = {eye: tmp_path / eye for eye in ("left", "right")}
    launches = {eye: f"filesink buffer-mode=unbuffered location={file}" for eye, file in files.items()}
    expected = [bgrx(color_key(overlay_of(n), KEY)) for n in range(2)]
    nothing = bgrx(np.broadcast_to(np.array(KEY, np.uint8), (HEIGHT, WIDTH, 3)))
    paused = threading.Event()
    with displays(tmp_path, **launches), OverlayStream("overlay", tmp_path, KEY) as stream:
        with drawing(stream, paused):
            for eye, file in files.items():
                picture = expected[eye == "right"]
                until(lambda f=file, p=picture: len(shown(f)) and np.array_equal(shown(f)[-1], p))  # type: ignore[misc]
            paused.set()
            for file in files.values():
                until(lambda f=file: np.array_equal(shown(f)[-1], nothing))  # type: ignore[misc]
            paused.clear()
            until(lambda: np.array_equal(shown(files["left"])[-1], expected[0]))
        until(lambda: np.array_equal(shown(files["left"])[-1], nothing))  # the overlay is gone
        count = len(shown(files["left"]))
        until(lambda: len(shown(files["left"])) > count + 5)  # and the display gets images still
    for n, file in enumerate(files.values()):
        for picture in shown(file):
            assert np.array_equal(picture, expected[n]) or np.array_equal(picture, nothing), (
                "whole, or nothing"
            )


def test_a_wrong_pipeline_is_said_in_words(tmp_path: Path) -> None:
    need_gstreamer()
    options = GstOptions(NodeAddress("overlay", run_dir=tmp_path), left="nosuchsink")
    stop = threading.Event()
    threading.Timer(60, stop.set).start()
    with OverlayStream("overlay", tmp_path, KEY) as stream, drawing(stream, threading.Event()):
        with pytest.raises(SagsError, match='no element "nosuchsink"'):
            run_gst(options, lambda: None, stop)
    assert not stop.is_set()
