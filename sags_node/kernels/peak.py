"""What this machine can do at best: fused multiply-adds and bytes per second, measured.

Two small kernels, in the manner of the roofline model (S. Williams et al., CACM 2009): chains of vector
multiply-adds that never leave the registers, and STREAM's triad (J. McCalpin, 1995) over few and many bytes,
because the arrays of most kernels here stay in the last cache.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sags_node.kernels.jit import aligned, kernel, parallel_kernel
from sags_node.kernels.threads import configure_threads
from sags_node.kernels.vectors import LANES, multiply_add, smallest_lane, spread

F32 = NDArray[np.float32]
f4 = np.float32
CHAINS = 12  # independent sums: more than latency times issue width, and they fit into 16 registers
ROUNDS = 800_000
MIB = 1 << 20
TRIAD_BYTES = (6 * MIB, 24 * MIB, 192 * MIB)  # of three arrays together; the last is beyond the caches
REPEATS = 15


@dataclass(frozen=True, slots=True)
class Peak:
    """The best rates that were measured with `threads` threads."""

    threads: int
    operations: float  # float32 lanes per s that a vector instruction finished, a multiply-add counted once
    bandwidths: Mapping[int, float]  # size of the arrays in bytes, ascending -> bytes read and written per s

    def bandwidth(self, touched: float) -> float:
        """Return the bytes per s for a kernel that touches `touched` bytes."""
        sizes = list(self.bandwidths)
        return self.bandwidths[next((size for size in sizes if touched <= size), sizes[-1])]


def peak_row(peak: Peak) -> dict[str, Any]:
    """Return the peak as a row of a table."""
    return {
        "threads": peak.threads,
        "operations_per_s": peak.operations,
        "bytes_per_s_over": {str(size): rate for size, rate in peak.bandwidths.items()},
    }


def measure_peak(threads: int) -> Peak:
    """Measure the best of several tries. Takes half a second, and a few more to compile the first time. The
    calling thread's number of threads stays as it was."""
    before = numba.get_num_threads()
    configure_threads(threads)
    try:
        operations = _multiply_adds_per_second(threads)
        return Peak(threads, operations, {size: _bytes_per_second(size, threads) for size in TRIAD_BYTES})
    finally:
        numba.set_num_threads(before)


@kernel
def run_chains(first: Any, rounds: int) -> Any:
    """Run `rounds` steps x -> x / 2 + `first` of CHAINS chains, chain k from k on. Return one lane's sum."""
    half, addend = spread(f4(0.5)), spread(f4(first))
    a, b, c, d = spread(f4(0)), spread(f4(1)), spread(f4(2)), spread(f4(3))
    e, f, g, h = spread(f4(4)), spread(f4(5)), spread(f4(6)), spread(f4(7))
    i, j, k, m = spread(f4(8)), spread(f4(9)), spread(f4(10)), spread(f4(11))
    for _ in range(rounds):
        a, b = multiply_add(a, half, addend), multiply_add(b, half, addend)
        c, d = multiply_add(c, half, addend), multiply_add(d, half, addend)
        e, f = multiply_add(e, half, addend), multiply_add(f, half, addend)
        g, h = multiply_add(g, half, addend), multiply_add(h, half, addend)
        i, j = multiply_add(i, half, addend), multiply_add(j, half, addend)
        k, m = multiply_add(k, half, addend), multiply_add(m, half, addend)
    return smallest_lane(a + b + c + d + e + f + g + h + i + j + k + m)


@parallel_kernel
def _run_chains(results: F32, rounds: int) -> None:
    for worker in numba.prange(results.size):
        results[worker] = run_chains(f4(worker), rounds)


def _multiply_adds_per_second(threads: int) -> float:
    results = np.empty(threads, np.float32)
    return threads * ROUNDS * CHAINS * LANES / _shortest(lambda: _run_chains(results, ROUNDS))


@kernel
def _triad_part(sums: F32, left: F32, right: F32, factor: Any, passes: int) -> None:
    for _ in range(passes):
        for i in range(sums.size):
            sums[i] = left[i] + factor * right[i]


@parallel_kernel
def _triad(workers: int, sums: F32, left: F32, right: F32, factor: Any, passes: int) -> None:
    for worker in numba.prange(workers):
        first, end = sums.size * worker // workers, sums.size * (worker + 1) // workers
        _triad_part(sums[first:end], left[first:end], right[first:end], factor, passes)


def _bytes_per_second(size: int, threads: int) -> float:
    sums, left, right = (aligned((size // 12,)) for _ in range(3))
    for array in (sums, left, right):
        array.fill(1)  # pages of zeros that were never written share one page of memory
    passes = TRIAD_BYTES[-1] // size
    return size * passes / _shortest(lambda: _triad(threads, sums, left, right, f4(0.5), passes))


def _shortest(function: Callable[[], object]) -> float:
    """Seconds of the fastest of several calls, after one that may compile."""
    function()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)
