"""Every kernel that a small session calls, compiled and parallel, does what its Python source says.

Numba has been seen to share variables of a parallel loop between threads; only a comparison shows it. Vectors
know no Python: what their kernels compute is compared elsewhere, with twins of their own.
"""

import json
import struct
import sys
import threading
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import numpy as np
import pytest
import warp as wp
from numba.core.dispatcher import Dispatcher
from numba.extending import _Intrinsic
from places import SESSION

from sags_node.engine.gpu import binning, compositing, projection, runtime
from sags_node.engine.gpu.binning import LANES
from sags_node.kernels.jit import PIECE
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.gpu import kernels
from sags_node.model.light import light_gain
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session

PARTS = (  # of the package, that a frame goes through
    "mapping", "vision", "engine.rasterizer", "engine.losses.tissue", "model.deformation", "model.light",
    "model.alias_free",
)  # fmt: skip
ELSEWHERE = {"mapping.focus.sum_residuals", "mapping.focus._sum_row"}  # tests/mapping/test_focus.py
# They read images in the pixel in which a Gaussian is seen. Four roundings of 6e-8 at 128 px are 3e-5 px.
# So near to a border, on either side and along two axes, lie 1.2e-4 of the places: either pixel is right.
LOOKED_UP, NEAR_A_BORDER = {"mapping.surface._find_surface"}, 1e-3
# They round to whole levels. Ten roundings of 6e-8 of 255 are 1.5e-4 of a level: so many are the next one.
ROUNDED = {"detail.carry._trace"}
SMALL = ["source.pace:=step", "source.frames:=4", "vision.width:=128", "vision.height:=96"]
SMALL += ["publish.right:=true", "vision.tissue.method:=classical", "vision.pose:=refine"]


def names_of(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield from names_of(part)


def used_by(kernel: Any) -> set[Any]:
    found = [kernel.py_func.__globals__.get(name) for name in names_of(kernel.py_func.__code__)]
    return {each for each in found if isinstance(each, Dispatcher | _Intrinsic)}


@cache
def is_python(kernel: Any) -> bool:
    """Whether its source runs without a compiler: nothing that it calls is an intrinsic."""
    used = used_by(kernel)
    return not any(isinstance(each, _Intrinsic) for each in used) and all(
        is_python(each) for each in used if isinstance(each, Dispatcher) and each is not kernel
    )


def copy_of(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.copy(order="K")
    if isinstance(value, tuple):
        parts = [copy_of(part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def assert_same(compiled: Any, source: Any, where: str) -> None:
    if isinstance(compiled, tuple):
        for one, other in zip(compiled, source, strict=True):
            assert_same(one, other, where)
    elif compiled is None or isinstance(compiled, str):
        assert compiled == source, where
    elif np.asarray(compiled).dtype.kind == "f":
        size = np.nanmax(np.abs(source), initial=0, where=np.isfinite(source))
        if where in LOOKED_UP:
            same = np.isclose(compiled, source, rtol=1e-4, atol=1e-5 * size)
            assert np.mean(~same) < NEAR_A_BORDER, where
            return
        np.testing.assert_allclose(compiled, source, rtol=1e-4, atol=1e-5 * size, err_msg=where)
    elif where in ROUNDED:
        apart = np.abs(np.asarray(compiled, int) - np.asarray(source, int))
        assert apart.max(initial=0) <= 1 and apart.sum() <= 1 + NEAR_A_BORDER * apart.size, where
    else:
        np.testing.assert_array_equal(compiled, source, err_msg=where)


class Comparison:
    """In place of the call of any kernel from Python."""

    def __init__(self) -> None:
        self.reached: set[str] = set()
        self.compared: set[str] = set()  # in this frame: each is once
        self._compiled = Dispatcher.__call__
        self._here = threading.local()  # `python`: this thread is inside of a source

    def __call__(self, kernel: Any, *arguments: Any) -> Any:
        name = f"{kernel.py_func.__module__}.{kernel.py_func.__name__}".removeprefix("sags_node.")
        if not is_python(kernel):
            return self._compiled(kernel, *arguments)
        if getattr(self._here, "python", False):
            self.reached.add(name)
            return kernel.py_func(*arguments)
        if name in self.compared:
            return self._compiled(kernel, *arguments)
        self.compared.add(name)
        given = copy_of(arguments)
        result = self._compiled(kernel, *arguments)
        self.reached.add(name)
        self._here.python = True
        try:
            with np.errstate(all="ignore"):
                expected = kernel.py_func(*given)
        finally:
            self._here.python = False
        assert_same(result, expected, name)
        assert_same(arguments, given, name)
        return result


def required() -> set[str]:
    """The kernels of a frame whose source is Python, but for those that only kernels of vectors call."""
    parts = tuple(f"sags_node.{part}" for part in PARTS)
    every = {
        each: f"{each.py_func.__module__}.{each.py_func.__name__}".removeprefix("sags_node.")
        for module in list(sys.modules.values())
        if module.__name__.startswith(parts)
        for each in vars(module).values()
        if isinstance(each, Dispatcher) and each.py_func.__module__.startswith(parts)
    }
    calls = {kernel: every.keys() & used_by(kernel) for kernel in every}
    inlined = {kernel for kernel in every if kernel.targetoptions.get("forceinline")}
    found = every.keys() - inlined - {each for kernel in every for each in calls[kernel] - {kernel}}
    while more := {each for kernel in found if is_python(kernel) for each in calls[kernel]} - found:
        found |= more
    return {every[kernel] for kernel in found if is_python(kernel)}


def test_compiled_kernels_do_what_their_source_says(monkeypatch: pytest.MonkeyPatch) -> None:
    compare = Comparison()

    def call(kernel: Any, *arguments: Any) -> Any:  # a function: only that becomes a method
        return compare(kernel, *arguments)

    monkeypatch.setattr(Dispatcher, "__call__", call)
    session = open_session(SESSION, SMALL)
    pipeline, budget = Pipeline(session.config, session.rig), StepBudget(1)
    with session.source as source:
        for frame in source:
            compare.compared.clear()
            pipeline.process(frame, budget)
            pipeline.map.model.adam_m[3::40] = np.inf  # they are set right
    model = pipeline.map.model
    assert len(model.means) > 2 * PIECE  # several threads share them
    normals, lamps = np.full_like(model.means, 0.6), np.stack([np.eye(4)] * 2)
    lamps[1, :3, 3] = 0.01
    light_gain(model.means, normals, model.node_index, model.node_weight, *lamps)
    assert len(compare.reached) > 60 and required() - compare.reached <= ELSEWHERE


# ---- The kernels for a GPU, compiled by Warp's own NVRTC, which needs neither card nor toolkit. ----


REGISTERS, SHARED = 65536, 100 * 1024  # of a multiprocessor, the second in bytes: compute capability 8.6
BLOCKS = 2  # at least so many at a time, else nothing is computed while one waits for memory
ARCH = 86


def registers(cubin: bytes) -> dict[str, int]:
    """Of a thread of each kernel: the upper byte of `sh_info` of its code's section."""
    table, size, count, names = struct.unpack_from("<Q", cubin, 40) + struct.unpack_from("<3H", cubin, 58)
    sections = [struct.unpack_from("<IIQQQQII", cubin, table + size * i) for i in range(count)]
    names_at = sections[names][4]
    found = {}
    for name, _, _, _, _, _, _, info in sections:
        start = names_at + name
        text = cubin[start : cubin.index(b"\0", start)].decode()
        if text.startswith(".text."):
            found[text.removeprefix(".text.")] = info >> 24
    return found


@pytest.mark.parametrize("module", [projection, binning, compositing, kernels])
def test_two_blocks_of_each_kernel_fit_a_multiprocessor(module: ModuleType, tmp_path: Path) -> None:
    runtime.start()
    wp.compile_aot_module(module, device=None, arch=ARCH, module_dir=str(tmp_path), use_ptx=False)
    (cubin,), (meta,) = tmp_path.glob("*.cubin"), tmp_path.glob("*.meta")
    taken = registers(cubin.read_bytes())
    assert len(taken) >= 2 and min(taken.values()) >= 8
    assert BLOCKS * LANES * max(taken.values()) <= REGISTERS, taken
    shared = [size for name, size in json.loads(meta.read_text()).items() if name.endswith("smem_bytes")]
    assert shared and BLOCKS * max(shared) <= SHARED
