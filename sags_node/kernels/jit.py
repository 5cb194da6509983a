"""How the CPU kernels are compiled, and the rules that make LLVM vectorise them.

The rules; breaking one costs up to 5 times without any error, so time a kernel after every edit
(`python -m benchmarks kernels --check benchmarks/results/kernels.json`):

1. Indices of inner loops are `np.uint64`, and so is every constant added to them. A signed index gets a
   wrap-around test that stops vectorisation; uint64 + int64 silently becomes float64.
2. An inner loop works on planes of ONE scratch array at constant offsets: several arrays would need alias
   tests. Scratch comes 64-byte aligned from Python (`aligned`), and planes are padded by 64 bytes because
   streams a multiple of 4 KiB apart evict each other.
3. Sums over a tile are kept one per column, in an array of `stack_floats`: they stay in vector registers
   and are added up once at the end.
4. Reductions that must vectorise are sums; a max over floats does not.
5. A record that is reached through an index is prefetched a few steps ahead.
6. Results must not depend on the number of threads: work is cut into pieces whose result does not depend
   on who does them, every output has one writer, and partial sums are added in a fixed order. Which worker
   does which piece is left open (`take`): pieces differ in cost, and another process may hold a core.
7. The body of a `prange` loop branches little and unpacks no tuples: it calls a serial kernel for one item.
   With `continue` and `x, y = f()` in the body, Numba 0.68 shares `x` and `y` between threads, silently.
   `tests/engine/test_kernels.py` compares every kernel of the mapper with its own Python source. The index
   of the loop becomes `np.int64` before it is handed on, or all that is called compiles twice.
8. Two conditional sums in one loop do not vectorise: write what was selected to planes, and add those up.
9. A function with branches or loops that takes arrays counts references to them with atomic instructions,
   5 ns each, even when inlined: in the innermost loops arrays go to intrinsics only.

Machine code is kept on disk (`cache`) under a name that changes with the kernel's file, with every file that
it imports from and with the compile target (`digest`). So helpers, constants and layouts stand once, in the
file they belong to, and are imported. In machine code each kernel has its own copy of a helper (`linkage`).
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.dispatcher import Dispatcher
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array
from numpy.typing import DTypeLike, NDArray

from sags_node.kernels import threads  # noqa: F401  (fixes the threading layer before the first kernel)
from sags_node.kernels.cache import cache_for
from sags_node.kernels.linkage import keep_helpers_apart

keep_helpers_apart()

# Not "fast": that also promises the absence of NaN and infinity, and comparisons must reject those here.
_FASTMATH = {"reassoc", "contract", "arcp", "nsz", "afn"}
_OPTIONS: dict[str, Any] = {
    "fastmath": _FASTMATH,
    "error_model": "numpy",
    "boundscheck": False,
    "nogil": True,
}

PIECE = 1024  # rows a thread takes at a time: a call for each row would count references to every array

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T", bound=np.generic)


def inlined(function: F) -> F:
    """Compile a function into every kernel that calls it: a call left in a loop keeps it from vectorising."""
    return _compile(function, forceinline=True)


def kernel(function: F) -> F:
    """Compile a serial kernel."""
    return _compile(function)


def parallel_kernel(function: F) -> F:
    """Compile a kernel whose `numba.prange` loops are shared between threads."""
    return _compile(function, parallel=True)


def _compile(function: F, **options: bool) -> F:
    compiled: Any = numba.njit(**_OPTIONS, **options)(function)
    cache = cache_for(function) if isinstance(compiled, Dispatcher) else None  # not with NUMBA_DISABLE_JIT
    if cache is not None:
        compiled._cache = cache
    return cast(F, compiled)


def aligned(shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """Return a zeroed array that starts on a cache line (64 bytes)."""
    item = np.dtype(dtype)
    size = int(np.prod(shape)) * item.itemsize
    raw = np.zeros(size + 64, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + size].view(item).reshape(shape)


def read_only(array: NDArray[T]) -> NDArray[T]:
    """Return the array as a contiguous one that kernels only read; it is copied only if it must be.

    Whether an array may be written is part of its Numba type: without this, a caller's frozen array would
    compile every kernel a second time.
    """
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


_F32 = ir.FloatType()
_I32 = ir.IntType(32)
_I64 = ir.IntType(64)


def _make_unary(name: str) -> Any:
    def unary(typing_context: Any, x: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.call(builder.module.declare_intrinsic(name, [_F32]), args)

        return types.float32(types.float32), generate

    return unary


# Functions of a float32: each is one instruction, also in vectors. Those of Python and NumPy would be calls.
square_root = intrinsic(_make_unary("llvm.sqrt"))
round_up = intrinsic(_make_unary("llvm.ceil"))
round_down = intrinsic(_make_unary("llvm.floor"))


@intrinsic
def take(typing_context: Any, counter: Any, amount: Any) -> Any:
    """Add to the first element of an int64 array and return its former value, as one atomic step. Workers
    share items among them with it: `item = take(counter, 1)` until all are taken."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        added = context.cast(builder, args[1], signature.args[1], types.int64)
        return builder.atomic_rmw("add", builder.bitcast(data, _I64.as_pointer()), added, "monotonic")

    return types.int64(counter, amount), generate


@intrinsic
def copy(typing_context: Any, to: Any, to_start: Any, source: Any, start: Any, count: Any) -> Any:
    """Do to[to_start : to_start + count] = source[start : start + count] for contiguous 1D arrays that do not
    overlap. A loop would have to allow for overlap and copy element by element."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointers = []
        for array, position in ((0, 1), (2, 3)):
            struct = context.make_array(signature.args[array])(context, builder, args[array])
            pointers.append(builder.gep(struct.data, [args[position]]))
        item = context.get_abi_sizeof(context.get_data_type(signature.args[0].dtype))
        cgutils.raw_memcpy(builder, *pointers, args[4], item, align=item)
        return context.get_dummy_value()

    return types.void(to, to_start, source, start, count), generate


@intrinsic
def add_lanes(typing_context: Any, to: Any, to_start: Any, weight: Any, source: Any, start: Any) -> Any:
    """Do to[to_start : to_start + 16] += weight * source[start : start + 16] for flat float32 arrays that do
    not overlap. It works on one vector; a loop would be unrolled into sixteen steps."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointers = []
        for array, position in ((0, 1), (3, 4)):
            struct = context.make_array(signature.args[array])(context, builder, args[array])
            element = builder.gep(struct.data, [args[position]])
            pointers.append(builder.bitcast(element, ir.VectorType(_F32, 16).as_pointer()))
        undefined = ir.Constant(ir.VectorType(_F32, 16), ir.Undefined)
        first = builder.insert_element(undefined, args[2], ir.Constant(ir.IntType(32), 0))
        weights = builder.shuffle_vector(
            first, undefined, ir.Constant(ir.VectorType(ir.IntType(32), 16), [0] * 16)
        )
        added = builder.fmul(weights, builder.load(pointers[1], align=4), flags=["contract"])
        total = builder.fadd(builder.load(pointers[0], align=4), added, flags=["contract"])
        builder.store(total, pointers[0], align=4)
        return context.get_dummy_value()

    return types.void(to, to_start, types.float32, source, start), generate


@intrinsic(prefer_literal=True)
def stack_floats(typing_context: Any, size: Any) -> Any:
    """Make an uninitialised float32 array on the stack; its size must be a literal. Call it outside loops.

    Unlike any other array it cannot overlap those of the arguments: sums kept in it stay in vector registers.
    """
    array = types.Array(types.float32, 1, "C")

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        count = size.literal_value
        data = cgutils.alloca_once(builder, ir.ArrayType(_F32, count))
        data.align = 64
        struct = context.make_array(array)(context, builder)
        length, item = context.get_constant(types.intp, count), context.get_constant(types.intp, 4)
        populate_array(struct, builder.bitcast(data, _F32.as_pointer()), [length], [item], item, None)
        return struct._getvalue()

    return array(size), generate


def _make_prefetch(write: int, closeness: int) -> Any:
    def prefetch(typing_context: Any, array: Any, index: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            i64, pointer = ir.IntType(64), ir.IntType(8).as_pointer()
            struct = context.make_array(signature.args[0])(context, builder, args[0])
            stride = cgutils.unpack_tuple(builder, struct.strides, signature.args[0].ndim)[0]
            position = context.cast(builder, args[1], signature.args[1], types.int64)
            address = builder.add(builder.ptrtoint(struct.data, i64), builder.mul(stride, position))
            signature_ir = ir.FunctionType(ir.VoidType(), [pointer, _I32, _I32, _I32])
            function = cgutils.get_or_insert_function(builder.module, signature_ir, "llvm.prefetch.p0")
            flags = [ir.Constant(_I32, value) for value in (write, closeness, 1)]  # data
            builder.call(function, [builder.inttoptr(address, pointer), *flags])
            return context.get_dummy_value()

        return types.void(array, index), generate

    return prefetch


# Each takes (array, index of its first axis) and prefetches into all caches. `prefetch_far` leaves out L1: it
# is for what is read so much later that it would only displace other data there.
prefetch_read = intrinsic(_make_prefetch(0, 3))
prefetch_write = intrinsic(_make_prefetch(1, 3))
prefetch_far = intrinsic(_make_prefetch(0, 2))
