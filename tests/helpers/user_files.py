"""What users have lying about: recordings and calibrations, most of them wrong in one way."""

import shlex
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from command_line import RUN_HERE

from sags_node.rig import read_rig, save_rig

SHORT = 6  # frames of the right video that ends too early


def write_user_files(folder: Path, phantom_session: Path) -> None:
    """Into `folder`, after the recording of `phantom_session`."""
    pictures = {
        side: [cv2.imread(str(file)) for file in sorted((phantom_session / side).glob("*.jpg"))[: 2 * SHORT]]
        for side in ("left", "right")
    }
    write_video(folder / "left.mp4", pictures["left"])
    write_video(folder / "right.mp4", pictures["right"])
    write_video(folder / "short.mp4", pictures["right"][:SHORT])
    write_video(folder / "small.mp4", [cv2.resize(picture, (160, 128)) for picture in pictures["right"]])
    (folder / "garbage.mp4").write_bytes(np.random.default_rng(0).bytes(20_000))
    (folder / "empty").mkdir()
    (folder / "file").write_text("mine")
    (folder / "small").mkdir()
    for file in (phantom_session / "left").glob("*.jpg"):
        cv2.imwrite(str(folder / "small" / file.name), np.zeros((128, 160, 3), np.uint8))

    rig = read_rig(phantom_session / "calib")
    save_rig(rig, folder / "calib")
    save_rig(rig, folder / "one_eyed")
    (folder / "one_eyed/right.yaml").unlink()
    in_mm = replace(rig.right, P=rig.right.P * [1, 1, 1, 1000])
    save_rig(replace(rig, right=in_mm), folder / "millimetres")
    double = {
        side: replace(eye, width=640, height=512, K=doubled(eye.K), P=doubled(eye.P))
        for side, eye in (("left", rig.left), ("right", rig.right))
    }
    save_rig(replace(rig, **double), folder / "double")


def doubled(matrix: np.ndarray) -> np.ndarray:
    return np.diag([2.0, 2.0, 1.0]) @ matrix


def write_video(file: Path, pictures: list[np.ndarray]) -> None:
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (width, height))
    for picture in pictures:
        writer.write(picture)
    writer.release()


def videos(folder: Path, left: str = "left.mp4", right: str = "right.mp4", rig: str = "calib") -> list[str]:
    return [
        "source.kind:=videos", f"source.left:={folder / left}", f"source.right:={folder / right}",
        f"rig:={folder / rig}", *RUN_HERE,
    ]  # fmt: skip


def words_of(command: str, folder: Path) -> list[str]:
    """Of a command as one types it. FILES is that folder, VIDEOS what plays its two videos, but for keys that
    the command gives itself."""
    words = [word.replace("FILES", str(folder)) for word in shlex.split(command)]
    given = {word.partition(":=")[0] for word in words}
    played = [word for word in videos(folder) if word.partition(":=")[0] not in given]
    return [each for word in words for each in (played if word == "VIDEOS" else [word])]
