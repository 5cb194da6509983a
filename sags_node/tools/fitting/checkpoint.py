"""A fit on disk: everything it needs to go on as if it had not been interrupted."""

from __future__ import annotations

import json
import os
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
from sags_node.types import F32

VERSION = 6
CELLS = 8  # across and down: means of so many parts of a picture tell one recording from another
SAME = 4.0  # levels of 255, a picture's mean difference: decoders and processors round in their own ways


def save(fit: Fit, path: Path) -> None:
    """Write a checkpoint; the one that stood there stays whole until the new one is.

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
        arrays: dict[str, Any] = fit.arrays()
        np.savez(file, about=np.array(json.dumps(about)), looks=_looks(fit.clip), **arrays)
        file.flush()
        os.fsync(file.fileno())


def load(fit: Fit, path: Path) -> None:
    """Go on where the checkpoint stopped. `fit` is one of the same clip and settings, not started yet.

    Raises:
        SagsError: the file cannot be read or is damaged.
        UsageError: it belongs to other settings or another clip.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(str(arrays.pop("about")))
        version, settings = about["version"], about["settings"]
        frames, progress = about["frames"], about["progress"]
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise SagsError(f"cannot resume from {path}: {error}; start without --resume") from None
    if version != VERSION:
        raise UsageError(f"{path} was made by another version of this software; start without --resume")
    mine = json.loads(json.dumps(asdict(fit.settings)))
    others = [key for key in mine if settings.get(key) != mine[key]]
    if others:
        raise UsageError(
            f"{path} was made with other settings ({', '.join(others)}); "
            "give the same, or start without --resume"
        )
    if frames != [frame.frame_id for frame in fit.clip.train]:
        raise UsageError(f"{path} belongs to other training frames; start without --resume")
    try:
        apart = np.abs(_looks(fit.clip) - arrays.pop("looks")).mean(axis=(1, 2, 3)) > SAME
        if apart.any():
            raise UsageError(
                f"{path} is of another recording: {np.count_nonzero(apart)} of {len(apart)} pictures look "
                f"different, the first is frame {frames[int(np.argmax(apart))]}; give that recording, or "
                "fit this one without --resume"
            )
        fit.restore(progress, arrays)
    except (KeyError, ValueError, TypeError) as error:
        raise SagsError(f"{path} is damaged ({error}); start without --resume") from None


def _looks(clip: Clip) -> F32:
    """What the training frames look like, [F, CELLS, CELLS, 3] RGB 0..255."""
    small = [cv2.resize(frame.image, (CELLS, CELLS), interpolation=cv2.INTER_AREA) for frame in clip.train]
    return np.array(small, np.float32)
