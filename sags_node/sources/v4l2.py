"""Live stereo from V4L2: two cameras paired by their stamps, or one whose images show both eyes."""

import logging
import math
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from sags_node.config.schema import V4l2Source
from sags_node.errors import SagsError, UsageError
from sags_node.sources.live import CaptureDevice, Input, LiveStereo
from sags_node.sources.pairing import Shot
from sags_node.types import Samples, Side

log = logging.getLogger(__name__)

FIRST_PICTURE_S = 3  # s that cameras may need to start: OpenCV blocks until the first image
DEEP = {"Y10 ": 6, "Y12 ": 4, "Y16 ": 0}  # pixel formats of 16 bit words, and their unused bits
NEAR_NS = 1_000_000_000  # ns: a stamp this near to its arrival is of the kernel's monotonic clock
STRANGE = 30  # images: if none of so many has such a stamp, the driver uses another clock


class Device:
    """An open camera.

    Most drivers stamp by the kernel's monotonic clock. Once a driver was seen to do so, its stamps are
    believed, however old: its buffers may hold images that nobody took for a while.

    Args:
        path: device file; a udev link such as /dev/video-left follows its camera from port to port.
        config: size, rate and pixel format to ask for.

    Raises:
        SagsError: the device is missing or cannot be opened, or the driver set another size.
    """

    _is_near = False  # a stamp near to its arrival was seen
    _far = 0  # images up to the first such stamp

    def __init__(self, path: str, config: V4l2Source) -> None:
        self._path = path
        self.size = config.width, config.height
        self._last_stamp_ms = 0.0
        if not os.path.exists(path):
            raise SagsError(f"camera {path} does not exist; {_present()}")
        timeout = max(FIRST_PICTURE_S, math.ceil(config.deadline))
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(timeout))  # OpenCV's own is 10 s
        self._capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise SagsError(
                f"{path} cannot be opened as a camera: another program uses it, this user may not "
                f"(group 'video'), or it does not capture; {_present()}"
            )
        try:
            self.rate = self._configure(config)
        except SagsError:
            self.close()
            raise

    def _configure(self, config: V4l2Source) -> float:
        """Request size, rate and format; return the rate that the driver set. It may refuse any of them."""
        capture = self._capture
        asked = None if config.fourcc is None else config.fourcc.ljust(4)
        if asked is not None:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*asked))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, config.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, config.height)
        capture.set(cv2.CAP_PROP_FPS, config.rate)

        width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if (width, height) != (config.width, config.height):
            raise SagsError(
                f"{self._path}: wanted {config.width}x{config.height} px, the driver gives {width}x{height}; "
                "set source.width and source.height to a size of this camera"
            )
        fourcc = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode("ascii", "replace")
        if asked is not None and fourcc != asked:
            log.warning("%s: wanted pixel format %s, the driver gives %s", self._path, asked, fourcc)
        self._shift = DEEP.get(fourcc)
        if self._shift is not None:
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # OpenCV would cut it to 8 bit
        rate = float(capture.get(cv2.CAP_PROP_FPS))
        if rate <= 0:
            return config.rate
        if abs(rate - config.rate) > 0.01 * config.rate:
            log.warning("%s: wanted %g frames/s, the driver gives %g", self._path, config.rate, rate)
        return rate

    def read(self, timeout: float) -> Shot | None:
        """Return the next image; None if none comes within `timeout` seconds, or its stamp is the last one.

        Raises:
            SagsError: the device is gone.
        """
        try:
            ready, _ = cv2.VideoCapture.waitAny([self._capture], int(timeout * 1e9))
            if not ready:
                return None
            found, picture = self._capture.read()
        except cv2.error:
            found = False
        if not found:
            raise SagsError(f"{self._path} stopped delivering images")
        stamp_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        if stamp_ms and stamp_ms == self._last_stamp_ms:
            return None
        self._last_stamp_ms = stamp_ms
        device_ns, arrival_ns = round(stamp_ms * 1e6), time.time_ns()
        age_ns = self._age(device_ns, time.monotonic_ns() - device_ns)
        if self._shift is None:
            image: Samples = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
        else:
            image = _deep(picture, self._shift, self.size)
        return Shot(arrival_ns - age_ns, image, device_ns=device_ns, arrival_ns=arrival_ns)

    def _age(self, driver_ns: int, before_ns: int) -> int:
        """The age of an image on arrival, ns, given the driver's stamp and how long before arrival it lies.
        0 if the driver gives no stamp (0), or one of another clock.

        No image is taken after it arrived: if a driver stamps ahead (vivid does), the age is 0.
        """
        if not self._is_near:
            self._is_near = abs(before_ns) <= NEAR_NS
            self._far += 1
        is_believed = driver_ns and (self._is_near or self._far < STRANGE)
        return max(before_ns, 0) if is_believed else 0

    def close(self) -> None:
        self._capture.release()


def _deep(picture: Samples, shift: int, size: tuple[int, int]) -> Samples:
    """Convert grey of 10 to 16 bit, as bytes or as OpenCV reads it, to three equal 16 bit channels."""
    gray = picture.reshape(-1).view(np.uint16).reshape(size[1], size[0])
    rgb: Samples = cv2.merge([cv2.multiply(gray, 1 << shift)] * 3)
    return rgb


def _present() -> str:
    devices = sorted(str(device) for device in Path("/dev").glob("video*"))
    return f"present: {', '.join(devices)}" if devices else "there is no /dev/video* at all"


def open_cameras(
    config: V4l2Source,
    size: tuple[int, int] | None = None,
    open_device: Callable[[str, V4l2Source], CaptureDevice] = Device,
) -> LiveStereo:
    """Open the cameras of a launch file.

    Args:
        config: devices, size, rate, and the tolerance of pairs.
        size: width and height that an eye's images must have, px.
        open_device: opens one camera.

    Raises:
        UsageError: the named devices cannot make a stereo pair, or not of this size.
        SagsError: a device is missing, cannot be opened, or gives another size.
    """
    sides: dict[str, Side | None] = {config.left: None}
    if config.geometry.layout == "separate":
        if config.right is None:
            raise UsageError("source.right names no camera; name one, or set source.geometry.layout")
        if os.path.realpath(config.left) == os.path.realpath(config.right):
            raise UsageError(f"source.left and source.right are the same camera, {config.right}")
        sides = {config.left: "left", config.right: "right"}
    inputs = [
        Input(path, side, partial(open_device, path, config), config.deadline) for path, side in sides.items()
    ]
    return LiveStereo(inputs, config, size)
