"""Stereo recordings of every kind whose images tell their frame number and their eye."""

from pathlib import Path

import cv2
import numpy as np

from sags_node.config import schema as cfg
from sags_node.sources.replay import Recording
from sags_node.types import U8, StereoFrame

WIDTH, HEIGHT = 32, 24


def picture(number: int, eye: int = 0) -> U8:
    """An RGB image that tells its frame number (red) and its eye (blue)."""
    return np.full((HEIGHT, WIDTH, 3), (10 * number, 100, 200 * eye), np.uint8)


def number_of(rgb: U8) -> int:
    return round(float(rgb[..., 0].mean()) / 10)


def eye_of(rgb: U8) -> int:
    return int(rgb[..., 2].mean() > 100)


def write_png(file: Path, shown: np.ndarray) -> None:
    """RGB [H, W, 3], or grey [H, W]."""
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), shown[..., ::-1] if shown.ndim == 3 else shown)


def write_video(file: Path, pictures: list[U8], rate: float = 25.0, codec: str = "MJPG") -> Path:
    """Lossy, as capture boxes write it."""
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*codec), rate, (width, height))
    assert writer.isOpened()
    for rgb in pictures:
        writer.write(np.ascontiguousarray(rgb[..., ::-1]))
    writer.release()
    return file


def numbers(frames: list[StereoFrame]) -> list[int]:
    """Frame numbers as the images show them; both eyes must show the same one."""
    for frame in frames:
        assert (eye_of(frame.left), eye_of(frame.right)) == (0, 1)
        assert number_of(frame.left) == number_of(frame.right)
    return [number_of(frame.left) for frame in frames]


def recordings(tmp_path: Path) -> dict[str, Recording]:
    """The same eight frames in every kind of file."""
    pairs = [(picture(n), picture(n, eye=1)) for n in range(8)]
    green = np.zeros_like(pairs[0][0])
    for n, (left, right) in enumerate(pairs):
        write_png(tmp_path / f"l/{n:03d}.png", left)
        write_png(tmp_path / f"r/{n:03d}.png", right)
    left_file = write_video(tmp_path / "l.avi", [pair[0] for pair in pairs])
    right_file = write_video(tmp_path / "r.avi", [pair[1] for pair in pairs])
    lr = write_video(tmp_path / "lr.avi", [np.hstack(pair) for pair in pairs])
    rl = write_video(tmp_path / "rl.avi", [np.hstack(pair[::-1]) for pair in pairs])
    over = write_video(tmp_path / "over.avi", [np.vstack(pair[::-1]) for pair in pairs])
    turns = write_video(tmp_path / "turns.avi", [eye for pair in pairs for eye in pair], 50.0)
    wide = [
        write_video(tmp_path / f"wide_{eye}.avi", [np.hstack([green, pair[eye]]) for pair in pairs])
        for eye in (0, 1)
    ]
    panes = write_video(
        tmp_path / "panes.avi", [np.vstack([np.hstack(p), np.hstack([green] * 2)]) for p in pairs]
    )
    below = cfg.GeometryConfig(layout="over_under", first="right")
    in_turn = cfg.GeometryConfig(layout="frame_sequential")
    half = cfg.GeometryConfig(crop=(WIDTH, 0, WIDTH, HEIGHT))
    halves = cfg.GeometryConfig(layout="side_by_side")
    turned = cfg.GeometryConfig(layout="side_by_side", first="right")
    boxes = cfg.GeometryConfig(
        layout="panes", crop=(0, 0, WIDTH, HEIGHT), crop_right=(WIDTH, 0, WIDTH, HEIGHT)
    )
    return {
        "folders": cfg.FoldersSource(left=tmp_path / "l", right=tmp_path / "r", pace="step", rate=25),
        "videos": cfg.VideosSource(left=left_file, right=right_file, pace="step"),
        "LR": cfg.VideosSource(left=lr, geometry=halves, pace="step"),
        "RL": cfg.VideosSource(left=rl, geometry=turned, pace="step"),
        "over under": cfg.VideosSource(left=over, geometry=below, pace="step"),
        "in turn": cfg.VideosSource(left=turns, geometry=in_turn, pace="step"),
        "cropped": cfg.VideosSource(left=wide[0], right=wide[1], geometry=half, pace="step"),
        "panes": cfg.VideosSource(left=panes, geometry=boxes, pace="step"),
    }
