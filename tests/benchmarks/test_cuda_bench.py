"""`benchmarks kernels --device cuda`, in Triton's interpreter and with gsplat's stages in torch: everything
but the speed. Times mean nothing here; counts, comparisons and reports do."""

from __future__ import annotations

import copy
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import ANY
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from command_line import refused, sags
from engine_scenes import one_gaussian

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")
pytest.importorskip("gsplat", reason="the peer is not installed: pip install 'sags-node[gsplat]'")
if torch.cuda.is_available():
    pytest.skip("for machines without a GPU: here the command itself can be run", allow_module_level=True)

from gsplat_on_cpu import use_gsplat_on_cpu

from benchmarks.__main__ import main
from benchmarks.kernels import device as device_kernels
from benchmarks.kernels import device_peak, device_rasterizing
from benchmarks.kernels import gsplat as gsplat_rasterizing
from benchmarks.kernels.check import check
from benchmarks.kernels.device_rasterizing import DeviceDrawing, measure_device_rasterizer
from benchmarks.kernels.rasterizing import RasterCase
from benchmarks.kernels.timing import WALL, EventClock, median_ms, stage_clock
from sags_node.engine import device as devices
from sags_node.engine.cuda import layout
from sags_node.engine.cuda.gsplat import GsplatRasterizer
from sags_node.engine.cuda.rasterizer import CudaRasterizer
from sags_node.errors import UsageError
from sags_node.kernels.peak import MIB, Peak

# what the interpreter says of lanes without a Gaussian
pytestmark = [
    pytest.mark.filterwarnings("ignore::RuntimeWarning:triton.runtime.interpreter"),
    pytest.mark.usefixtures("quick_interpreter"),
]

CPU = torch.device("cpu")
CASE = RasterCase(count=12, width=32, height=24, threads=1)
Table = dict[str, Any]


@pytest.fixture(scope="module")
def with_gsplat() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        use_gsplat_on_cpu(patch)
        yield


@pytest.fixture(scope="module")
def quick(
    quick_interpreter: None, with_gsplat: None, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Table, Path]:
    """The table of a quick run, and the file it was written to."""
    file = tmp_path_factory.mktemp("bench") / "gpu.json"
    result = sags("kernels", "--device", "cuda", "--quick", "--json", "--out", file, command=main)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout), file


@pytest.fixture
def frozen(quick: tuple[Table, Path], monkeypatch: pytest.MonkeyPatch) -> Table:
    """The command measures this table again and again."""
    monkeypatch.setattr(device_kernels, "measure_device_kernels", lambda settings, advance: quick[0])
    return quick[0]


# ---- what is counted -------------------------------------------------------------------------------------


def test_work_of_one_gaussian(monkeypatch: pytest.MonkeyPatch) -> None:
    """It covers the picture of two tiles, one below the other, so it is evaluated at each of their pixels."""
    case = RasterCase(count=1, width=layout.TILE_WIDTH.value, height=2 * layout.TILE_HEIGHT.value, threads=1)
    _, view = device_rasterizing.make_scene(case)
    scene = one_gaussian(np.array([0, 0, 0.06]), scale=0.05)
    monkeypatch.setattr(device_rasterizing, "make_scene", lambda case: (scene, view))
    peak = Peak(threads=1, operations=1e5, bandwidths={MIB: 1e6})
    row = measure_device_rasterizer(case, 1, peak, WALL, CPU)
    pixels = case.width * case.height
    assert row["n"] == 1 and row["pixel_pairs"] == pixels
    stages = {stage["stage"]: stage for stage in row["stages"]}
    assert set(stages) == set(device_rasterizing.STAGES.values())
    for stage, operations in device_rasterizing.OPERATIONS_PER_PAIR.items():
        assert stages[stage]["bound"] == "arithmetic"
        least_ms = stages[stage]["share_of_peak"] * stages[stage]["ms"]
        assert least_ms == pytest.approx(1e3 * operations * pixels / 1e5)
    # two pairs of 48 bytes, twice what belongs to a splat, its colours, and where its pairs lie
    summed = 2 * 48 + 48 + 12 + 4 + 2 * 4
    assert stages["sum"]["bound"] == "memory"
    assert stages["sum"]["share_of_peak"] * stages["sum"]["ms"] == pytest.approx(1e3 * summed / 1e6)


def test_chains_compute_every_multiply_add() -> None:
    """y = y / 2 + 1, so many times, from the number of the chain."""
    results = torch.zeros(2 * device_peak.LANES)
    device_peak.run_chains(results, rounds=1)
    left = 0.5**device_peak.STEPS
    expected = np.arange(len(results)) * left + 2 * (1 - left)
    np.testing.assert_allclose(results.numpy(), expected, rtol=1e-6)
    probe = device_peak.Probe(programs=1, rounds=1, triad_bytes=(MIB, 2 * MIB))
    measured = device_peak.measure_device_peak(CPU, probe, WALL)
    assert 0 < measured.operations < 1e13
    assert list(measured.bandwidths) == [MIB, 2 * MIB]
    assert all(1e7 < rate < 1e14 for rate in measured.bandwidths.values())


def test_the_compiler_leaves_every_multiply_add_in_the_loop() -> None:
    """In the machine code of the kernel, for a GPU; in a process without the interpreter."""
    code = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from benchmarks.kernels.device_peak import SIGNATURES
for variant in SIGNATURES:
    names = variant.kernel.arg_names
    assert set(names) == set(variant.signature) | set(variant.constexprs)
    types = {name: variant.signature.get(name, "constexpr") for name in names}
    source = ASTSource(variant.kernel, types, dict(variant.constexprs))
    for architecture in (80, 90):
        options = {"num_warps": variant.num_warps}
        compiled = triton.compile(source, target=GPUTarget("cuda", architecture, 32), options=options)
        loop = compiled.asm["ptx"].split("\\n$L__BB0_")
        print(max(part.count("fma.rn.f32") for part in loop), compiled.asm["ptx"].count("mul.f32"))
"""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    chains = device_peak.LANES // (32 * device_peak.WARPS)
    assert done.stdout.split() == [str(chains * device_peak.STEPS), "0"] * 2


# ---- clocks ------------------------------------------------------------------------------------------------


class FakeEvent:
    """A GPU that needs one millisecond for each thing that is put into its queue."""

    queued = 0

    def __init__(self, enable_timing: bool) -> None:
        assert enable_timing
        self.reached = False

    def record(self) -> None:
        self.place = FakeEvent.queued

    def synchronize(self) -> None:
        self.reached = True

    def elapsed_time(self, end: FakeEvent) -> float:
        assert end.reached, "read before the GPU was there"
        return float(end.place - self.place)


def test_events_time_calls_and_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "Event", FakeEvent)

    def enqueue(things: int) -> None:
        FakeEvent.queued += things

    monkeypatch.setattr(gsplat_rasterizing, "median_ms", enqueue)  # any function of a module
    assert median_ms(lambda: enqueue(3), runs=4, clock=EventClock()) == 3.0
    with stage_clock({(gsplat_rasterizing, "median_ms"): "enqueue"}, EventClock()) as times:

        def step() -> None:
            for things in (2, 5):
                gsplat_rasterizing.median_ms(things)  # type: ignore[call-arg, arg-type]
                enqueue(100)

        assert times.medians_ms(step, runs=3) == {"enqueue": 7.0}


def test_the_clock_leaves_the_kernels_as_they_were() -> None:
    before = {key: getattr(*key) for key in device_rasterizing.STAGES}
    drawing = DeviceDrawing(CASE, CudaRasterizer(CASE.width, CASE.height, True, CPU))
    with stage_clock(device_rasterizing.STAGES) as times:
        drawing.forward()
    assert times.arguments["project"]["width"] == CASE.width
    assert {key: getattr(*key) for key in device_rasterizing.STAGES} == before


# ---- the table -------------------------------------------------------------------------------------------


def test_every_row_holds_plausible_values(quick: tuple[Table, Path]) -> None:
    table, file = quick
    assert json.loads(file.read_text()) == {"provenance": ANY} | table
    assert table["device"] == "CPU (Triton's interpreter)" and "interpreter" in table["clock"]
    assert table["gsplat"].startswith("gsplat 1.")
    (row,) = table["rasterize"]
    assert row["n"] == 8 and 0 < row["forward_ms"] < row["forward_backward_ms"]
    assert {stage["stage"] for stage in row["stages"]} == set(device_rasterizing.STAGES.values())
    for each in [row, *row["stages"]]:
        assert 0 < each["share_of_peak"] < math.inf
    assert row["pixel_pairs"] % layout.TILE_PIXELS.value == 0 and row["pixel_pairs"] > 32 * 16
    theirs = row["gsplat"]
    assert all(theirs[key] > 0 for key in theirs if key.endswith("_ms")) and len(theirs) == 6
    assert theirs["planes_apart"] < 1e-5 and theirs["gradients_apart"] < 1e-4


def test_gsplat_draws_the_same_scene_and_a_wrong_one_is_seen(with_gsplat: None) -> None:
    """Its own call gives the planes of the backend, and what is said to be apart is."""
    rasterizer = GsplatRasterizer(CASE.width, CASE.height, True, CPU)
    drawing = DeviceDrawing(CASE, rasterizer)
    plain = gsplat_rasterizing.PlainCall(drawing, rasterizer)
    planes, same = drawing.forward(), drawing.forward_backward()
    color_and_depth, alpha = plain.forward()
    assert torch.allclose(torch.cat([color_and_depth, alpha], 2).permute(2, 0, 1), planes, atol=1e-6)
    for own, name in zip(
        plain.forward_backward(), ("means", "quats", "scales", "opacities", "colors"), strict=True
    ):
        assert torch.allclose(own, getattr(same, name), rtol=1e-4, atol=1e-3), name
    drawing.gaussians.colors[3] += 0.5
    ours = DeviceDrawing(CASE, CudaRasterizer(CASE.width, CASE.height, True, CPU))
    apart = gsplat_rasterizing.apart(ours, drawing)
    assert apart["planes_apart"] > 0.05 and apart["gradients_apart"] > 1e-3


def test_tables_for_people(frozen: Table) -> None:
    result = sags("kernels", "--device", "cuda", command=main)
    assert result.exit_code == 0, result.output
    row = frozen["rasterize"][0]
    assert f"{row['gsplat']['forward_ms'] / row['forward_ms']:.2f}x" in result.stdout
    assert frozen["gsplat"] in result.stdout and "interpreter" in result.stdout
    for stage in row["stages"]:
        assert stage["stage"] in result.stdout and f"{stage['ms']:.3f}" in result.stdout


def test_without_gsplat_a_line_says_so(
    quick: tuple[Table, Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def missing() -> None:
        raise UsageError("it is not installed: pip install 'sags-node[gsplat]'")

    monkeypatch.setattr(device_kernels.gsplat_backend, "usable_device", missing)
    wanted, said = device_kernels.find_gsplat(wanted=True)
    assert not wanted
    table = copy.deepcopy(quick[0]) | {"gsplat": said}
    del table["rasterize"][0]["gsplat"]
    monkeypatch.setattr(device_kernels, "measure_device_kernels", lambda settings, advance: table)
    file = tmp_path / "gpu.json"
    result = sags("kernels", "--device", "cuda", "--out", file, command=main)
    assert "left out: it is not installed: pip install 'sags-node[gsplat]'" in result.stdout
    assert "project backward" in result.stdout
    assert "gsplat, backward" not in file.with_suffix(".svg").read_text()


def test_the_plot_has_a_bar_for_each(quick: tuple[Table, Path]) -> None:
    drawn = quick[1].with_suffix(".svg").read_text()
    assert ElementTree.fromstring(drawn).tag.endswith("svg")
    assert "composite backward" in drawn and "gsplat, backward" in drawn and "8 at 32x16" in drawn


# ---- the check, and what cannot be measured ----------------------------------------------------------------


def test_a_slower_kernel_is_found_and_another_device_is_refused(quick: tuple[Table, Path]) -> None:
    kept = copy.deepcopy(quick[0])
    for stage in kept["rasterize"][0]["stages"]:
        stage["ms"] += 1.0  # longer than what is too short to be compared
    now = copy.deepcopy(kept)
    now["rasterize"][0]["stages"][2]["ms"] *= 2
    slowest, other, *_ = check(lambda: now, kept, 1.3)
    assert slowest.ratio == pytest.approx(2) and "rasterize composite " in slowest.kernel
    assert other.ratio == pytest.approx(1)
    with pytest.raises(UsageError, match=r"the kept table is of the CPU, this run of CPU .Triton's interp"):
        check(lambda: now, {key: value for key, value in kept.items() if key != "device"}, 1.3)


def test_check_measures_without_gsplat(quick: tuple[Table, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def measure(settings: Any, advance: Any) -> Table:
        asked.append(settings)
        return quick[0]

    monkeypatch.setattr(device_kernels, "measure_device_kernels", measure)
    result = sags("kernels", "--device", "cuda", "--quick", "--check", quick[1], command=main)
    assert result.exit_code == 0, result.output
    assert [settings.gsplat for settings in asked] == [False]


def test_what_cannot_be_measured_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    command = ("kernels", "--device", "cuda")
    refused(2, *command, said=("interpreter is thousands of times too slow", "--quick"), command=main)
    refused(2, *command, "--large", said=("about the CPU's table",), command=main)
    monkeypatch.delenv("TRITON_INTERPRET")
    monkeypatch.setattr(devices, "has_gpu", lambda: False)
    devices.find_gpu.cache_clear()
    try:
        refused(2, *command, "--quick", said=("no NVIDIA GPU", "nvidia-smi", "or leave it out"), command=main)
    finally:
        devices.find_gpu.cache_clear()
