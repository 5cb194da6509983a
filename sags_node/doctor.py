"""`sags doctor`: is everything here that the node needs, and all that a launch file names."""

from __future__ import annotations

import ctypes
import ctypes.util
import getpass
import glob
import importlib.metadata
import os
import platform
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from sags_node import host
from sags_node.config.schema import (
    GstSource,
    Guarded,
    LaunchConfig,
    OnnxConfig,
    PhantomSource,
    PublishConfig,
    PushRobot,
    PushSource,
    RecordedSource,
    Ros2Robot,
    Ros2Source,
    RosGraph,
    V4l2Source,
)
from sags_node.engine.device import find_gpu, has_gpu
from sags_node.errors import SagsError, UsageError
from sags_node.importing.check import played
from sags_node.kernels.cache import cache_root
from sags_node.messaging.security import check_endpoint, read_allow_list, read_key_pair
from sags_node.pipeline.session import lacks_rig, rig_of
from sags_node.rig.hand_eye import read_hand_eye
from sags_node.ros.graph import domain_of
from sags_node.sources.gst import whole_launch
from sags_node.sources.gst_process import ELEMENTS, check_launch, installed
from sags_node.sources.layout import Layout
from sags_node.sources.pictures import size_text
from sags_node.sources.robot import hand_eye_file
from sags_node.vision.onnx_session import OnnxSession

Level = Literal["ok", "warning", "error"]
REQUIRED = (
    "numpy torch opencv-contrib-python-headless pyzmq open3d onnxruntime numba rosbags mcap msgspec "
    "pydantic pyyaml click rich"
).split()
CORES = 2  # for the rate of a camera
ENOUGH_MEMORY = 2e9  # bytes: about twice what a node takes
TIME_ERROR = 5  # of adjtimex(2): the clock is not synchronised
TIME_KEEPERS = {"chronyd", "ntpd", "phc2sys", "ptp4l", "systemd-timesyn"}  # as far as /proc tells names
OPEN3D_LIBRARIES = {
    "usb-1.0": "libusb-1.0-0",
    "GL": "libgl1",
    "EGL": "libegl1",
    "gomp": "libgomp1",
    "X11": "libx11-6",
}


@dataclass(frozen=True, slots=True)
class Check:
    name: str
    level: Level
    found: str
    fix: str = ""


def examine(config: LaunchConfig) -> list[Check]:
    """All checks, in the order a newcomer meets the problems."""
    return [
        _python(),
        *(_package(name) for name in REQUIRED),
        *(_library(name, package) for name, package in OPEN3D_LIBRARIES.items()),
        check_cores(),
        check_governor(),
        check_memory(),
        check_gpu(config),
        _kernel_cache(),
        *_ports(config.publish),
        *_keys(config.publish),
        _clock(),
        _cameras(),
        _gstreamer(config),
        _recordings(),
        *_launched(config),
    ]


def _launched(config: LaunchConfig) -> list[Check]:
    """What the launch file names: pictures, calibration, the robot, networks."""
    source, robot, vision = config.source, config.robot, config.vision
    checks = []
    if isinstance(source, RecordedSource) and not isinstance(source, PhantomSource):
        for each in played(config):
            name, _, rest = each.what.partition(": ")
            row, said = ("calibration", rest) if name.startswith("calibration") else ("source", each.what)
            checks.append(Check(row, each.level, said, each.fix))
    if isinstance(source, V4l2Source):
        right = () if source.right is None or source.geometry.layout != "separate" else (source.right,)
        checks += [_device(path) for path in (source.left, *right)]
    if isinstance(source, GstSource):
        checks.append(_tried("source", lambda: check_launch(whole_launch(source)[0]), "GStreamer takes it"))
    for section, part in (("source", source), ("robot", robot)):
        if isinstance(part, PushSource | PushRobot):
            checks.append(_port(part.endpoint, part, section))
        if isinstance(part, Ros2Source | Ros2Robot):
            checks.append(_ros(section, part))
    comes_with_pictures = isinstance(source, Ros2Source) and config.rig is None
    judged = any(check.name == "calibration" for check in checks)
    uncalibrated = False
    with suppress(SagsError):  # a recording that cannot be read was said
        uncalibrated = not isinstance(source, PhantomSource) and lacks_rig(config)
    if uncalibrated:
        fix = "depth has no unit without one; sags calib stereo makes one, then set rig"
        checks.append(Check("calibration", "warning", "no calibration", fix))
    elif not (isinstance(source, PhantomSource) or comes_with_pictures or judged):
        checks.append(_tried("calibration", lambda: _check_rig(config), "can be used"))
    if robot is not None:
        checks.append(_tried("hand-eye", lambda: read_hand_eye(hand_eye_file(config)), "can be used"))
    if vision.onnx.path is not None:
        checks.append(_tried("depth network", lambda: OnnxSession(vision.onnx), "loads"))
    if vision.tissue.method == "onnx":
        tissue = OnnxConfig(path=vision.tissue.path)
        checks.append(_tried("tissue network", lambda: OnnxSession(tissue, "vision.tissue"), "loads"))
    return checks


def _tried(name: str, look: Callable[[], object], found: str) -> Check:
    try:
        look()
    except SagsError as error:
        what, _, remedy = str(error).partition("; ")
        return Check(name, "error", what, remedy)
    return Check(name, "ok", found)


def _check_rig(config: LaunchConfig) -> None:
    """Read the calibration. Where the size of a camera's pictures is known without it, compare it.

    Raises:
        SagsError: it cannot be used.
    """
    rig, source = rig_of(config), config.source
    if isinstance(source, V4l2Source):
        size = Layout(source.geometry).size(source.width, source.height, source.left)
        if size != (rig.left.width, rig.left.height):
            raise UsageError(
                f"{config.rig} is for {size_text(rig.left.width, rig.left.height)} px, an eye's pictures are "
                f"{size_text(*size)}; set source.width, source.height or source.geometry, or calibrate anew"
            )


def _device(path: str) -> Check:
    if not os.path.exists(path):
        return Check(path, "error", "no such camera", "plug it in, or name another one: ls /dev/video*")
    if not os.access(path, os.R_OK | os.W_OK):
        return Check(path, "error", "this user may not use it", f"sudo usermod -aG video {getpass.getuser()}")
    return Check(path, "ok", "is there")


def _ros(section: str, config: RosGraph) -> Check:
    if find_spec("cyclonedds") is None:
        return Check(section, "error", "cyclonedds is not installed", "pip install 'sags-node[ros2]'")
    there = sorted(each.name for each in Path("/sys/class/net").iterdir())
    if config.interface not in there:
        remedy = f"set {section}.interface to one of {', '.join(there)}"
        return Check(section, "error", f"there is no network interface {config.interface}", remedy)
    return Check(section, "ok", f"ROS 2 over {config.interface}, domain {domain_of(config)}")


def as_rows(checks: list[Check]) -> list[dict[str, str]]:
    return [asdict(check) for check in checks]


def _python() -> Check:
    return Check("Python", "ok", platform.python_version())


def _package(name: str) -> Check:
    try:
        return Check(name, "ok", importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Check(name, "error", "not installed", "run `make setup`")


def _library(name: str, package: str) -> Check:
    if ctypes.util.find_library(name):
        return Check(package, "ok", "installed")
    return Check(package, "warning", "missing", f"Open3D needs it: sudo apt-get install {package}")


def check_cores(root: Path = host.ROOT) -> Check:
    cores, there, quota = len(os.sched_getaffinity(0)), os.cpu_count() or 1, host.core_quota(root)
    found = f"{cores} core{'s' * (cores != 1)}, {platform.machine()}"
    if cores < there:
        found += f"; the machine has {there}"
    if quota is not None:
        found += f"; the time of {quota:.3g} granted"
    if cores < CORES:
        fix = "camera rate needs two cores" + "; give this process more (taskset, cpuset)" * (cores < there)
        return Check("CPU", "warning", found, fix)
    if quota is not None and quota < min(cores, CORES):
        # Threads use the quota up at once, and then all of them stand still until the next period.
        fix = "give the container or unit two cores or more (CPUQuota=, --cpus), or none to share"
        return Check("CPU", "warning", found, fix)
    return Check("CPU", "ok", found)


def check_governor(root: Path = host.ROOT) -> Check:
    found = host.governors(root)
    if not found:
        return Check("CPU governor", "ok", "not known")
    said = ", ".join(sorted(found))
    if found == {"performance"}:
        return Check("CPU governor", "ok", said)
    level: Level = "warning" if "powersave" in found else "ok"
    return Check("CPU governor", level, said, "for even times: sudo cpupower frequency-set -g performance")


def check_memory(root: Path = host.ROOT) -> Check:
    amounts = host.memory(root)
    free = amounts.get("MemAvailable", 0)
    swap, used = amounts.get("SwapTotal", 0), amounts.get("SwapTotal", 0) - amounts.get("SwapFree", 0)
    swapped = f"{used / 1e9:.1f} of {swap / 1e9:.1f} GB swap used" if swap else "no swap"
    found = f"{free / 1e9:.1f} GB free, {swapped}"
    if free < ENOUGH_MEMORY or used > free:  # it would not all fit, were it needed again
        fix = "close other programs" + ": what is swapped out misses frames" * bool(swap)
        return Check("memory", "warning", found, fix)
    return Check("memory", "ok", found)


def check_gpu(config: LaunchConfig) -> Check:
    """Whether Warp can draw there. A machine without one is no worse for it, unless one is wanted."""
    if config.device == "cpu":
        return Check("GPU", "ok", f"not used: device is {config.device}")
    found = find_gpu()
    if found.kind == "cuda":
        from sags_node.engine.gpu.runtime import driver

        version = importlib.metadata.version("warp-lang")
        return Check("GPU", "ok", f"{found.name}, driver's CUDA {driver()}, Warp {version}")
    level: Level = "error" if config.device == "cuda" else "warning" if has_gpu() else "ok"
    return Check("GPU", level, f"not used: {found.reason}", found.fix if level != "ok" else "")


def _kernel_cache() -> Check:
    root = cache_root()
    if root is not None:
        return Check("kernel cache", "ok", str(root))
    return Check(
        "kernel cache",
        "warning",
        "no folder can be written",
        "kernels will be compiled at every start; set NUMBA_CACHE_DIR to a folder of yours",
    )


def _ports(config: PublishConfig) -> list[Check]:
    endpoints = [endpoint for endpoint in (*config.data, config.control) if endpoint]
    return [_port(endpoint, config) for endpoint in endpoints]


def _port(endpoint: str, config: Guarded, section: str = "publish") -> Check:
    try:
        check_endpoint(endpoint, config, section)
    except UsageError as error:
        return Check(endpoint, "error", "cannot be used", str(error))
    address, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    if endpoint.startswith("ipc:") or port == "*":
        return Check(endpoint, "ok", "needs no port of its own")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address.replace("*", ""), int(port)))
            return Check(endpoint, "ok", "free")
        except (OSError, ValueError, OverflowError) as error:  # taken, not a number, not a port
            keys = "publish.data and publish.control" if section == "publish" else f"{section}.endpoint"
            fix = f"stop the other node, or set {keys} to another port"
            return Check(endpoint, "warning", str(error), fix)


def _keys(config: PublishConfig) -> list[Check]:
    if config.key is None:
        return []
    try:
        read_key_pair(config.key)
        allowed = read_allow_list(config.allow)
    except UsageError as error:
        return [Check("keys", "error", "cannot be used", str(error))]
    return [Check("keys", "ok", f"{config.key}; may connect: {', '.join(map(str, allowed.values()))}")]


class _Timex(ctypes.Structure):
    """The head of what adjtimex(2) tells; the kernel writes 208 bytes."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),  # us
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 256),
    )


def _clock() -> Check:
    """Whether anything sets this machine's clock right. Clients on other machines ask the node for its clock,
    so one that nobody keeps is no fault."""
    by = ", ".join(sorted(_running() & TIME_KEEPERS)) or "no program here"
    timex = _Timex()
    if ctypes.CDLL(None).adjtimex(ctypes.byref(timex)) in (-1, TIME_ERROR):
        fix = "to compare stamps with other machines': sudo apt-get install chrony"
        return Check("clock", "ok", f"kept by {by}; not synchronised", fix)
    return Check("clock", "ok", f"kept by {by}; synchronised to within {timex.maxerror * 1e-3:.0f} ms")


def _running() -> set[str]:
    """Names of the processes here."""
    names = set()
    for comm in Path("/proc").glob("[0-9]*/comm"):
        with suppress(OSError):  # it has ended meanwhile
            names.add(comm.read_text().strip())
    return names


def _cameras() -> Check:
    devices = sorted(glob.glob("/dev/video*"))
    if not devices:
        return Check("cameras", "ok", "none")
    return Check("cameras", "ok", ", ".join(devices))


def _gstreamer(config: LaunchConfig) -> Check:
    """Which elements are there; it starts GStreamer, in a process of its own."""
    wanted: Level = "error" if isinstance(config.source, GstSource) else "ok"
    if ctypes.util.find_library("gstapp-1.0") is None:
        packages = " ".join(sorted(name for name in set(ELEMENTS.values()) if " " not in name))
        fix = f"for source.kind gst: sudo apt-get install gstreamer1.0-tools {packages}"
        return Check("GStreamer", wanted, "not installed", fix)
    try:
        version, missing = installed()
    except SagsError as error:
        return Check("GStreamer", wanted, "does not start", str(error))
    if not missing:
        return Check("GStreamer", "ok", version)
    without = ", ".join(missing)
    fix = "; ".join(f"{name}: {package}" for name, package in missing.items())
    return Check("GStreamer", "ok", f"{version}, without {without}", fix)


def _recordings() -> Check:
    folder = os.environ.get("SAGS_DATA")
    if folder is None:
        return Check("SAGS_DATA", "ok", "not set: launch files look in ../shared/data beside the checkout")
    if Path(folder).is_dir():
        return Check("SAGS_DATA", "ok", folder)
    fix = "set it to the folder of your recordings; without any, sags run plays the phantom"
    return Check("SAGS_DATA", "warning", f"{folder} is no folder", fix)
