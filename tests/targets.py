"""The tests of the kernels and a golden replay, for processors other than this one.

What a kernel computes depends on the instructions it is compiled to: how many additions run side by side, and
whether a product and a sum are rounded once or twice. So each compile target gives other last digits, and a
bound that holds on one must hold on all. `make test-targets` runs them all, on one and on two threads.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import llvmlite.binding as llvm

ROOT = Path(__file__).parent.parent
TESTS = tuple(
    ROOT / "tests" / room / f"test_{name}.py"
    for room, names in {
        "engine": ("rasterizer", "cpu_rasterizer", "twin", "losses", "adam", "kernels"),
        "field": ("hexplane", "decoder", "deformation", "paper_losses"),
        "fitting": ("residuals",),
        "mapping": ("slopes",),
        "detail": ("detail",),
        "vision": ("matching_kernels",),
        "evaluation": ("replay",),
    }.items()
    for name in names
)
THREADS = (1, 2)
_AVX2 = ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "popcnt")
_AVX512 = (*_AVX2, "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl")


@dataclass(frozen=True)
class Target:
    """What Numba compiles for."""

    cpu: str  # LLVM's name
    needs: tuple[str, ...] = ()  # features
    tuning: str = ""

    @property
    def environment(self) -> dict[str, str]:
        features = ",".join([f"+{feature}" for feature in self.needs] + [self.tuning] * bool(self.tuning))
        return {"NUMBA_CPU_NAME": self.cpu} | ({"NUMBA_CPU_FEATURES": features} if features else {})

    def missing_here(self) -> list[str]:
        here = llvm.get_host_cpu_features()
        return [feature for feature in self.needs if not here.get(feature)]


TARGETS = {
    "generic": Target("generic"),  # x86-64 as of 2003: 128-bit vectors, no fused multiply-add
    "avx2": Target("haswell", _AVX2),
    "avx512-256": Target("skylake-avx512", _AVX512, "+prefer-256-bit"),
    "avx512-512": Target("skylake-avx512", _AVX512, "-prefer-256-bit"),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0] if __doc__ else None)
    parser.add_argument("names", nargs="*", choices=[[], *TARGETS], metavar="TARGET", help=", ".join(TARGETS))
    parser.add_argument("--threads", type=int, nargs="+", default=THREADS)
    parser.add_argument("--one", action="store_true", help="one of them, another one for each commit")
    chosen = parser.parse_args()
    runs = list(_possible(chosen.names or list(TARGETS), chosen.threads))
    if chosen.one:
        runs = runs[_commit() % len(runs) :][:1]
    failed = [f"{name} on {threads}" for name, threads in runs if not _passes(name, threads)]
    print(
        f"\n{len(runs) - len(failed)} of {len(runs)} passed" + "".join(f"\nfailed: {run}" for run in failed)
    )
    return len(failed) > 0


def _possible(names: list[str], threads: list[int]) -> Iterator[tuple[str, int]]:
    for name in names:
        missing = TARGETS[name].missing_here()
        if missing:
            print(f"skipped: {name}, this processor has no {', '.join(missing)}")
            continue
        yield from ((name, count) for count in threads)


def _passes(name: str, threads: int) -> bool:
    print(f"\n{name} on {threads} thread{'s' * (threads > 1)}", flush=True)
    environment = os.environ | TARGETS[name].environment | {"NUMBA_NUM_THREADS": str(threads)}
    start = time.monotonic()
    command = [sys.executable, "-m", "pytest", "-n", "2", "--dist", "loadfile", "-m", "not beside", *TESTS]
    code = subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode
    print(f"{name} on {threads}: {time.monotonic() - start:.0f} s", flush=True)
    return code == 0


def _commit() -> int:
    """Of this checkout; without one, days."""
    found = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return int(found.stdout, 16) if found.returncode == 0 else int(time.time() // 86400)


if __name__ == "__main__":
    sys.exit(main())
