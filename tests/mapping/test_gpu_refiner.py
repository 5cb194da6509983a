"""The mapper with `GpuRefiner`, here on Warp's CPU device, against the mapper on the CPU, and what happens
when a GPU fails."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
import warp as wp
from engine_scenes import as_bytes
from following import Following
from warp_on_cpu import use_warp_on_cpu

from sags_node.config.schema import LaunchConfig, MappingConfig
from sags_node.engine.gpu.rasterizer import DeviceRasterizer
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.errors import UsageError
from sags_node.mapping import densify, exposure, mapper
from sags_node.mapping.anchors import Anchors
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.devices import Skips
from sags_node.mapping.gpu.device_map import REFINED, DeviceMap
from sags_node.mapping.gpu.refiner import GpuRefiner
from sags_node.mapping.mapper import Mapper
from sags_node.mapping.optimiser import LearningRates
from sags_node.mapping.refiner import CpuRefiner, Refiner
from sags_node.mapping.tissue_map import TissueMap
from sags_node.pipeline import warm_up
from sags_node.pipeline.pipeline import Pipeline
from sags_node.quality import metrics
from sags_node.quality.metrics import as_float
from sags_node.rig import rectified_rig
from sags_node.types import F32, Camera, Observation, RenderedView, Snapshot, StereoFrame, StereoRig

WIDTH, HEIGHT, FOCAL, BASELINE, DEPTH = 48, 24, 60.0, 0.004, 0.056
CAPACITY = 72
SAME_PSNR = 0.02  # dB
CPU_SHARE = 0.5
CUDA_ERROR = RuntimeError("CUDA error: an illegal memory access was encountered\nand much more")


@pytest.fixture(autouse=True)
def small_mapper(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapper, "FIRST_STEPS", 1)
    monkeypatch.setattr(mapper, "CONTROL_NODES", 8)
    monkeypatch.setattr(exposure, "LEAST_PIXELS", 8)
    use_warp_on_cpu(monkeypatch)


def texture(seed: int) -> F32:
    coarse = np.random.default_rng(seed).uniform(0.2, 0.8, (5, 16, 3)).astype(np.float32)
    return cv2.resize(coarse, (WIDTH + 48, HEIGHT))


def frame(i: int, seed: int = 1, brightness: float = 1.0, instrument: bool = True) -> Observation:
    """A tilted sheet that moves by a pixel per frame to the left, partly hidden."""
    image = as_bytes(texture(seed)[:, i : i + WIDTH] * brightness)
    K = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
    tissue = np.ones((HEIGHT, WIDTH), np.bool_)
    tissue[5:15, 29:39] = not instrument
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    depth = (DEPTH + 1e-4 * x + 1.3e-4 * y).astype(np.float32) * tissue  # no two Gaussians lie equally far
    return Observation(
        i, i * 33_000_000, Camera(WIDTH, HEIGHT, K, np.eye(4)), image,
        image.mean(2).astype(np.uint8), tissue, depth, np.ones_like(depth),
    )  # fmt: skip


def psnr(view: RenderedView, observation: Observation) -> float:
    return metrics.psnr(as_float(view.rgb), as_float(observation.image), observation.tissue)


class Played:
    """A mapper that has taken frames in, as the pipeline lets it."""

    def __init__(self, refiner: Refiner, capacity: int = CAPACITY) -> None:
        self.refiner, self.mapper = refiner, Mapper(refiner, TissueMap(capacity))
        self._frames = Following(self.mapper)

    def take(self, observation: Observation, steps: int = 1, still: int = 0) -> tuple[Snapshot, RenderedView]:
        mapped = self._frames.take(observation, StepBudget(steps), still)
        return mapped.snapshot, mapped.view

    def begin(self, observation: Observation) -> None:
        """Take a frame in by hand."""
        assert self.mapper.map.deformation is not None
        self.refiner.begin(self.mapper.model, self.mapper.map.deformation, observation, 1e-4)

    def row(self, name: str) -> np.ndarray:
        return np.array(getattr(self.mapper.model, name))


def on_cpu(capacity: int = CAPACITY) -> Played:
    return Played(CpuRefiner(partial(make_rasterizer, "numba")), capacity)


def on_device(capacity: int = CAPACITY) -> Played:
    return Played(GpuRefiner(CpuRefiner(partial(make_rasterizer, "numba")), CPU_SHARE), capacity)


def half(observation: Observation) -> Observation:
    """The left half is hidden."""
    hidden = np.s_[:, : WIDTH // 2]
    observation.tissue[hidden], observation.depth[hidden] = False, 0
    return observation


ADAM_COLUMNS = {
    "means": slice(0, 3), "quats": slice(3, 7), "scales": slice(7, 10), "log_scales": slice(7, 10),
    "opacities": slice(10, 11), "opacity_logits": slice(10, 11),
}  # fmt: skip


def assert_same_rows(a: Played, b: Played) -> None:
    """After one step. Where a gradient is zero but for rounding, as that of a round Gaussian that is turned
    around its axis, Adam makes a full step of its sign: such values are left out."""
    assert np.array_equal(a.row("ids"), b.row("ids"))
    for name in REFINED:
        expected, found = a.row(name), b.row(name)
        if name in ADAM_COLUMNS:
            slopes = np.abs(a.row("adam_m")[:, ADAM_COLUMNS[name]]).reshape(expected.shape)
            matters = slopes > 1e-4 * slopes.max()
            assert matters.mean() > 0.3, name
            expected, found = expected[matters], found[matters]
        np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-5, err_msg=name)
    nodes_a, nodes_b = (p.mapper.map.deformation.nodes for p in (a, b) if p.mapper.map.deformation)
    np.testing.assert_allclose(nodes_b, nodes_a, atol=1e-7)


def test_a_step_is_the_cpus() -> None:
    """The whole of it: drawing, loss, gradients, nodes, optimiser, and the way there and back."""
    cpu, device = on_cpu(), on_device()
    for played in (cpu, device):
        played.take(frame(0))
    assert_same_rows(cpu, device)
    assert device.refiner.loss == pytest.approx(cpu.refiner.loss, rel=1e-4)


STREAMS: dict[str, tuple[Callable[[], list[Observation]], int, str]] = {
    "motion, an instrument leaves, a jump of the exposure": (
        lambda: [frame(0), frame(1), frame(2, instrument=False), frame(3, brightness=0.8)],
        CAPACITY,
        "inserted",
    ),
    "a full model is fetched and sent again": (lambda: [frame(0), frame(4), frame(8)], 56, "removed"),
    "tissue that comes into view gets nodes": (lambda: [half(frame(0)), frame(1)], CAPACITY, "inserted"),
}


@pytest.mark.parametrize("stream", STREAMS)
def test_a_stream_is_taken_in_as_on_the_cpu(stream: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(densify, "LITTLE", 1e9)  # whatever shows least may go
    frames, capacity, happens = STREAMS[stream]
    found = []
    for played in (on_cpu(capacity), on_device(capacity)):
        anchors, errors, counts = Anchors(), [], []
        for observation in frames():
            snapshot, view = played.take(observation, steps=2)
            if observation.frame_id == 0:
                anchors.add_pixel(40.0, 20.0, observation, snapshot, view)
            anchors.update(observation, snapshot, view)
            errors.append(psnr(view, observation))
            counts.append(dict(snapshot.counts))
        found.append((errors, counts, snapshot.step, snapshot.loss, anchors.states().points, played))
    (errors, counts, step, loss, points, cpu), (*on_gpu, device) = found
    assert min(errors) > 19 and sum(each.get(happens, 0) for each in counts[1:]) > 2
    np.testing.assert_allclose(on_gpu[0], errors, atol=SAME_PSNR)
    assert on_gpu[1] == counts and on_gpu[2] == step
    assert 0 < on_gpu[3] < 1.05 * loss  # the CPU's counts what it did not draw anew
    np.testing.assert_allclose(on_gpu[4], points, atol=1e-5)
    np.testing.assert_array_equal(device.row("ids"), cpu.row("ids"))
    np.testing.assert_allclose(device.row("means"), cpu.row("means"), atol=1e-5)
    np.testing.assert_allclose(device.row("colors"), cpu.row("colors"), atol=1e-2)
    nodes = device.mapper.map.deformation.nodes
    assert len(nodes) == len(cpu.mapper.map.deformation.nodes)
    assert isinstance(device.refiner, GpuRefiner)
    np.testing.assert_array_equal(device.refiner.on_gpu.nodes.numpy(), nodes)


@pytest.mark.parametrize("fails", [False, True])
def test_the_model_is_the_devices_until_all_of_it_is_fetched_and_adams_moments_stay_there(
    fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    played = on_device()
    played.take(frame(0))
    played.begin(frame(1))
    played.refiner.draw()
    before = {name: played.row(name) for name in REFINED}
    played.refiner.refine(LearningRates())
    played.refiner.refine_worst(0.3, LearningRates())
    assert all(np.array_equal(before[name], played.row(name)) for name in REFINED)
    if fails:
        break_(monkeypatch, wp.array, "numpy", CUDA_ERROR, 2)  # the loss came, the nodes do not
    played.refiner.download()
    assert (played.refiner.problem is not None) == fails
    assert all(np.array_equal(before[name], played.row(name)) == fails for name in REFINED)
    assert not played.row("adam_m").any() and not played.row("adam_v").any()


def test_adams_moments_follow_their_gaussians() -> None:
    """As on the CPU: the last rows move into the holes of those that are removed; a new one has none."""
    cpu, device = on_cpu(), on_device()
    for played in (cpu, device):
        played.take(frame(0))
        count = played.mapper.model.count
        played.mapper.model.remove(np.isin(np.arange(count), [3, 4, count - 2]))
        played.mapper.model.append(*(np.full((1, 3), value, np.float32) for value in (0.05, 1e-3, 0.5)), 0.5)
        played.begin(frame(0))
    assert device.refiner.loss == pytest.approx(cpu.refiner.loss, rel=1e-4)
    assert isinstance(device.refiner, GpuRefiner)
    count = cpu.mapper.model.count
    moments = device.refiner.on_gpu.adam_m.numpy()[:count]
    slopes = cpu.row("adam_m")
    np.testing.assert_allclose(moments, slopes, atol=1e-4 * np.abs(slopes).max())
    assert not moments[-1].any() and moments[3].any()


def test_a_new_model_is_begun_on_the_device() -> None:
    played = on_device()
    first, _ = played.take(frame(0))
    negative = replace(frame(1), image=255 - frame(1, seed=5).image)
    played.mapper.map.restart()
    snapshot, view = played.take(negative)
    assert played.mapper.map.restarts == 1
    assert snapshot.gaussians.ids.min() > first.gaussians.ids.max()
    assert psnr(view, negative) > 18
    snapshot, view = played.take(replace(negative, frame_id=2, t_capture_ns=66_000_000))
    assert "restarted" not in snapshot.counts and psnr(view, negative) > 18


@pytest.mark.parametrize("where", ["means", "adam_m", "node_weight", "momentum"])
def test_damage_is_healed(where: str) -> None:
    """On its way through the device too; nodes are damaged for good on neither, but they move nothing."""
    played = on_device()
    played.take(frame(0))
    deformation = played.mapper.map.deformation
    count = played.mapper.model.count
    if where in {"adam_m", "momentum"}:
        assert isinstance(played.refiner, GpuRefiner)
        getattr(played.refiner.on_gpu, where).numpy()[5] = np.nan
    else:
        getattr(played.mapper.model, where)[5] = np.nan
    _, view = played.take(frame(1))
    for name in REFINED:
        assert not np.isnan(played.row(name)).any(), name
    assert np.isfinite(deformation.nodes).all()
    assert psnr(view, frame(1)) > 18 and played.mapper.model.count > 0.9 * count


# ---- when the device fails ---------------------------------------------------------------------------------


def break_(
    monkeypatch: pytest.MonkeyPatch, owner: Any, method: str, error: Exception, call: int = 1
) -> list[str]:
    """Let that call of a method fail, and all after it. Returns a list of the calls that were made."""
    works, calls = getattr(owner, method), list[str]()

    def may_fail(*args: Any, **names: Any) -> Any:
        calls.append(method)
        if len(calls) >= call:
            raise error
        return works(*args, **names)

    monkeypatch.setattr(owner, method, may_fail)
    return calls


LOST = CUDA_ERROR, "gpu_failed: .*illegal memory access.*restart the node"
FULL = (
    RuntimeError("Failed to allocate 2147483648 bytes on device 'cuda:0'"),
    "gpu_memory: .*Failed to allocate.*lower mapping.max_gaussians",
)


@pytest.mark.fault("GPU: lost (simulated, in each of three calls)")
@pytest.mark.parametrize(
    ("owner", "method", "call", "error", "said"),
    [
        (DeviceRasterizer, "forward", 2, *LOST),
        (DeviceMap, "take", 2, *LOST),
        (DeviceMap, "download", 1, *LOST),
        pytest.param(
            *(DeviceRasterizer, "backward", 1, *FULL),
            marks=pytest.mark.fault("GPU: out of memory (simulated)"),
        ),
    ],
)
def test_an_error_anywhere_leaves_the_cpu_to_go_on_and_says_why(
    owner: type, method: str, call: int, error: Exception, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the first and later drawings, in a step, while the model is sent, and while it is fetched."""
    played = on_device()
    first, _ = played.take(frame(0))
    calls = break_(monkeypatch, owner, method, error, call)
    snapshot, view = played.take(frame(1), steps=2)
    assert len(calls) == call  # and never again
    assert snapshot.counts["iterations"] == 2 and psnr(view, frame(1)) > 19
    assert np.isin(first.gaussians.ids, snapshot.gaussians.ids).mean() > 0.9
    problem = played.refiner.problem
    assert problem is not None and re.match(said, f"{problem.code}: {problem.text}", re.DOTALL)
    assert "and much more" not in problem.text
    assert played.refiner.share == CPU_SHARE
    after, view = played.take(frame(2))
    assert len(calls) == call and psnr(view, frame(2)) > 19 and after.loss > 0


def test_a_failure_before_the_first_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no model yet that the CPU could take."""
    played = on_device()
    break_(monkeypatch, DeviceRasterizer, "forward", CUDA_ERROR)
    played.refiner.show(played.mapper.model.gaussians(), frame(0).camera)
    assert played.refiner.problem is not None
    snapshot, _ = played.take(frame(0))
    assert 20 < len(snapshot.gaussians) <= CPU_SHARE * CAPACITY


def test_the_cpu_is_ready_to_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else its kernels would be compiled while the video runs."""
    made: list[str] = []

    def noted(config: LaunchConfig, rig: StereoRig) -> Pipeline:
        made.append(config.device)
        return Pipeline(config.model_copy(update={"device": "cpu"}), rig)

    monkeypatch.setattr(warm_up, "Pipeline", noted)
    warm_up.warm_up(LaunchConfig(device="cuda"))
    assert made == ["cpu", "cuda"]


def test_a_request_that_is_wrong_is_no_fault_of_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    played = on_device()
    break_(monkeypatch, DeviceRasterizer, "forward", UsageError("tiles have another shape"))
    with pytest.raises(UsageError):
        played.take(frame(0))


@pytest.mark.fault("GPU: taken or full before the first frame (simulated)")
@pytest.mark.parametrize(
    ("before", "owner", "call", "error", "code"),
    [
        (0, wp, "zeros", RuntimeError("Failed to allocate 16384 bytes on device 'cuda:0'"), "gpu_memory"),
        (2, DeviceRasterizer, "backward", CUDA_ERROR, "gpu_failed"),
    ],
    ids=["its memory is full", "it fails in the third frame"],
)
def test_the_pipeline_goes_on_with_the_cpu_and_says_so(
    before: int, owner: Any, call: str, error: Exception, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After so many frames on the device. Errors as Warp raises them."""
    monkeypatch.setattr("sags_node.vision.stereo.SMALLEST_SIDE", 16)  # the frames bring their depth
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    config = LaunchConfig(device="cuda", mapping=MappingConfig(max_gaussians=100))
    calls = [] if before else break_(monkeypatch, owner, call, error)
    pipeline = Pipeline(config, rectified_rig("sheet", WIDTH, HEIGHT, K, BASELINE), skips=Skips(still=False))
    for i in range(before + 1):
        if before and i == before:
            assert "device" not in pipeline.warnings
            calls = break_(monkeypatch, owner, call, error)
        shown = frame(i)
        stamp, left = shown.t_capture_ns, shown.image
        given = StereoFrame(i, stamp, stamp, left, left, tissue=shown.tissue, depth=shown.depth)
        result = pipeline.process(given, StepBudget(1))
    assert calls  # it was the device that was asked
    assert psnr(result.views["left"], shown) > 19 and len(result.snapshot.gaussians) > 40
    (problem,) = pipeline.warnings["device"]
    assert problem.code == code and "the CPU goes on" in problem.text
