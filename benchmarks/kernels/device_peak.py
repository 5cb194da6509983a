"""What a GPU can do at best, in the manner of `peak`: multiply-adds that never leave the registers, and a
triad over few and many bytes, because few Gaussians stay in the last cache."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import triton
import triton.language as tl

from benchmarks.kernels.timing import Clock, times_ms
from sags_node.engine.cuda.signatures import Compiled
from sags_node.kernels.peak import MIB, Peak

LANES, WARPS = 1024, 4  # of a program: eight chains a thread, twice what hides the latency
STEPS = 16  # multiply-adds per chain and round
REPEATS = 15


@dataclass(frozen=True, slots=True)
class Probe:
    """How much is done to find the peak."""

    programs: int  # of LANES chains each
    rounds: int
    triad_bytes: tuple[int, ...]  # of three arrays together, ascending


SMALL_PROBE = Probe(programs=1, rounds=2, triad_bytes=(MIB,))  # where an interpreter runs it


def full_probe(device: torch.device) -> Probe:
    """A few milliseconds on a large GPU; the last triad is beyond its caches."""
    processors = torch.cuda.get_device_properties(device).multi_processor_count
    return Probe(16 * processors, 4096, (24 * MIB, 192 * MIB, 1536 * MIB))


@triton.jit(do_not_specialize=["rounds"])
def multiply_adds(
    results: tl.tensor,  # [programs LANES] written: y = y / 2 + 1, so many times, from the lane's number
    rounds: tl.tensor,
    STEPS: tl.constexpr,
    LANES: tl.constexpr,
) -> None:
    lanes = tl.program_id(0) * LANES + tl.arange(0, LANES)
    value = lanes.to(tl.float32)
    for _ in range(rounds):
        for _ in tl.static_range(STEPS):
            value = value * 0.5 + 1.0
    tl.store(results + lanes, value)


def measure_device_peak(device: torch.device, probe: Probe, clock: Clock) -> Peak:
    """The best of several tries."""
    results = torch.empty(probe.programs * LANES, device=device)
    chains_s = _shortest(lambda: run_chains(results, probe.rounds), clock)
    return Peak(
        threads=1,  # of the host
        operations=len(results) * probe.rounds * STEPS / chains_s,
        bandwidths={size: _bytes_per_second(size, device, probe, clock) for size in probe.triad_bytes},
    )


def run_chains(results: torch.Tensor, rounds: int) -> None:
    """`multiply_adds` over results [programs LANES]."""
    programs = len(results) // LANES
    multiply_adds[(programs,)](results, rounds, STEPS=STEPS, LANES=LANES, num_warps=WARPS)


def _bytes_per_second(size: int, device: torch.device, probe: Probe, clock: Clock) -> float:
    left, right = (torch.ones(size // 12, device=device) for _ in range(2))
    sums = torch.empty_like(left)
    passes = max(1, probe.triad_bytes[-1] // size)  # back to back: the GPU does not wait for the host

    def triads() -> None:
        for _ in range(passes):
            torch.add(left, right, alpha=0.5, out=sums)

    return size * passes / _shortest(triads, clock)


def _shortest(function: Callable[[], object], clock: Clock) -> float:
    """Seconds of the fastest of several calls."""
    return 1e-3 * min(times_ms(function, REPEATS, clock=clock))


SIGNATURES = (
    Compiled(
        multiply_adds,
        {"results": "*fp32", "rounds": "i32"},
        {"STEPS": STEPS, "LANES": LANES},
        num_warps=WARPS,
    ),
)
