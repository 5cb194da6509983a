"""Numba's threading, set deliberately.

Layer: `omp`. Several Python threads may enter parallel kernels at once (the mapper, a consumer's own view);
Numba's default fall-back `workqueue` aborts the process when that happens. The layer is fixed by importing
this module, which every module with kernels does before Numba starts its pool. GNU OpenMP does not survive a
fork: start other processes with the `spawn` method.

Waiting: passive, unless the environment says otherwise. A worker that has nothing to do sleeps instead of
spinning. On free cores that costs nothing measurable; when another process or thread wants a core, a spinning
worker keeps it from the worker that all wait for, and a frame takes up to 2.5 times longer. OpenMP reads this
setting when its library is loaded: import this module before torch.

Place: left to the system. Some schedulers pack threads that were asleep onto one core, and a drawing right
after a pause then takes twice as long. Pinning a thread and its workers to cores of their own fixes that for
a kernel alone, but cost the whole node 5 to 25 % of its rate: its other threads want the same cores.

Count: Numba keeps it per Python thread, and a new thread starts with all cores of the process. OpenCV has one
count for the whole process, and its workers spin while they wait.
"""

import os

import cv2
import numba

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
numba.config.THREADING_LAYER = "omp"


def configure_threads(threads: int | None) -> int:
    """Set how many cores the kernels called from *this* Python thread use, and return that count.

    `None` means all cores this process may run on, which is also the upper bound: more threads than cores
    only wait for each other. Call it in every thread that computes. Results do not depend on the count.
    """
    cores = int(numba.config.NUMBA_NUM_THREADS)
    count = cores if threads is None else max(1, min(threads, cores))
    numba.set_num_threads(count)
    return count


def leave_a_core(threads: int | None) -> None:
    """Call `configure_threads` in a thread beside which others work: `None` leaves them one core. OpenCV gets
    as many threads as the kernels. On two cores, sharing the second one costs more than it gives."""
    cores = int(numba.config.NUMBA_NUM_THREADS)
    cv2.setNumThreads(configure_threads(max(1, cores - 1) if threads is None else threads))


def thread_count() -> int:
    """Return how many threads a kernel called now from this Python thread uses."""
    return int(numba.get_num_threads())
