"""What this machine can do at best: fused multiply-adds and bytes per second, measured.

Two small kernels, in the manner of the roofline model (S. Williams et al., CACM 2009): chains of vector
multiply-adds that never leave the registers, and STREAM's triad (J. McCalpin, 1995) over few and many bytes,
because the arrays of most kernels here stay in the last cache.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from sags_node.kernels.jit import aligned, kernel, parallel_kernel
from sags_node.kernels.threads import configure_threads

F32 = NDArray[np.float32]
f4 = np.float32
CHAINS = 12  # independent sums: more than latency times issue width, and they fit into 16 registers
STEPS = 8  # multiply-adds per chain and round
ROUNDS = 100_000
MIB = 1 << 20
TRIAD_BYTES = (6 * MIB, 24 * MIB, 192 * MIB)  # of three arrays together; the last is beyond the caches
REPEATS = 15

_I64, _I32, _FLOAT = ir.IntType(64), ir.IntType(32), ir.FloatType()


@dataclass(frozen=True, slots=True)
class Peak:
    """The best that was measured with so many threads."""

    threads: int
    operations: float  # float32 lanes per s that a vector instruction finished, a multiply-add counted once
    bandwidths: Mapping[int, float]  # bytes read and written per s, over so many bytes, ascending

    def bandwidth(self, touched: float) -> float:
        """Bytes per s for a kernel that touches so many."""
        sizes = list(self.bandwidths)
        return self.bandwidths[next((size for size in sizes if touched <= size), sizes[-1])]


def peak_row(peak: Peak) -> dict[str, Any]:
    """What a table says of it."""
    return {
        "threads": peak.threads,
        "operations_per_s": peak.operations,
        "bytes_per_s_over": {str(size): rate for size, rate in peak.bandwidths.items()},
    }


def measure_peak(threads: int) -> Peak:
    """The best of several tries; half a second, and a few to compile the first time. Leaves the calling
    thread's number of threads as it was."""
    before = numba.get_num_threads()
    configure_threads(threads)
    try:
        operations = max(_multiply_adds_per_second(lanes, run, threads) for lanes, run in RUNS.items())
        return Peak(threads, operations, {size: _bytes_per_second(size, threads) for size in TRIAD_BYTES})
    finally:
        numba.set_num_threads(before)


def _make_chains(lanes: int) -> Any:
    """`chains(seed, rounds)`: CHAINS * STEPS vector multiply-adds of `lanes` floats per round.

    Written as LLVM vectors, so that the width does not hang on what the vectoriser decides.
    """
    vector = ir.VectorType(_FLOAT, lanes)

    def chains(typing_context: Any, seed: Any, rounds: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            undefined = ir.Constant(vector, ir.Undefined)
            first = builder.insert_element(undefined, args[0], ir.Constant(_I32, 0))
            addend = builder.shuffle_vector(
                first, undefined, ir.Constant(ir.VectorType(_I32, lanes), [0] * lanes)
            )
            factor = ir.Constant(vector, [0.5] * lanes)
            fma_type = ir.FunctionType(vector, [vector] * 3)
            fma = cgutils.get_or_insert_function(builder.module, fma_type, f"llvm.fma.v{lanes}f32")
            before = builder.block
            body, after = builder.append_basic_block("round"), builder.append_basic_block("finished")
            builder.branch(body)
            builder.position_at_end(body)
            counter = builder.phi(_I64)
            sums = [builder.phi(vector) for _ in range(CHAINS)]
            values = sums
            for _ in range(STEPS):
                values = [builder.call(fma, [value, factor, addend]) for value in values]
            counted = builder.add(counter, ir.Constant(_I64, 1))
            builder.cbranch(builder.icmp_signed("<", counted, args[1]), body, after)
            counter.add_incoming(ir.Constant(_I64, 0), before)
            counter.add_incoming(counted, body)
            for start, (entering, leaving) in enumerate(zip(sums, values, strict=True)):
                entering.add_incoming(ir.Constant(vector, [float(start)] * lanes), before)
                entering.add_incoming(leaving, body)
            builder.position_at_end(after)
            total = values[0]
            for value in values[1:]:
                total = builder.fadd(total, value)
            return builder.extract_element(total, ir.Constant(_I32, 0))

        return types.float32(types.float32, types.int64), generate

    return intrinsic(chains)


_chains_of_4, _chains_of_8, _chains_of_16 = (_make_chains(lanes) for lanes in (4, 8, 16))


@parallel_kernel
def _run_chains_of_4(results: F32, rounds: int) -> None:
    for worker in numba.prange(results.size):
        results[worker] = _chains_of_4(f4(worker), rounds)


@parallel_kernel
def _run_chains_of_8(results: F32, rounds: int) -> None:
    for worker in numba.prange(results.size):
        results[worker] = _chains_of_8(f4(worker), rounds)


@parallel_kernel
def _run_chains_of_16(results: F32, rounds: int) -> None:
    for worker in numba.prange(results.size):
        results[worker] = _chains_of_16(f4(worker), rounds)


# By lanes. A processor's own vector width is the fastest; a wider one is cut into pieces.
RUNS = {4: _run_chains_of_4, 8: _run_chains_of_8, 16: _run_chains_of_16}


def _multiply_adds_per_second(lanes: int, run: Callable[[F32, int], None], threads: int) -> float:
    results = np.empty(threads, np.float32)
    seconds = _shortest(lambda: run(results, ROUNDS))
    return threads * ROUNDS * CHAINS * STEPS * lanes / seconds


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
        array.fill(1)  # pages of zeros that nothing was written to are all the same page
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
