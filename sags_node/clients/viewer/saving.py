"""What a browser may keep of a moment: an image of its page, and the model as files of `sags export`."""

from collections.abc import Callable

import cv2
import numpy as np
import viser

from sags_node.clients.viewer.feed import Moment
from sags_node.errors import SagsError
from sags_node.messaging.content import gaussians_of
from sags_node.types import U8, Camera, Gaussians

RENDER_TIME = 20.0  # s that a browser may take to draw its scene once more
KINDS = ("mesh", "points", "splats")
Exporter = Callable[[Gaussians, Camera, int, str], bytes]  # a model, a camera, its time (ns), one of KINDS


def screenshot(client: viser.ClientHandle, sheet: U8) -> bytes:
    """The browser's 3D scene, beside it the sheet of images: a PNG file.

    Raises:
        SagsError: the browser does not answer.
    """
    height, width = client.camera.image_height, client.camera.image_width
    try:
        scene = client.get_render(height, width, transport_format="jpeg", timeout=RENDER_TIME)
    except (TimeoutError, RuntimeError) as error:
        raise SagsError(f"the browser did not draw its scene: {error}") from None
    scale = scene.shape[0] / sheet.shape[0]
    beside = cv2.resize(sheet, (max(1, round(sheet.shape[1] * scale)), scene.shape[0]))
    _, file = cv2.imencode(".png", cv2.cvtColor(np.hstack([scene[..., :3], beside]), cv2.COLOR_RGB2BGR))
    return file.tobytes()


def exported(moment: Moment, kind: str, export: Exporter) -> bytes:
    """A file of the moment's model, in metres.

    Raises:
        SagsError: there is no model, its lengths have no unit, or it shows nothing.
    """
    if moment.splats is None or moment.camera is None:
        raise SagsError(f"there is no model now: {moment.problem}")
    if "uncalibrated" in moment.status.warning_codes:
        raise SagsError("without a calibration lengths have no unit, and files are in metres")
    return export(gaussians_of(moment.splats), moment.camera, moment.t_capture_ns, kind)
