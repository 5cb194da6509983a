"""The rasteriser beside a hand-written C++ program that draws the same scene, in one run.

A ratio of two times on one machine in one run says how good machine code is; the times themselves say more
about the machine. The program is one file, not part of this project. It is compiled for this processor, and
exports what `Program` calls: project, sort, bin, blend, and the same backwards. It gives no
contributions, which ours does, and its screen filter is 0.3 px^2.
"""

from __future__ import annotations

import ctypes
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from benchmarks.kernels.rasterizing import Drawing, RasterCase, make_cotangents, make_scene
from benchmarks.kernels.timing import WARM_UP_CALLS
from sags_node.engine.rasterizer.arguments import view_of
from sags_node.errors import SagsError
from sags_node.evaluation.provenance import machine_name
from sags_node.kernels.jit import aligned
from sags_node.kernels.threads import configure_threads
from sags_node.types import F32

FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC", "-DTH=32")
COMPILE_S = 120.0
MAX_THREADS = 8  # the program has that many buffers
PAIRS_PER_GAUSSIAN, MIN_PAIRS = 40, 200_000  # room for them
MILLIMETRE = 1e3  # its unit of length, in ours

Advance = Callable[[int, int, str], None]  # done, total, what comes next


@dataclass(frozen=True, slots=True)
class YardstickSettings:
    """What is compared."""

    counts: tuple[int, ...] = (10_000, 30_000, 100_000)  # Gaussians
    width: int = 640  # px
    height: int = 512
    runs: int = 31  # per median


QUICK = YardstickSettings(counts=(500,), width=64, height=64, runs=3)


def measure_yardstick(source: Path, settings: YardstickSettings, advance: Advance) -> dict[str, Any]:
    """Both, for each count of Gaussians; keys as benchmarks/README.md lists them.

    Raises:
        SagsError: there is no g++, or it does not compile the file to what is needed.
    """
    threads = configure_threads(MAX_THREADS)
    rows = []
    with compiled(source, threads) as library:
        for done, count in enumerate(settings.counts):
            advance(done, len(settings.counts), f"{count} Gaussians")
            rows.append(
                _compare(library, RasterCase(count, settings.width, settings.height, threads), settings.runs)
            )
    return {"machine": machine_name(), "threads": threads, "yardstick": rows}


def _compare(library: ctypes.CDLL, case: RasterCase, runs: int) -> dict[str, Any]:
    ours, program = Drawing(case), Program(library, case)
    forward_ms, program_forward_ms = _alternate(ours.forward, program.forward, runs)
    both_ms, program_both_ms = _alternate(ours.forward_backward, program.forward_backward, runs)
    return {
        "n": len(ours.gaussians),
        "width": case.width,
        "height": case.height,
        "forward_ms": forward_ms,
        "yardstick_forward_ms": program_forward_ms,
        "forward_ratio": forward_ms / program_forward_ms,
        "forward_backward_ms": both_ms,
        "yardstick_forward_backward_ms": program_both_ms,
        "forward_backward_ratio": both_ms / program_both_ms,
        "pictures_apart": float(np.abs(program.picture - ours.forward()[:3]).mean()),
    }


def _alternate(one: Callable[[], object], other: Callable[[], object], runs: int) -> tuple[float, float]:
    """Medians of both, ms. Each is called twice in its turn and the second call counts: its data are then in
    the caches as if it were alone. Who comes first changes from turn to turn."""
    times: tuple[list[float], list[float]] = [], []
    for turn in range(-WARM_UP_CALLS, runs):
        for which in (0, 1) if turn % 2 else (1, 0):
            function = (one, other)[which]
            function()
            start = time.perf_counter()
            function()
            taken = 1e3 * (time.perf_counter() - start)
            if turn >= 0:
                times[which].append(taken)
    return statistics.median(times[0]), statistics.median(times[1])


@contextmanager
def compiled(source: Path, threads: int) -> Iterator[ctypes.CDLL]:
    compiler = shutil.which("g++")
    if compiler is None:
        raise SagsError("the yardstick is a C++ program and needs g++, which is not here; install it")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "yardstick.so"
        try:
            done = subprocess.run(
                [compiler, *FLAGS, str(source), "-o", str(library)],
                capture_output=True, text=True, check=False, timeout=COMPILE_S,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise SagsError(f"g++ did not compile {source} within {COMPILE_S:.0f} s") from None
        if done.returncode != 0:
            errors = [line for line in done.stderr.splitlines() if "error" in line] or [done.stderr.strip()]
            raise SagsError(f"g++ does not compile {source}: {errors[0]}")
        loaded = ctypes.CDLL(str(library))
        missing = [name for name in FUNCTIONS if not hasattr(loaded, name)]
        if missing:
            raise SagsError(f"{source} is no yardstick: it does not define {', '.join(missing)}")
        loaded.bin.restype = ctypes.c_int64
        loaded.omp_set_num_threads(threads)
        yield loaded


FUNCTIONS = (
    "tile_w", "tile_h", "proj_fwd", "depth_sort", "bin", "comp_fwd", "comp_bwd", "reduce_pairs", "proj_bwd",
    "omp_set_num_threads",
)  # fmt: skip


class _Camera(ctypes.Structure):
    _fields_ = (
        ("R", ctypes.c_float * 9), ("t", ctypes.c_float * 3), ("fx", ctypes.c_float), ("fy", ctypes.c_float),
        ("cx", ctypes.c_float), ("cy", ctypes.c_float), ("width", ctypes.c_int), ("height", ctypes.c_int),
    )  # fmt: skip


class Program:
    """The C++ program with a case's scene and its buffers."""

    def __init__(self, library: ctypes.CDLL, case: RasterCase) -> None:
        self._library = library
        gaussians, camera = make_scene(case)
        n = self._count = len(gaussians)
        given = (
            gaussians.means * MILLIMETRE, gaussians.quats, gaussians.scales * MILLIMETRE,
            gaussians.opacities, gaussians.colors,
        )  # fmt: skip
        self._inputs = [_Buffer(array.shape, np.float32, array) for array in given]
        view = view_of(camera)
        self._camera = _Camera(
            (ctypes.c_float * 9)(*view[:9]), (ctypes.c_float * 3)(*(view[9:12] * MILLIMETRE)),
            *view[12:16], case.width, case.height,
        )  # fmt: skip
        tile_width, tile_height = library.tile_w(), library.tile_h()
        columns, rows = -(-case.width // tile_width), -(-case.height // tile_height)
        self._size = case.width, case.height
        self._padded = columns * tile_width, rows * tile_height
        planes = (5, self._padded[1], self._padded[0])
        self._room = max(PAIRS_PER_GAUSSIAN * n, MIN_PAIRS)
        self._splats, self._gradients = _Buffer((n, 16)), _Buffer((n, 16))
        self._radii, self._depths = _Buffer((n, 2)), _Buffer((n,))
        self._order, self._spare = _Buffer((n,), np.uint32), _Buffer((3 * n,), np.uint32)
        self._firsts, self._counts = _Buffer((n + 1,), np.uint32), _Buffer((n,), np.uint32)
        self._pairs, self._v_pairs = _Buffer((self._room, 3), np.uint32), _Buffer((self._room, 16))
        self._starts = _Buffer((columns * rows + 1,), np.uint32)
        self._ends = _Buffer((columns * rows,), np.uint32)
        self._statistics = _Buffer((2,), np.int64)
        self._planes, self._v_planes = _Buffer(planes), _Buffer(planes)
        self._v_planes.array[:, : case.height, : case.width] = make_cotangents(case)[0]
        self._v_planes.array[3] /= MILLIMETRE  # of the depth
        self._outputs = [_Buffer(array.shape) for array in given]

    @property
    def picture(self) -> F32:
        """[3, H, W], of the last drawing."""
        width, height = self._size
        return self._planes.array[:3, :height, :width]

    def forward(self) -> None:
        call, camera, n = self._library, ctypes.byref(self._camera), self._count
        inputs = [each.pointer for each in self._inputs]
        call.proj_fwd(n, *inputs, camera, self._splats.pointer, self._radii.pointer, self._depths.pointer)
        call.depth_sort(n, self._depths.pointer, self._order.pointer, self._spare.pointer)
        found = call.bin(
            n, self._splats.pointer, self._radii.pointer, self._order.pointer, *self._size,
            self._firsts.pointer, self._counts.pointer, self._pairs.pointer, ctypes.c_int64(self._room),
            self._starts.pointer, 1,
        )  # fmt: skip
        if found < 0:
            raise SagsError(f"the yardstick needs room for {-found} pairs, and has it for {self._room}")
        call.comp_fwd(
            self._splats.pointer, self._pairs.pointer, self._starts.pointer, *self._size, *self._padded,
            self._planes.pointer, self._ends.pointer, self._statistics.pointer, 1,
        )  # fmt: skip

    def forward_backward(self) -> None:
        self.forward()
        call, camera, n = self._library, ctypes.byref(self._camera), self._count
        call.comp_bwd(
            self._splats.pointer, self._pairs.pointer, self._starts.pointer, self._ends.pointer, *self._size,
            *self._padded, self._planes.pointer, self._v_planes.pointer, self._v_pairs.pointer, n, 0,
        )  # fmt: skip
        call.reduce_pairs(
            n, self._firsts.pointer, self._counts.pointer, self._v_pairs.pointer, self._gradients.pointer
        )
        inputs, outputs = ([each.pointer for each in some] for some in (self._inputs[:4], self._outputs))
        call.proj_bwd(n, *inputs, camera, self._splats.pointer, self._gradients.pointer, *outputs)


class _Buffer:
    """An array that starts on a cache line, as the program takes it."""

    def __init__(
        self, shape: tuple[int, ...], dtype: DTypeLike = np.float32, values: NDArray[Any] | None = None
    ) -> None:
        self.array = aligned(shape, dtype)
        if values is not None:
            self.array[...] = values
        self.pointer = ctypes.c_void_p(self.array.ctypes.data)
