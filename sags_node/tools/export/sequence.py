"""`sags export --sequence`: a splat file for every frame, and a video that plays in a loop.

Each file appears when it is complete, and stays. So an export that was ended, by a full disk or by Ctrl-C,
goes on when the same command is given again: frames that are there are not written anew.
"""

import json
import logging
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2

from sags_node import __version__
from sags_node.errors import SagsError, UsageError
from sags_node.files import check_folder, whole, writing
from sags_node.media.video_file import VideoFile
from sags_node.model.ply import write_ply
from sags_node.pipeline.session import Session
from sags_node.tools.evaluation.receipt import digest, rig_digest
from sags_node.tools.export.orbit import picture_of
from sags_node.tools.export.scene import Advance, Scene, files_of_fit

log = logging.getLogger(__name__)

ABOUT = "sequence.json"
LOOP = "loop.mp4"
FRAME = "frame_{:05d}.ply"
QUALITY = 98  # of the images kept for the way back, JPEG


def state_of(session: Session, fit: Path | None) -> dict[str, str | None]:
    """The version, and digests of what the frames are made from: a file of the same path may hold something
    else now.

    Raises:
        UsageError: `fit` is no folder of a finished `sags fit`.
    """
    return {
        "version": __version__,
        "configuration": digest(session.config.model_dump_json().encode()),
        "calibration": rig_digest(session.rig),
        "checkpoint": None if fit is None else digest(files_of_fit(fit)[0].read_bytes()),
    }


def check_sequence(folder: Path, about: dict[str, Any], force: bool) -> None:
    """Check, before any work, that the folder is new or that of the same export.

    Args:
        about: what is exported, as JSON, with its `state_of`.
        force: begin anew, and remove the files of an earlier export.

    Raises:
        UsageError: the folder holds something else.
        SagsError: it cannot be written to.
    """
    check_folder(folder)
    stored = folder / ABOUT
    if force:
        with writing(folder):
            for file in (*folder.glob("frame_[0-9]*.ply"), folder / LOOP, stored):
                file.unlink(missing_ok=True)
    elif stored.is_file():
        try:
            same = json.loads(stored.read_text(encoding="utf-8")) == about
        except (OSError, ValueError):
            same = False
        if not same:
            raise UsageError(
                f"{folder} holds another sequence, or one of another launch file, calibration, fit or "
                "version; choose another folder, or add --force"
            )
    elif any(folder.iterdir()):
        raise UsageError(f"{folder} is not empty; choose another folder, or add --force")
    with whole(stored) as partial:
        partial.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")


def write_sequence(
    folder: Path, scenes: Iterable[Scene], rate: float, count: int | None, advance: Advance
) -> list[dict[str, Any]]:
    """Write `frame_NNNNN.ply` for every scene that was taken in and shows something, and `loop.mp4`: there
    and back.

    Args:
        rate: images per second, used where stamps start again from an earlier time.
        count: how many scenes there will be, where that is known.

    Returns:
        As `export.export`; `holds` counts frames and images.

    Raises:
        SagsError: nothing is shown, or a file cannot be written; what was written stays.
    """
    written = kept = size = 0
    stamps: list[int] = []  # ns, of the images
    held: list[str] = []
    with writing(folder), tempfile.TemporaryDirectory(prefix=".sags-", dir=folder) as passing:
        drawer, camera = None, None
        for number, scene in enumerate(scenes):
            advance(number + 1, count, f"writing frames, {kept} were there")
            if scene.held:
                held.append(scene.held)
                continue
            if len(scene.gaussians) == 0:
                continue
            path = folder / FRAME.format(number)
            if path.exists():
                kept += 1
            else:
                try:
                    write_ply(path, scene.gaussians)
                except SagsError as error:
                    said = f"{written + kept} frames are there; the same command goes on, without --force"
                    raise SagsError(f"{error}: {said}") from None
                written += 1
            size += path.stat().st_size
            if drawer is None or camera is None:
                camera = scene.camera
                drawer = scene.drawer()
            picture, _ = picture_of(drawer, scene.gaussians, scene.camera)
            jpeg = cv2.imencode(
                ".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
            )
            (Path(passing) / f"{len(stamps)}.jpg").write_bytes(jpeg[1].tobytes())
            stamps.append(scene.t_capture_ns)
        if camera is None:
            raise SagsError("no frame shows anything to make a model of")
        if kept:
            log.warning("%d of %d frames were there and stayed; --force makes all anew", kept, kept + written)
        if held:
            log.warning("%d frames are left out, since they were not taken in (%s)", len(held), held[-1])
        loop = folder / LOOP
        shown = [*enumerate(stamps)]
        shown += [(number, 2 * stamps[-1] - stamp_ns) for number, stamp_ns in shown[-2:0:-1]]
        with whole(loop) as partial:
            video = VideoFile(partial, rate, (camera.width, camera.height))
            for done, (number, stamp_ns) in enumerate(shown):
                read = cv2.imread(str(Path(passing) / f"{number}.jpg"))
                if read is None:
                    raise SagsError(f"an image in {passing} was removed; export again")
                video.add(cv2.cvtColor(read, cv2.COLOR_BGR2RGB), stamp_ns)
                advance(done + 1, len(shown), "writing the video")
            video.finish()
    return [
        {"file": str(folder / FRAME.format(0)), "kind": "sequence", "holds": written + kept, "bytes": size},
        {"file": str(loop), "kind": "loop", "holds": len(shown), "bytes": loop.stat().st_size},
    ]
