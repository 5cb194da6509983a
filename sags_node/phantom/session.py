"""A phantom session on disk: images, masks, truth, calibration and the launch file that plays them."""

import hashlib
import json
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import yaml

from sags_node.config.schema import PhantomSource
from sags_node.errors import SagsError, UsageError
from sags_node.files import check_folder, whole
from sags_node.phantom.scene import Phantom, PhantomFrame, PhantomScene
from sags_node.rig import save_rig

Progress = Callable[[int, int], None]  # frames done, frames in all

VERSION = 1  # of what the generator draws: a cached session of another version is not used
RATE = 30.0  # frames per second
DEPTH_UNIT = 2.5e-6  # m per count
JPEG_QUALITY = 95
_SHAPING = (
    *("seconds", "width", "height", "seed", "camera_motion", "smoke", "noise", "blur"),
    *("still_tissue", "blackout", "gloss"),
)
_COMPLETE = "launch.yaml"  # written last


def cached_session(config: PhantomSource, progress: Progress | None = None) -> Path:
    """Return the folder of the session for `config` under `$XDG_CACHE_HOME/sags` (default `~/.cache/sags`).

    A session that is not there yet is rendered at 30 frames per second; see `write_session`.
    """
    scene = PhantomScene.of(config)
    shaping = {"version": VERSION, "rate": RATE} | {name: getattr(scene, name) for name in _SHAPING}
    digest = hashlib.sha256(json.dumps(shaping, sort_keys=True).encode()).hexdigest()[:16]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sags"
    folder = cache / f"phantom-{digest}"
    if not (folder / _COMPLETE).exists():
        try:
            write_session(config, folder, RATE, progress)
        except SagsError:
            if not (folder / _COMPLETE).exists():  # else another process finished the same session first
                raise
    return folder


def write_session(
    config: PhantomSource, folder: Path, rate: float = RATE, progress: Progress | None = None
) -> None:
    """Render `frame_count` frames and their ground truth into a new folder.

    The folder appears only when it is complete. `launch_file.load_launch(folder)` reads the result. The same
    config and rate give the same files on one machine.

    Raises:
        UsageError: the folder exists and is not empty.
        SagsError: the folder cannot be written.
    """
    folder = Path(folder)
    count = frame_count(config, rate)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} exists and is not empty; remove it or name another folder")
    check_folder(folder.parent)
    with whole(folder) as partial:
        partial.mkdir()
        _write_frames(config, partial, count, rate, progress)


def frame_count(config: PhantomSource, rate: float = RATE) -> int:
    """Return how many frames a session has."""
    return max(1, round(config.seconds * rate))


def _write_frames(
    config: PhantomSource, folder: Path, count: int, rate: float, progress: Progress | None
) -> None:
    phantom = Phantom(config)
    digits = max(4, len(str(count - 1)))  # sources sort by name
    for name in ("left", "right", "tools", "depth"):
        (folder / name).mkdir()

    def render(index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        frame = phantom.frame(index, count)
        _write_pictures(frame, folder, f"{index:0{digits}d}")
        return frame.points, frame.visible, frame.T_world_cam

    truth = []
    workers = min(4, os.cpu_count() or 1)
    with ThreadPoolExecutor(workers) as pool:
        waiting = [pool.submit(render, index) for index in range(count)]
        try:
            for done in waiting:
                truth.append(done.result())
                if progress:
                    progress(len(truth), count)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    points, visible, poses = (np.stack(part) for part in zip(*truth, strict=True))
    np.savez(folder / "tracks.npz", points=points, visible=visible)
    np.savez(folder / "poses.npz", T_world_cam=poses)
    save_rig(phantom.rig, folder / "calib")
    launch = {
        "source": {
            "kind": "folders",
            "left": "left",
            "right": "right",
            "tools": "tools",
            "poses": "poses.npz",
            "rate": rate,
            "reference": {
                "depth": "depth",
                "depth_unit": DEPTH_UNIT,
                "depth_kind": "exact",
                "tracks": "tracks.npz",
            },
        },
        "rig": "calib",
        "vision": {"width": config.width, "height": config.height},
    }
    (folder / _COMPLETE).write_text(yaml.safe_dump(launch, sort_keys=False), encoding="utf-8")


def _write_pictures(frame: PhantomFrame, folder: Path, stem: str) -> None:
    jpeg = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    counts = np.clip(np.round(frame.depth / DEPTH_UNIT), 0, 65535).astype(np.uint16)
    _write(folder / "left" / f"{stem}.jpg", frame.left[..., ::-1], jpeg)
    _write(folder / "right" / f"{stem}.jpg", frame.right[..., ::-1], jpeg)
    _write(folder / "tools" / f"{stem}.png", np.where(frame.tool, 255, 0).astype(np.uint8), [])
    _write(folder / "depth" / f"{stem}.png", counts, [cv2.IMWRITE_PNG_COMPRESSION, 1])


def _write(file: Path, picture: np.ndarray, options: list[int]) -> None:
    """Write an image, and raise on a full disk, where `cv2.imwrite` would only return False."""
    file.write_bytes(cv2.imencode(file.suffix, picture, options)[1].tobytes())
