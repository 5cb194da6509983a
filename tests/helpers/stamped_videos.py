"""Videos written packet by packet: any stamps, containers, codecs, tags; each image tells its number."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from sags_node.types import U8

WIDTH, HEIGHT = 128, 96
BITS = 8
TICKS = 90_000  # a second: no stamp of a usual rate is rounded


def numbered(number: int, size: tuple[int, int] = (WIDTH, HEIGHT), eye: int = 0) -> U8:
    """RGB, with eight bars that are bright where a bit of the number is set; of the right eye with a rim."""
    picture = np.full((size[1], size[0], 3), 40, np.uint8)
    for bit in range(BITS):
        x = bit * size[0] // BITS
        picture[:, x : x + size[0] // BITS] = 210 if number >> bit & 1 else 40
    picture[: eye * size[1] // 4] = 120
    return picture


def number_in(picture: U8) -> int:
    bars = np.array_split(picture[..., 1].mean(axis=0), BITS)
    return sum(1 << bit for bit, bar in enumerate(bars) if bar[2:-2].mean() > 125)


def write(
    file: Path,
    pictures: Iterable[U8],
    seconds: Sequence[float] | None = None,
    *,
    rate: Fraction | int = 30,
    codec: str = "libx264",
    format: str | None = None,
    pixels: str = "yuv420p",
    options: dict[str, str] | None = None,
    muxer: dict[str, str] | None = None,
    aspect: Fraction | None = None,
    matrix: int | None = None,
    told: tuple[int, int] | None = None,
    ticks: int = TICKS,
    turned: tuple[int, bool] = (0, False),
) -> Path:
    """A video of one stream.

    Args:
        seconds: when each image is shown; default: at the rate.
        matrix: ITU code by which RGB becomes YUV; default: FFmpeg's, BT.601.
        ticks: of which stamps are multiples, 1/s.
        turned: how a player is to show it: by so many degrees, and mirrored.
        told: codes of matrix and range that the file is tagged with; default: none.
    """
    with av.open(str(file), "w", format=format, options=muxer or {}) as container:
        stream: Any = None
        for number, picture in enumerate(pictures):
            if stream is None:
                stream = container.add_stream(codec, rate)
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt, stream.options = pixels, options or {}
                if any(turned):
                    stream.set_display_rotation(turned[0], hflip=turned[1])
                if seconds is not None:
                    stream.codec_context.time_base = Fraction(1, ticks)
                if aspect is not None:
                    stream.codec_context.sample_aspect_ratio = aspect
                if told is not None:
                    stream.codec_context.colorspace, stream.codec_context.color_range = told
            full = told is not None and told[1] == 2
            frame = av.VideoFrame.from_ndarray(picture, "rgb24").reformat(
                format=pixels, dst_colorspace=matrix, dst_color_range=2 if full else 1
            )
            if seconds is not None:
                frame.pts, frame.time_base = round(seconds[number] * ticks), Fraction(1, ticks)
            else:
                frame.pts, frame.time_base = number, 1 / Fraction(rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return file
