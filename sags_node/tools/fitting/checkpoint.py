"""A fit on disk: everything it needs to go on as if it had not been interrupted."""

import json
import os
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import cv2
import numpy as np

from sags_node.errors import SagsError, UsageError
from sags_node.files import whole
from sags_node.tools.fitting.clip import Clip
from sags_node.tools.fitting.fit import Fit
from sags_node.types import F32, F64, U8

VERSION = 7
CELLS = 8  # across and down: the mean colours of these cells tell one recording from another
# What identifies a clip, see `_known`, and the mean difference up to which a frame counts as the same:
# decoders and processors round differently.
SAME: dict[str, tuple[str, float]] = {
    "clip.looks": ("images", 4.0),  # levels of 255
    "clip.times": ("times", 1e-4),  # s
    "clip.K": ("camera matrix", 1e-2),  # px
    "clip.poses": ("camera poses", 1e-5),  # m, and parts of a rotation matrix
    "clip.tissue": ("tissue masks", 2e-3),  # share of the image
    "clip.depth": ("depth", 1e-2),  # share of it
}


def save(fit: Fit, path: Path) -> None:
    """Write a checkpoint. It replaces an older file only once it is complete.

    Raises:
        SagsError: it cannot be written.
    """
    about = {
        "version": VERSION,
        "settings": asdict(fit.settings),
        "frames": [frame.frame_id for frame in fit.clip.train],
        "progress": fit.state(),
    }
    with whole(path) as partial, partial.open("wb") as file:
        arrays: dict[str, Any] = {**_known(fit.clip), **fit.arrays()}
        np.savez(file, about=np.array(json.dumps(about)), **arrays)
        file.flush()
        os.fsync(file.fileno())


def load(fit: Fit, path: Path) -> None:
    """Restore a fit from a checkpoint. `fit` must have the same clip and settings, and not be started yet.

    Raises:
        SagsError: the file cannot be read or is damaged.
        UsageError: it belongs to other settings or another clip, or to one that was read in another way.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(str(arrays.pop("about")))
        version, settings = about["version"], about["settings"]
        frames, progress = about["frames"], about["progress"]
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile) as error:
        raise SagsError(f"cannot resume from {path}: {error}; start without --resume") from None
    if version != VERSION:
        raise UsageError(f"{path} was made by another version of this software; start without --resume")
    if frames != [frame.frame_id for frame in fit.clip.train]:
        raise UsageError(f"{path} belongs to other training frames; start without --resume")
    try:
        others = []
        for name, known in _known(fit.clip).items():
            what, most = SAME[name]
            apart = np.abs(known - arrays.pop(name)).reshape(len(frames), -1).mean(axis=1) > most
            if apart.any():
                first = frames[int(np.argmax(apart))]
                others.append(f"{what} ({np.count_nonzero(apart)} of {len(apart)}, first in frame {first})")
        if others:
            raise UsageError(
                f"{path} was fitted to other {', other '.join(others)}; give the recording, calibration and "
                "overrides of that fit, or fit anew without --resume"
            )
        mine = json.loads(json.dumps(asdict(fit.settings)))  # some of them follow from the clip
        others = [key for key in mine if settings.get(key) != mine[key]]
        if others:
            raise UsageError(
                f"{path} was made with other settings ({', '.join(others)}); "
                "give the same, or start without --resume"
            )
        fit.restore(progress, arrays)
    except (KeyError, ValueError, TypeError) as error:
        raise SagsError(f"{path} is damaged ({error}); start without --resume") from None


def _known(clip: Clip) -> dict[str, F32 | F64]:
    """What identifies the training frames, by the keys of `SAME`, [F, ...] each: mean colour and share of
    tissue of each cell; seconds since the first frame; camera; logarithm of the median depth in m."""
    frames = clip.train

    def small(planes: Iterable[U8 | F32]) -> F32:
        cells = [cv2.resize(plane, (CELLS, CELLS), interpolation=cv2.INTER_AREA) for plane in planes]
        return np.array(cells, np.float32)

    depths = [frame.depth[::4, ::4] for frame in frames]  # enough for a median
    medians = [float(np.median(depth[depth > 0])) if depth.any() else 1.0 for depth in depths]
    return {
        "clip.looks": small(frame.image for frame in frames),
        "clip.times": np.array([frame.t_capture_ns - frames[0].t_capture_ns for frame in frames]) * 1e-9,
        "clip.K": np.array([frame.camera.K for frame in frames]),
        "clip.poses": np.array([frame.camera.T_world_cam for frame in frames]),
        "clip.tissue": small(frame.tissue.astype(np.float32) for frame in frames),
        "clip.depth": np.log(medians),
    }
