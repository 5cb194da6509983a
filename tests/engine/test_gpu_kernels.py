"""The kernels for a GPU, compiled by Warp's own NVRTC, which needs neither card nor toolkit."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from types import ModuleType

import pytest
import warp as wp

from sags_node.engine.gpu import binning, compositing, projection, runtime
from sags_node.engine.gpu.binning import LANES
from sags_node.mapping.gpu import kernels

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
