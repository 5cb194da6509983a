"""`sags doctor`: is everything here that the node needs, and all that a launch file names."""

import ctypes
import ctypes.util
import getpass
import glob
import importlib.metadata
import os
import platform
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import zmq

from sags_node.checks import Finding, Level, parted
from sags_node.config.schema import (
    GstSource,
    Guarded,
    LaunchConfig,
    LiveSource,
    OnnxConfig,
    PhantomSource,
    PushRobot,
    PushSource,
    RecordedSource,
    Ros2Robot,
    Ros2Source,
    RosGraph,
    V4l2Source,
)
from sags_node.engine.device import TORCH_WITH_CUDA, find_gpu, has_gpu
from sags_node.errors import SagsError, UsageError, install
from sags_node.kernels.cache import cache_root
from sags_node.messaging.masks import MaskSubscriber
from sags_node.messaging.security import check_endpoint, read_allow_list, read_key_pair
from sags_node.messaging.sockets import bind
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import lacks_rig, rig_of
from sags_node.rig.hand_eye import read_hand_eye
from sags_node.ros.graph import domain_of
from sags_node.sources.gst import whole_launch
from sags_node.sources.gst_process import ELEMENTS, check_launch, installed
from sags_node.sources.layout import Layout
from sags_node.sources.pictures import size_text
from sags_node.sources.robot import hand_eye_file
from sags_node.tools.importing.check import played
from sags_node.vision.onnx_session import OnnxSession

ROOT = Path("/")  # of the system files that are read; tests use another folder

Look = tuple[str, Finding]  # what was looked at, and what was found
REQUIRED = (
    "numpy torch opencv-contrib-python-headless pyzmq open3d onnxruntime numba rosbags mcap msgspec "
    "pydantic pyyaml click rich"
).split()
CORES = 2  # that a camera's frame rate needs
ENOUGH_MEMORY = 2e9  # bytes: about twice what a node takes
UNLIMITED = 1 << 62  # bytes: what control groups of version 1 state where there is no limit
TIME_ERROR = 5  # of adjtimex(2): the clock is not synchronised
MAX_ERROR = struct.Struct("@I3l")  # modes, offset, frequency and largest error (us) of its `timex`
TIME_KEEPERS = {"chronyd", "ntpd", "phc2sys", "ptp4l", "systemd-timesyn"}  # as far as /proc tells names
OPEN3D_LIBRARIES = {
    "usb-1.0": "libusb-1.0-0",
    "GL": "libgl1",
    "EGL": "libegl1",
    "gomp": "libgomp1",
    "X11": "libx11-6",
    "idn2": "libidn2-0",
}


def examine(config: LaunchConfig) -> list[Look]:
    """Look at everything, in the order a newcomer meets the problems."""
    publish = config.publish
    return [
        ("Python", Finding("ok", platform.python_version())),
        *((name, _package(name)) for name in REQUIRED),
        *((package, _library(name, package)) for name, package in OPEN3D_LIBRARIES.items()),
        ("CPU", check_cores()),
        ("CPU governor", check_governor()),
        ("memory", check_memory()),
        ("GPU", check_gpu(config)),
        ("kernel cache", _kernel_cache()),
        *((endpoint, _port(endpoint, publish)) for endpoint in (*publish.data, publish.control) if endpoint),
        *(() if publish.key is None else [("keys", _keys(publish.key, publish.allow))]),
        ("clock", _clock()),
        ("cameras", Finding("ok", ", ".join(sorted(glob.glob("/dev/video*"))) or "none")),
        ("GStreamer", _gstreamer(config)),
        ("SAGS_DATA", _recordings()),
        *_launched(config),
    ]


def as_rows(looks: Iterable[Look]) -> list[dict[str, str]]:
    return [{"name": name, "level": each.level, "found": each.what, "fix": each.fix} for name, each in looks]


def _launched(config: LaunchConfig) -> list[Look]:
    """Check what the launch file names: images, calibration, the robot, networks."""
    source, robot, vision = config.source, config.robot, config.vision
    looks: list[Look] = []
    if isinstance(source, RecordedSource) and not isinstance(source, PhantomSource):
        for each in played(config):
            name, _, rest = each.what.partition(": ")
            of_rig = name.startswith("calibration")
            looks.append(("calibration", replace(each, what=rest)) if of_rig else ("source", each))
    if isinstance(source, V4l2Source):
        right = () if source.right is None or source.geometry.layout != "separate" else (source.right,)
        looks += [(path, _device(path)) for path in (source.left, *right)]
    if isinstance(source, GstSource):
        said = _tried(lambda: check_launch(whole_launch(source)[0]), "GStreamer takes it")
        looks.append(("source", said))
    for section, part in (("source", source), ("robot", robot)):
        if isinstance(part, PushSource | PushRobot):
            looks.append((part.endpoint, _port(part.endpoint, part, section)))
        if isinstance(part, Ros2Source | Ros2Robot):
            looks.append((section, _ros(section, part)))
    comes_with_pictures = isinstance(source, Ros2Source) and config.rig is None
    judged = any(name == "calibration" for name, _ in looks)
    uncalibrated = False
    with suppress(SagsError):  # a recording that cannot be read was reported
        uncalibrated = not isinstance(source, PhantomSource) and lacks_rig(config)
    if uncalibrated:
        fix = "depth has no unit without one; sags calib stereo makes one, then set rig"
        looks.append(("calibration", Finding("warning", "no calibration", fix)))
    elif not (isinstance(source, PhantomSource) or comes_with_pictures or judged):
        looks.append(("calibration", _tried(lambda: _check_rig(config), "can be used")))
    if robot is not None:
        looks.append(("hand-eye", _tried(lambda: read_hand_eye(hand_eye_file(config)), "can be used")))
    if vision.onnx.path is not None:
        looks.append(("depth network", _tried(lambda: OnnxSession(vision.onnx), "loads")))
    if vision.tissue.method == "onnx":
        tissue = OnnxConfig(path=vision.tissue.path)
        looks.append(("tissue network", _tried(lambda: OnnxSession(tissue, "vision.tissue"), "loads")))
    if vision.tissue.method == "topic":
        address = str(vision.tissue.endpoint), vision.tissue.ns
        looks.append(("tissue masks", _tried(lambda: MaskSubscriber(*address).close(), "can be received")))
    if config.rig is not None and isinstance(source, LiveSource):
        made = _tried(lambda: Pipeline(config, rig_of(config), lambda stamp_ns: None), "can be made")
        if made.what not in [each.what for _, each in looks]:  # else that was reported
            looks.append(("pipeline", made))
    return looks


def _tried(look: Callable[[], object], found: str) -> Finding:
    try:
        look()
    except SagsError as error:
        return parted("error", str(error))
    return Finding("ok", found)


def _check_rig(config: LaunchConfig) -> None:
    """Read the calibration. Where the size of a camera's images is known without it, compare it.

    Raises:
        SagsError: it cannot be used.
    """
    rig, source = rig_of(config), config.source
    if isinstance(source, V4l2Source):
        size = Layout(source.geometry).size(source.width, source.height, source.left)
        if size != (rig.left.width, rig.left.height):
            raise UsageError(
                f"{config.rig} is for {size_text(rig.left.width, rig.left.height)} px, an eye's images are "
                f"{size_text(*size)}; set source.width, source.height or source.geometry, or calibrate anew"
            )


def _device(path: str) -> Finding:
    if not os.path.exists(path):
        return Finding("error", "no such camera", "plug it in, or name another one: ls /dev/video*")
    if not os.access(path, os.R_OK | os.W_OK):
        return Finding("error", "this user may not use it", f"sudo usermod -aG video {getpass.getuser()}")
    return Finding("ok", "is there")


def _ros(section: str, config: RosGraph) -> Finding:
    if find_spec("cyclonedds") is None:
        return Finding("error", "cyclonedds is not installed", install("ros2"))
    there = sorted(each.name for each in Path("/sys/class/net").iterdir())
    if config.interface not in there:
        remedy = f"set {section}.interface to one of {', '.join(there)}"
        return Finding("error", f"there is no network interface {config.interface}", remedy)
    return Finding("ok", f"ROS 2 over {config.interface}, domain {domain_of(config)}")


def _package(name: str) -> Finding:
    try:
        return Finding("ok", importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding("error", "not installed", "run `make setup`")


def _library(name: str, package: str) -> Finding:
    if ctypes.util.find_library(name):
        return Finding("ok", "installed")
    return Finding("warning", "missing", f"Open3D needs it: sudo apt-get install {package}")


def check_cores(root: Path = ROOT) -> Finding:
    cores, there, quota = len(os.sched_getaffinity(0)), os.cpu_count() or 1, core_quota(root)
    found = f"{cores} core{'s' * (cores != 1)}, {platform.machine()}"
    if cores < there:
        found += f"; the machine has {there}"
    if quota is not None:
        found += f"; the time of {quota:.3g} granted"
    if cores < CORES:
        fix = "camera rate needs two cores" + "; give this process more (taskset, cpuset)" * (cores < there)
        return Finding("warning", found, fix)
    if quota is not None and quota < min(cores, CORES):
        # Threads use the quota up at once, and then all of them stand still until the next period.
        fix = "give the container or unit two cores or more (CPUQuota=, --cpus), or none to share"
        return Finding("warning", found, fix)
    return Finding("ok", found)


def check_governor(root: Path = ROOT) -> Finding:
    found = governors(root)
    if not found:
        return Finding("ok", "not known")
    said = ", ".join(sorted(found))
    if found == {"performance"}:
        return Finding("ok", said)
    level: Level = "warning" if "powersave" in found else "ok"
    return Finding(level, said, "for even times: sudo cpupower frequency-set -g performance")


def check_memory(root: Path = ROOT) -> Finding:
    amounts, granted = memory(root), memory_quota(root)
    free = amounts.get("MemAvailable", 0)
    swap, used = amounts.get("SwapTotal", 0), amounts.get("SwapTotal", 0) - amounts.get("SwapFree", 0)
    swapped = f"{used / 1e9:.1f} of {swap / 1e9:.1f} GB swap used" if swap else "no swap"
    found = f"{free / 1e9:.1f} GB free, {swapped}"
    if granted is not None:
        found += f"; {granted / 1e9:.1f} GB more granted"
        if granted < min(free, ENOUGH_MEMORY):  # the kernel ends what takes more
            fix = "give the container or unit 2 GB more (MemoryMax=, --memory), or end what shares it"
            return Finding("warning", found, fix)
    if free < ENOUGH_MEMORY or used > free:  # it would not all fit, were it needed again
        fix = "close other programs" + ": what is swapped out misses frames" * bool(swap)
        return Finding("warning", found, fix)
    return Finding("ok", found)


def check_gpu(config: LaunchConfig, root: Path = ROOT) -> Finding:
    """Tell whether Warp can draw on a GPU, and torch learn there. To have none is a fault only where `device`
    asks for one."""
    if config.device == "cpu":
        return Finding("ok", f"not used: device is {config.device}")
    found = find_gpu()
    number = re.search(r"\d{3,}\.[\d.]+", _read(root / "proc/driver/nvidia/version"))
    driver = f", driver {number[0]}" if number else ""
    if found.kind == "cuda":
        import torch

        from sags_node.engine.gpu import runtime

        version = importlib.metadata.version("warp-lang")
        said = f"{found.name}{driver}, CUDA {runtime.driver()}, Warp {version}"
        if torch.cuda.is_available():
            return Finding("ok", f"{said}; torch finds it")
        return Finding("ok", f"{said}; torch does not find it", f"for sags fit: {TORCH_WITH_CUDA}")
    level: Level = "error" if config.device == "cuda" else "warning" if has_gpu() else "ok"
    return Finding(level, f"not used: {found.reason}{driver}", found.fix if level != "ok" else "")


def _kernel_cache() -> Finding:
    root = cache_root()
    if root is not None:
        return Finding("ok", str(root))
    fix = "kernels will be compiled at every start; set NUMBA_CACHE_DIR to a folder of yours"
    return Finding("warning", "no folder can be written", fix)


def _port(endpoint: str, config: Guarded, section: str = "publish") -> Finding:
    try:
        check_endpoint(endpoint, config, section)
    except UsageError as error:
        return Finding("error", "cannot be used", str(error))
    if endpoint.startswith("ipc:") or endpoint.endswith(":*"):
        return Finding("ok", "needs no port of its own")
    option = "publish.data" if section == "publish" else f"{section}.endpoint"
    with zmq.Context() as context, context.socket(zmq.PAIR) as probe:
        try:
            bind(probe, endpoint, option, None)
            return Finding("ok", "free")
        except SagsError as error:
            found = parted("warning", str(error))
            taken = "in use" in found.what
            return replace(found, fix="stop the other node, or " * taken + found.fix)


def _keys(key: Path, allow: Sequence[Path]) -> Finding:
    try:
        read_key_pair(key)
        allowed = read_allow_list(allow)
    except UsageError as error:
        return Finding("error", "cannot be used", str(error))
    return Finding("ok", f"{key}; may connect: {', '.join(map(str, allowed.values()))}")


def _clock() -> Finding:
    """Tell whether anything sets this machine's clock right. Clients on other machines ask the node for its
    clock, so one that is not synchronised is no fault."""
    by = ", ".join(sorted(_running() & TIME_KEEPERS)) or "no program here"
    timex = ctypes.create_string_buffer(256)  # of which the kernel writes 208 bytes
    if ctypes.CDLL(None).adjtimex(timex) in (-1, TIME_ERROR):
        fix = "to compare stamps with other machines': sudo apt-get install chrony"
        return Finding("ok", f"kept by {by}; not synchronised", fix)
    error_us = MAX_ERROR.unpack_from(timex)[3]
    return Finding("ok", f"kept by {by}; synchronised to within {error_us * 1e-3:.0f} ms")


def _running() -> set[str]:
    """The names of the processes on this machine."""
    names = set()
    for comm in Path("/proc").glob("[0-9]*/comm"):
        with suppress(OSError):  # it has ended meanwhile
            names.add(comm.read_text().strip())
    return names


def _gstreamer(config: LaunchConfig) -> Finding:
    """Tell which elements are there; this starts GStreamer, in a process of its own."""
    wanted: Level = "error" if isinstance(config.source, GstSource) else "ok"
    if ctypes.util.find_library("gstapp-1.0") is None:
        packages = " ".join(sorted(name for name in set(ELEMENTS.values()) if " " not in name))
        fix = f"for source.kind gst: sudo apt-get install gstreamer1.0-tools {packages}"
        return Finding(wanted, "not installed", fix)
    try:
        version, missing = installed()
    except SagsError as error:
        return Finding(wanted, "does not start", str(error))
    if not missing:
        return Finding("ok", version)
    without = ", ".join(missing)
    fix = "; ".join(f"{name}: {package}" for name, package in missing.items())
    return Finding("ok", f"{version}, without {without}", fix)


def _recordings() -> Finding:
    folder = os.environ.get("SAGS_DATA")
    if folder is None:
        return Finding("ok", "not set: launch files look in ../shared/data beside the checkout")
    if Path(folder).is_dir():
        return Finding("ok", folder)
    fix = "set it to the folder of your recordings; without any, sags run plays the phantom"
    return Finding("warning", f"{folder} is no folder", fix)


def core_quota(root: Path = ROOT) -> float | None:
    """The cores whose time this process's control groups grant; None: no limit is known.

    Groups above it count, too; versions 2 and 1 (https://docs.kernel.org/admin-guide/cgroup-v2.html).
    """
    granted = []
    for group in _control_groups("cpu", root):
        one = [_read(group / f"cpu.cfs_{name}_us").strip() for name in ("quota", "period")]
        said = _read(group / "cpu.max").split() or one
        with suppress(ValueError, ZeroDivisionError):  # "max", -1 and nothing: no limit
            if float(said[0]) > 0:
                granted.append(float(said[0]) / float(said[1]))
    return min(granted, default=None)


def memory_quota(root: Path = ROOT) -> int | None:
    """The memory that control groups still grant, bytes; None: no limit is known. Their cache of inactive
    files counts as free."""
    granted = []
    for group in _control_groups("memory", root):
        stat = dict(line.split() for line in _read(group / "memory.stat").splitlines())
        kept = int(stat.get("total_inactive_file", stat.get("inactive_file", 0)))
        for limit, used in (("max", "current"), ("high", "current"), ("limit_in_bytes", "usage_in_bytes")):
            with suppress(ValueError):  # "max" and nothing: no limit
                most = int(_read(group / f"memory.{limit}"))
                if most < UNLIMITED:
                    granted.append(max(0, most - int(_read(group / f"memory.{used}")) + kept))
    return min(granted, default=None)


def _control_groups(controller: str, root: Path) -> Iterator[Path]:
    """The folders of this process's control group and of those above it."""
    for line in _read(root / "proc/self/cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        mount = root / "sys/fs/cgroup" / (controller if controllers else "")
        # A container may see its own group as the root, whatever it is called outside.
        for group in (mount / path.lstrip("/"), *(mount / path.lstrip("/")).parents):
            yield group
            if group == mount:
                break


def governors(root: Path = ROOT) -> set[str]:
    """The frequency governors of the cores; empty where the machine does not tell, as in most virtual
    machines.

    `powersave` of a processor that chooses its rate itself (`intel_pstate`, `amd-pstate-epp`) is not the
    lowest rate, and is called `balanced` here.
    """
    found = set()
    for file in (root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"):
        name = _read(file).strip()
        chooses_itself = _read(file.with_name("scaling_driver")).strip() in ("intel_pstate", "amd-pstate-epp")
        found.add("balanced" if chooses_itself and name == "powersave" else name)
    return found - {""}


def memory(root: Path = ROOT) -> dict[str, int]:
    """`MemAvailable`, `SwapTotal`, `SwapFree` and the others of /proc/meminfo, bytes."""
    found = {}
    for line in _read(root / "proc/meminfo").splitlines():
        name, _, said = line.partition(":")
        number, _, unit = said.strip().partition(" ")
        found[name] = int(number) * (1024 if unit == "kB" else 1)
    return found


def _read(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:
        return ""
