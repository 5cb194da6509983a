"""Starts Warp without output on stdout; its compiled kernels are cached beside ours."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

from sags_node.kernels.cache import cache_root

if TYPE_CHECKING:
    import warp as wp

QUIET = 40  # Warp's log level for errors


@functools.cache
def start() -> None:
    """Start Warp once in this process."""
    import warp as wp

    wp.config.quiet = True
    wp.config.log_level = QUIET
    wp.config.enable_cpu_blocks = True  # the CPU device runs a block's threads as the GPU does
    root = cache_root()
    if root is not None:  # load machine code only from a folder that belongs to this user
        wp.config.kernel_cache_dir = str(root / "warp" / wp.config.version)
        Path(wp.config.kernel_cache_dir).mkdir(mode=0o700, parents=True, exist_ok=True)
    wp.init()


def driver() -> str:
    """The driver's CUDA version."""
    import warp as wp

    return ".".join(map(str, wp.get_cuda_driver_version() or ("none",)))


def device_named(name: str) -> wp.Device:
    """Return Warp's device: "cuda", the current GPU, or "cpu", which is for tests."""
    start()
    import warp as wp

    return wp.get_device(name)
