"""`benchmarks kernels --device cuda` on Warp's CPU device: everything but the speed."""

import pytest
import warp as wp
from warp_on_cpu import use_warp_on_cpu

from benchmarks.gpu.check import GpuCheck, gpu_check, measure_case
from sags_node.engine.gpu.rasterizer import DeviceRasterizer
from sags_node.errors import SagsError


def test_a_wrong_drawing_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    use_warp_on_cpu(monkeypatch)
    backward = DeviceRasterizer.backward
    monkeypatch.setattr(
        DeviceRasterizer, "backward", lambda self, v, w: backward(self, wp.array(2 * v.numpy()), w)
    )
    assert measure_case(8, 32, 16, 1)["colors_apart"] > 0.5


def test_a_gpu_that_fails_gives_no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the CPU's times would stand as the GPU's."""
    use_warp_on_cpu(monkeypatch)

    def fails(*_: object) -> None:
        raise RuntimeError("CUDA error")

    monkeypatch.setattr(DeviceRasterizer, "backward", fails)
    with pytest.raises(SagsError, match="CUDA error"):
        measure_case(8, 32, 16, 1)


def test_the_check_tries_everything_and_goes_on_after_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    use_warp_on_cpu(monkeypatch)
    figures = gpu_check(small=True, fit=False, say=lambda line: None)
    assert not [name for name, row in figures.items() if "error" in row]
    (apart,) = (row for name, row in figures.items() if name.startswith("parity"))
    assert apart["repeats"] and apart["gradients_apart"] < 1e-4

    def fails() -> None:
        raise RuntimeError("CUDA error")

    check = GpuCheck()
    check.part("first", fails, print)
    check.part("second", lambda: {"ms": 1.0}, print)
    assert "CUDA error" in check.figures["first"]["error"] and check.figures["second"] == {"ms": 1.0}
    check.seconds = -1.0
    check.part("third", fails, print)
    assert "time is up" in check.figures["third"]["error"]
