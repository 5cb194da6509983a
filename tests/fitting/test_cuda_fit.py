"""The offline fit on the device, in Triton's interpreter or on a GPU, against the fit on the CPU; what
happens when the device fails; and how the command chooses it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from engine_scenes import relative_error
from torch.utils._python_dispatch import TorchDispatchMode

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")

from sags_node.cli.main import main
from sags_node.engine import device as devices
from sags_node.engine.cuda import adam, hexplane
from sags_node.engine.cuda.rasterizer import CudaRasterizer
from sags_node.engine.device import Device
from sags_node.engine.failures import DeviceMemoryError
from sags_node.errors import SagsError
from sags_node.fitting import checkpoint, field, start
from sags_node.fitting.clip import Clip, ClipFrame
from sags_node.fitting.cuda import learner as cuda_learner
from sags_node.fitting.cuda.field import Loan
from sags_node.fitting.fit import Fit
from sags_node.fitting.learner import DeviceKind
from sags_node.fitting.settings import FieldShape, FitSettings, Growth
from sags_node.model import columns
from sags_node.types import Camera

# the kernels divide by a coverage of zero and select afterwards; a GPU says nothing of it
pytestmark = [
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),
    pytest.mark.usefixtures("quick_interpreter"),
]

WIDTH, HEIGHT = 32, 16
SMALL = FitSettings(
    warm_up=2, iterations=40, max_gaussians=60, shape=FieldShape(cells=1, channels=16, frames_per_slot=2.5)
)
PAPER = dataclasses.replace(SMALL, schedule="paper")
KINDS = {
    "paper, warming up": dataclasses.replace(PAPER, warm_up=20),
    "paper, nodes": PAPER,
    "paper, self": dataclasses.replace(PAPER, tokens="self", antialias=False),
    "paper, planes, no block": dataclasses.replace(PAPER, tokens="planes", block="none"),
    "online, nodes": SMALL,
    "online, self": dataclasses.replace(SMALL, tokens="self"),
}
CUDA_ERROR = RuntimeError("CUDA error: an illegal memory access was encountered\nand much more")


@pytest.fixture(autouse=True)
def small_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(field, "NODES", 6)
    monkeypatch.setattr(start, "PATH_STEPS", 2)
    # the interpreter takes its time for each program
    monkeypatch.setattr(adam, "ROWS", 8)
    monkeypatch.setattr(adam, "COLUMNS", 512)
    monkeypatch.setattr(hexplane, "POINTS", 64)


def make_frame(number: int) -> ClipFrame:
    """A tilted, textured sheet that moves by a pixel a frame to the left, partly hidden."""
    coarse = np.random.default_rng(1).uniform(50, 200, (5, 12, 3)).astype(np.float32)
    texture = cv2.resize(coarse, (WIDTH + 16, HEIGHT))
    tissue = np.ones((HEIGHT, WIDTH), np.bool_)
    tissue[3:7, 18:24] = False
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    K = np.array([[40.0, 0, (WIDTH - 1) / 2], [0, 40, (HEIGHT - 1) / 2], [0, 0, 1]])
    return ClipFrame(
        number, number * 33_000_000, Camera(WIDTH, HEIGHT, K, np.eye(4)),
        np.ascontiguousarray(texture[:, number : number + WIDTH] * (1 - 0.02 * number)).astype(np.uint8),
        tissue, ((0.05 + 1e-4 * x + 1.3e-4 * y) * tissue).astype(np.float32), None,
    )  # fmt: skip


@pytest.fixture(scope="module")
def clip() -> Clip:
    frames = [make_frame(number) for number in range(7)]
    return Clip([frame for frame in frames if frame.frame_id != 3], [frames[3]])


def quietly(what: str, done: int, of: int) -> None:
    """No progress shown."""


def iterated(made: Fit, count: int) -> Fit:
    for _ in range(count):
        made.iterate()
    return made


def started(clip: Clip, settings: FitSettings, device: DeviceKind = "cpu") -> Fit:
    made = Fit(clip, settings, device)
    made.start(quietly)
    return made


def arrays_of(made: Fit) -> dict[str, Any]:
    return {name: np.array(array) for name, array in made.arrays().items()}


def resumed(clip: Clip, path: Path, settings: FitSettings, device: DeviceKind) -> Fit:
    made = Fit(clip, settings, device)
    checkpoint.load(made, path)
    return made


def picture(made: Fit) -> Any:
    """What the model looks like in a frame that it never saw."""
    frame = made.clip.test[0]
    return made.rasterizer.forward(made.gaussians(frame), frame.camera).copy()


# ---- the same as on the CPU --------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", KINDS.values(), ids=KINDS)
def test_an_iteration_is_the_cpus(clip: Clip, settings: FitSettings, tmp_path: Path) -> None:
    """Both go on from one checkpoint, in which everything has moved."""
    checkpoint.save(iterated(started(clip, settings), 12), tmp_path / "checkpoint.npz")
    before = np.load(tmp_path / "checkpoint.npz")
    cpu, cuda = (
        iterated(resumed(clip, tmp_path / "checkpoint.npz", settings, device), 1)
        for device in ("cpu", "cuda")
    )
    assert cuda.device == "cuda" and cuda.state() | {"seconds": 0} == cpu.state() | {"seconds": 0}
    assert cuda.residual == pytest.approx(cpu.residual, rel=1e-5)
    found, expected = arrays_of(cuda), arrays_of(cpu)
    assert found.keys() == expected.keys()
    moved = set()
    for name, array in expected.items():
        if np.array_equal(array, before[name]):
            np.testing.assert_array_equal(found[name], array, err_msg=name)
            continue
        moved.add(name)
        if name.endswith((".moments", ".shares")) or name in {"pull", "seen"}:
            assert relative_error(found[name], array) < 2e-4, name
        else:
            # where a gradient is zero but for rounding, Adam makes full steps of it
            same = np.abs(found[name] - array) <= 1e-2 * np.abs(array - before[name]).max()
            assert np.mean(same) > 0.95, name
    if settings.schedule == "paper":
        assert {"rows", "gains", "pull", "seen"} <= moved
        assert ({"cells", "decoder"} <= moved) == (cpu.iteration > cpu.warm_up)
    else:
        assert {"cells", "decoder", "residuals"} <= moved
    assert np.abs(picture(cuda) - picture(cpu)).max() < 2e-3


def test_density_control_and_a_checkpoint_go_between_devices(
    clip: Clip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gaussians are removed and split on the host; then the device goes on, and so does a CPU."""
    settings = dataclasses.replace(PAPER, warm_up=1, max_gaussians=80, growth=Growth(every=3))
    base = started(clip, dataclasses.replace(settings, max_gaussians=60))
    base.model.rows[:5, columns.LOGIT] = -9  # transparent
    found, state = arrays_of(base), base.state()
    made: dict[str, Fit] = {}
    for device in ("cpu", "cuda"):
        made[device] = Fit(clip, settings, device)
        made[device].restore(state, {name: array.copy() for name, array in found.items()})
        iterated(made[device], 3)
    cpu, cuda = made["cpu"], made["cuda"]
    assert cuda.pruned == cpu.pruned == 5 and cuda.split == cpu.split > 0
    np.testing.assert_array_equal(cuda.model.ids, cpu.model.ids)
    np.testing.assert_allclose(cuda.model.rows[:, columns.MEAN], cpu.model.rows[:, columns.MEAN], atol=1e-4)
    path = tmp_path / "checkpoint.npz"
    checkpoint.save(cuda, path)
    other = resumed(clip, path, settings, "cpu")
    for name, array in arrays_of(cuda).items():
        np.testing.assert_array_equal(other.arrays()[name], array, err_msg=name)
    assert iterated(cuda, 1).residual == pytest.approx(iterated(other, 1).residual, rel=1e-5)
    assert relative_error(cuda.model.adam.moments, other.model.adam.moments) < 2e-4


@pytest.mark.parametrize("tokens", ["nodes", "self"])
def test_paths_are_learnt_as_on_the_cpu(clip: Clip, tokens: Any) -> None:
    cpu, cuda = (started(clip, dataclasses.replace(SMALL, tokens=tokens), kind) for kind in ("cpu", "cuda"))
    found, expected = arrays_of(cuda), arrays_of(cpu)
    np.testing.assert_array_equal(found["rows"], expected["rows"])  # the mapper plays on the CPU
    for name in ("cells.moments", "cells.shares", "decoder.moments"):
        assert relative_error(found[name], expected[name]) < 1e-4, name
    np.testing.assert_allclose(found["cells"], expected["cells"], atol=1e-5)
    np.testing.assert_allclose(found["residuals"], expected["residuals"], atol=1e-4)
    assert np.abs(expected["decoder.moments"]).max() > 0


class HostReads(TorchDispatchMode):
    """Counts the numbers that the host waits for."""

    count = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += function is torch.ops.aten._local_scalar_dense.default
        return function(*args, **(kwargs or {}))


def test_same_bits_again_whether_frames_stay_on_the_device_or_not(
    clip: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    once = iterated(started(clip, PAPER, "cuda"), 2)  # on the same frame
    with HostReads() as reads:
        once.iterate()
    assert reads.count == 1  # of pairs to sort
    monkeypatch.setattr(cuda_learner, "FRAMES_BYTES", 0)
    again = iterated(started(clip, PAPER, "cuda"), 3)
    for name, array in arrays_of(once).items():
        np.testing.assert_array_equal(again.arrays()[name], array, err_msg=name)


# ---- when it fails -----------------------------------------------------------------------------------------


def failing(monkeypatch: pytest.MonkeyPatch, of: type, name: str, at: int, error: Exception) -> None:
    """A method fails at its call of that number, and ever after."""
    method, calls = getattr(of, name), []

    def fails(*args: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) >= at:
            raise error
        return method(*args, **options)

    monkeypatch.setattr(of, name, fails)


@pytest.mark.parametrize(
    ("settings", "of", "name", "at", "error"),
    [
        (PAPER, CudaRasterizer, "draw", 2, DeviceMemoryError("too many pairs")),
        (PAPER, hexplane.HexPlane, "backward", 1, torch.OutOfMemoryError("out of memory")),
        (SMALL, hexplane.HexPlane, "backward", 2, torch.OutOfMemoryError("out of memory")),
        (SMALL, Loan, "copy", 1, torch.OutOfMemoryError("out of memory")),
    ],
    ids=["drawing", "field", "paths", "upload"],
)
def test_a_gpu_too_small_leaves_the_fit_to_the_cpu(
    clip: Clip, settings: FitSettings, of: type, name: str, at: int, error: Exception,
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """Nothing is lost, and no step is made twice."""
    expected = iterated(started(clip, settings), 3)
    failing(monkeypatch, of, name, at, error)
    made = iterated(started(clip, settings, "cuda"), 3)
    assert made.device == "cpu" and made.problem is not None
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == [
        made.problem
    ]
    assert "memory" in made.problem and "--max-gaussians" in made.problem
    assert made.iteration == expected.iteration == 3
    assert made.residual == pytest.approx(expected.residual, rel=1e-4)
    found = arrays_of(made)
    for part, array in arrays_of(expected).items():
        if part.endswith(".shares") or part in {"ids", "index", "seen"}:
            np.testing.assert_allclose(found[part], array, atol=1e-6, err_msg=part)


def test_a_gpu_that_fails_ends_the_fit_and_leaves_the_last_checkpoint(
    clip: Clip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "checkpoint.npz"
    made = iterated(started(clip, PAPER, "cuda"), 1)
    checkpoint.save(made, path)
    before = path.read_bytes()
    made.iterate()
    failing(monkeypatch, CudaRasterizer, "draw", 1, CUDA_ERROR)
    failing(monkeypatch, Loan, "download", 1, CUDA_ERROR)
    for work in (made.iterate, lambda: checkpoint.save(made, path), lambda: made.model):
        with pytest.raises(SagsError) as raised:
            work()
        said = str(raised.value)
        assert said.startswith("the GPU failed: CUDA error: an illegal memory access") and "\n" not in said
        assert "--resume" in said and "device:=cpu" in said
    assert path.read_bytes() == before
    assert iterated(resumed(clip, path, PAPER, "cpu"), 1).iteration == 2


# ---- the command -------------------------------------------------------------------------------------------


def write_clip(folder: Path) -> Path:
    """The sheet as a public data set has it, twice as large; a depth of 1 is a thousandth of a metre."""
    size = 2 * WIDTH, 2 * HEIGHT
    for number in range(4):
        frame = make_frame(number)
        for name, shown in (
            ("images", cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR)),
            ("masks", 255 * (~frame.tissue).astype(np.uint8)),
            ("depth", np.rint(1e3 * frame.depth).astype(np.uint8)),
        ):
            (folder / name).mkdir(parents=True, exist_ok=True)
            larger = cv2.resize(shown, size, interpolation=cv2.INTER_NEAREST)
            assert cv2.imwrite(str(folder / name / f"{number:06d}.png"), larger)
    matrix = np.column_stack([np.eye(3), np.zeros(3), [*size[::-1], 80.0]])
    np.save(folder / "poses_bounds.npy", np.tile(np.concatenate([matrix.ravel(), [40, 80]]), (4, 1)))
    return folder


def sags_fit(*arguments: str | Path) -> Any:
    return CliRunner().invoke(main, ["fit", *map(str, arguments)])


def test_the_command_fits_on_the_device_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sags_node.pipeline.warm_up.warm_up", lambda config: None)  # refines at full size
    options = "--schedule paper --warm-up 1 --iterations 0 --json --out".split()
    folder = write_clip(tmp_path / "sheet")
    for device, resume in (("cuda", ()), ("cpu", ("--resume",))):
        result = sags_fit(folder, *options, tmp_path / "fit", f"device:={device}", *resume)
        assert result.exit_code == 0, result.output
        found = json.loads(result.stdout)
        assert (found["device"], found["device_problem"]) == (device, None)


def test_the_command_without_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    missing = Device("cpu", "the CPU", "this machine has no NVIDIA GPU", "install its driver")
    monkeypatch.setattr(devices, "find_gpu", lambda: missing)
    result = sags_fit(write_clip(tmp_path / "sheet"), "--out", tmp_path / "fit", "device:=cuda")
    assert result.exit_code == 2 and result.stdout == ""
    said = result.stderr.splitlines()[-1]
    assert said.startswith("error: device: cuda cannot be used: this machine has no NVIDIA GPU")
