"""How the CPU kernels are compiled, and the rules that make LLVM vectorise them.

The rules; breaking one costs up to 5 times without any error, so time a kernel after every edit
(`benchmarks/kernels.py`):

1. Indices of inner loops are `np.uint64`, and so is every constant added to them. A signed index gets a
   wrap-around test that stops vectorisation; uint64 + int64 silently becomes float64.
2. An inner loop works on planes of ONE scratch array at constant offsets: several arrays would need alias
   tests. Scratch comes 64-byte aligned from Python (`aligned`), and planes are padded by 64 bytes because
   streams a multiple of 4 KiB apart evict each other.
3. Rows times columns of a tile are flattened to one loop, so that sums stay in vector registers.
4. Reductions that must vectorise are sums; a max over floats does not.
5. A record that is reached through an index is prefetched a few steps ahead.
6. Results must not depend on the number of threads: work is cut into pieces whose result does not depend
   on who does them, every output has one writer, and partial sums are added in a fixed order.
7. The body of a `prange` loop branches little and unpacks no tuples: it calls a serial kernel for one item.
   With `continue` and `x, y = f()` in the body, Numba 0.68 shares `x` and `y` between threads, silently.
   `tests/test_kernels.py` compares every kernel of the mapper with its own Python source.

Numba's disk cache only sees the file a kernel stands in and the types of its arguments. So constants that
shape a kernel stand in the same file as every kernel that uses them, and layouts shared between files are
structured dtypes (part of the argument type). After editing this file, delete the caches (`__pycache__`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import DTypeLike, NDArray

from sags_node.engine import threads  # noqa: F401  (fixes the threading layer before the first kernel)

# Not "fast": that also promises the absence of NaN and infinity, and comparisons must reject those here.
_FASTMATH = {"reassoc", "contract", "arcp", "nsz", "afn"}
_OPTIONS: dict[str, Any] = {
    "cache": True,
    "fastmath": _FASTMATH,
    "error_model": "numpy",
    "boundscheck": False,
    "nogil": True,
}

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T", bound=np.generic)


def inlined(function: F) -> F:
    """Compile a function into every kernel that calls it: a call left in a loop keeps it from vectorising."""
    compiled: F = numba.njit(forceinline=True, **_OPTIONS)(function)
    return compiled


def kernel(function: F) -> F:
    """Compile a serial kernel."""
    compiled: F = numba.njit(**_OPTIONS)(function)
    return compiled


def parallel_kernel(function: F) -> F:
    """Compile a kernel whose `numba.prange` loops are shared between threads."""
    compiled: F = numba.njit(parallel=True, **_OPTIONS)(function)
    return compiled


def aligned(shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """Zeroed array that starts on a cache line."""
    item = np.dtype(dtype)
    size = int(np.prod(shape)) * item.itemsize
    raw = np.zeros(size + 64, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + size].view(item).reshape(shape)


def read_only(array: NDArray[T]) -> NDArray[T]:
    """The same memory as a contiguous array that kernels only read.

    Whether an array may be written is part of its Numba type: without this, a caller's frozen array would
    compile every kernel a second time.
    """
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


_F32 = ir.FloatType()
_I32 = ir.IntType(32)


@intrinsic
def round_to_even(typing_context: Any, x: Any) -> Any:
    """Nearest integer as float32: one vector instruction, where `round` is a call."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.call(builder.module.declare_intrinsic("llvm.rint", [_F32]), args)

    return types.float32(types.float32), generate


@intrinsic
def square_root(typing_context: Any, x: Any) -> Any:
    """Square root of a float32: `np.sqrt` stays a call because it has to report negative arguments."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.call(builder.module.declare_intrinsic("llvm.sqrt", [_F32]), args)

    return types.float32(types.float32), generate


@intrinsic
def scale_by_power_of_two(typing_context: Any, x: Any, exponent: Any) -> Any:
    """x * 2**exponent for float32 x near 1 and an integer-valued float32 exponent, by its exponent bits."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        shift = builder.shl(builder.fptosi(args[1], _I32), ir.Constant(_I32, 23))
        return builder.bitcast(builder.add(builder.bitcast(args[0], _I32), shift), _F32)

    return types.float32(types.float32, types.float32), generate


def _make_prefetch(write: int) -> Any:
    def prefetch(typing_context: Any, array: Any, index: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            i64, pointer = ir.IntType(64), ir.IntType(8).as_pointer()
            struct = context.make_array(signature.args[0])(context, builder, args[0])
            stride = cgutils.unpack_tuple(builder, struct.strides, signature.args[0].ndim)[0]
            position = context.cast(builder, args[1], signature.args[1], types.int64)
            address = builder.add(builder.ptrtoint(struct.data, i64), builder.mul(stride, position))
            signature_ir = ir.FunctionType(ir.VoidType(), [pointer, _I32, _I32, _I32])
            function = cgutils.get_or_insert_function(builder.module, signature_ir, "llvm.prefetch.p0")
            flags = [ir.Constant(_I32, value) for value in (write, 3, 1)]  # keep in all caches, data
            builder.call(function, [builder.inttoptr(address, pointer), *flags])
            return context.get_dummy_value()

        return types.void(array, index), generate

    return prefetch


prefetch_read = intrinsic(_make_prefetch(0))  # (array, index of its first axis)
prefetch_write = intrinsic(_make_prefetch(1))
