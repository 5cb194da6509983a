"""Vectors: a type of variable for kernels that holds `LANES` float32, and the arithmetic on it.

Where LLVM's own vectoriser does well, plain loops are better. Vectors are for loops where it does not: one
with a dozen sums runs out of registers, and a short one costs more to enter than to run. In the arithmetic of
vectors every operation is one instruction:

    weight = alpha * transmittance
    store(tile, at + RED, load(tile, at + RED) + weight * red)

`+ - * /` work on two vectors, or on a vector and a float32 that is copied into every lane. Comparisons give a
`Mask`, for `select`; masks support `&` and `|`. A product and a sum become one multiply-add where the
processor has it. Nothing else is rearranged, not even under `fastmath`: apart from multiply-adds, results are
the same on all processors.

`LANES` is 16 where the compile target has AVX-512, else 8; a narrower processor takes a vector in pieces.

A vector can hold a *block* of an image: `BLOCK_WIDTH` px wide and `LANES / BLOCK_WIDTH` rows high, row after
row. `block_x` and `block_y` say where a lane's pixel lies in its block.
"""

import operator
import re
from collections.abc import Callable, Sequence
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

BLOCK_WIDTH = 8  # px
RECORD = 16  # float32 in a record


def _fits_a_register(lanes: int) -> bool:
    """Tell whether the compile target adds `lanes` float32 with one instruction."""
    triple, cpu, features = cpu_target.target_context.codegen().magic_tuple()
    machine = llvm.Target.from_triple(triple).create_target_machine(cpu=cpu, features=features)
    vector = f"<{lanes} x float>"
    added = f"define {vector} @f({vector} %x) {{\n %y = fadd {vector} %x, %x\n ret {vector} %y\n}}"
    assembly = machine.emit_assembly(llvm.parse_assembly(added))
    return len(re.findall(r"^\s*v?f?addp?s?\s", assembly, re.MULTILINE)) == 1


LANES = 16 if _fits_a_register(16) else 8

_F32, _I32, _I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_FLOATS, _INTS = ir.VectorType(_F32, LANES), ir.VectorType(_I32, LANES)
_BITS, _ROW = ir.VectorType(ir.IntType(1), LANES), ir.VectorType(_F32, BLOCK_WIDTH)
# An operation with flags of its own is left alone by Numba's `fastmath`, which would rearrange it.
_FLAGS = ("contract",)


class Vector(types.Type):  # type: ignore[misc]  # Numba has no types
    """LANES float32."""

    def __init__(self) -> None:
        super().__init__(f"Vector({LANES})")


class Mask(types.Type):  # type: ignore[misc]  # Numba has no types
    """LANES booleans."""

    def __init__(self) -> None:
        super().__init__(f"Mask({LANES})")


vector, mask = Vector(), Mask()


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]  # Numba has no types
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, _FLOATS)


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):  # type: ignore[misc]  # Numba has no types
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, _BITS)


# ---- arithmetic --------------------------------------------------------------------------------------------

Generate = Callable[[Any, Sequence[Any]], Any]  # (builder, values) -> value


def _spread(builder: Any, value: Any) -> Any:
    """The same number in every lane."""
    undefined = ir.Constant(_FLOATS, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(_INTS, [0] * LANES))


def _vectors(builder: Any, kinds: Sequence[Any], values: Sequence[Any]) -> list[Any]:
    pairs = zip(kinds, values, strict=True)
    return [_spread(builder, value) if kind == types.float32 else value for kind, value in pairs]


def _define(function: Any, result: Any, operands: Sequence[tuple[Any, ...]], generate: Generate) -> None:
    """Let kernels apply an operator of Python to operands of these types."""

    @infer_global(function)
    class _Typing(AbstractTemplate):  # type: ignore[misc]  # Numba has no types
        def generic(self, args: Any, kws: Any) -> Any:
            return signature(result, *args) if tuple(args) in operands else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return generate(builder, _vectors(builder, sig.args, args))

    for kinds in operands:
        lower_builtin(function, *kinds)(lower)


def _arithmetic(name: str, **flags: Any) -> Generate:
    return lambda builder, values: getattr(builder, name)(*values, **flags)


def _comparison(sign: str) -> Generate:
    """A comparison that is false where an operand is NaN, except `!=`, which is true there."""
    ordered = "fcmp_unordered" if sign == "!=" else "fcmp_ordered"
    return lambda builder, values: getattr(builder, ordered)(sign, *values, flags=_FLAGS)


_TWO = ((vector, vector), (vector, types.float32), (types.float32, vector))
for _function, _in_place, _name in (
    (operator.add, operator.iadd, "fadd"),
    (operator.sub, operator.isub, "fsub"),
    (operator.mul, operator.imul, "fmul"),
    (operator.truediv, operator.itruediv, "fdiv"),
):
    for _either in (_function, _in_place):
        _define(_either, vector, _TWO, _arithmetic(_name, flags=_FLAGS))
for _function, _sign in (
    (operator.gt, ">"), (operator.ge, ">="), (operator.lt, "<"), (operator.le, "<="), (operator.eq, "=="),
    (operator.ne, "!="),
):  # fmt: skip
    _define(_function, mask, _TWO, _comparison(_sign))
for _function, _name in (
    (operator.and_, "and_"), (operator.iand, "and_"), (operator.or_, "or_"), (operator.ior, "or_"),
):  # fmt: skip
    _define(_function, mask, ((mask, mask),), _arithmetic(_name))
_define(operator.neg, vector, ((vector,),), _arithmetic("fneg"))


@intrinsic
def spread(typing_context: Any, value: Any) -> Any:
    """A vector with the same float32 in every lane."""
    return vector(types.float32), lambda context, builder, sig, args: _spread(builder, args[0])


@intrinsic
def spread_bits(typing_context: Any, value: Any) -> Any:
    """A vector with the bits of the same int32 in every lane: to select and store, not to compute with."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _spread(builder, builder.bitcast(args[0], _F32))

    return vector(types.int32), generate


@intrinsic
def select(typing_context: Any, condition: Any, yes: Any, no: Any) -> Any:
    """Return, lane by lane, `yes` where the mask is true and `no` elsewhere; each a vector or a float32."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(args[0], *_vectors(builder, sig.args[1:], args[1:]))

    return vector(mask, yes, no), generate


def _make_choice(sign: str) -> Any:
    def choice(typing_context: Any, x: Any, y: Any) -> Any:
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            values = _vectors(builder, sig.args, args)
            return builder.select(builder.fcmp_ordered(sign, *values, flags=_FLAGS), *values)

        return vector(x, y), generate

    return intrinsic(choice)


larger, smaller = _make_choice(">"), _make_choice("<")  # of two vectors or float32; where x is NaN: y


@intrinsic
def any_of(typing_context: Any, condition: Any) -> Any:
    """Tell whether a mask is true in one of its lanes."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = ir.IntType(LANES)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], bits), ir.Constant(bits, 0))

    return types.boolean(mask), generate


@intrinsic
def times_power_of_two(typing_context: Any, x: Any, exponent: Any) -> Any:
    """Return x * 2**n for x near 1, by adding to its exponent bits; n is in the lowest bits of `exponent`."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        power, shift = (builder.bitcast(value, _INTS) for value in args)
        shifted = builder.shl(shift, ir.Constant(_INTS, [23] * LANES))
        return builder.bitcast(builder.add(power, shifted), _FLOATS)

    return vector(vector, vector), generate


@intrinsic
def split_powers(typing_context: Any, x: Any) -> Any:
    """Return m and n with x = m 2**n and sqrt(1/2) <= m < sqrt(2), for positive x."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        def every(number: int) -> Any:
            return ir.Constant(_INTS, [number] * LANES)

        bits = builder.bitcast(args[0], _INTS)
        exponent = builder.ashr(builder.sub(bits, every(0x3F3504F3)), every(23))  # sqrt(1/2)
        rest = builder.bitcast(builder.sub(bits, builder.shl(exponent, every(23))), _FLOATS)
        return cgutils.pack_array(builder, [rest, builder.sitofp(exponent, _FLOATS)])

    return types.UniTuple(vector, 2)(vector), generate


@intrinsic
def multiply_add(typing_context: Any, x: Any, y: Any, z: Any) -> Any:
    """Return x y + z of vectors or float32, for kernels that must round alike. In a b + c d the compiler may
    fuse either product with the sum, and so round differently in each kernel."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(_FLOATS, [_FLOATS] * 3)
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fmuladd.v{LANES}f32")
        return builder.call(function, _vectors(builder, sig.args, args))

    return vector(x, y, z), generate


def _make_unary(name: str) -> Any:
    def unary(typing_context: Any, x: Any) -> Any:
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = ir.FunctionType(_FLOATS, [_FLOATS])
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)

        return vector(vector), generate

    return intrinsic(unary)


square_roots, round_downs, magnitudes = (
    _make_unary(f"llvm.{name}.v{LANES}f32") for name in ("sqrt", "floor", "fabs")
)


def _shuffle(builder: Any, x: Any, y: Any, lanes: Sequence[int]) -> Any:
    return builder.shuffle_vector(x, y, ir.Constant(_INTS, list(lanes)))


def _transposed(builder: Any, vectors: Sequence[Any]) -> list[Any]:
    """Transpose a square of LANES vectors: blocks of 1, 2, 4 ... lanes change places across the diagonal."""
    square, step = list(vectors), 1
    while step < LANES:
        upper = [n + LANES - step if n & step else n for n in range(LANES)]
        lower = [n + LANES if n & step else n + step for n in range(LANES)]
        for k in range(LANES):
            if not k & step:
                x, y = square[k], square[k + step]
                square[k], square[k + step] = _shuffle(builder, x, y, upper), _shuffle(builder, x, y, lower)
        step *= 2
    return square


# ---- memory ------------------------------------------------------------------------------------------------


def _address(context: Any, builder: Any, sig: Any, args: Any, k: int, kind: Any = _F32) -> Any:
    """The address of element args[k + 1] of the array args[k]."""
    data = context.make_array(sig.args[k])(context, builder, args[k]).data
    index = context.cast(builder, args[k + 1], sig.args[k + 1], types.int64)
    return builder.bitcast(builder.gep(data, [index]), kind.as_pointer())


def _make_load(align: int) -> Any:
    def load(typing_context: Any, array: Any, index: Any) -> Any:
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return builder.load(_address(context, builder, sig, args, 0, _FLOATS), align=align)

        return vector(array, index), generate

    return intrinsic(load)


def _make_store(align: int) -> Any:
    def store(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            builder.store(args[2], _address(context, builder, sig, args, 0, _FLOATS), align=align)
            return context.get_dummy_value()

        return types.void(array, index, vector), generate

    return intrinsic(store)


# Read and write the vector at array[index] of a flat float32 array, which is aligned to a whole vector.
load, store = _make_load(4 * LANES), _make_store(4 * LANES)
# The same at any alignment; the index counts through all dimensions of the array.
load_anywhere, store_anywhere = _make_load(4), _make_store(4)


@intrinsic
def store_integers(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """Write a vector of whole numbers to a flat int32 array, from array[index] on."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        integers = builder.fptosi(args[2], _INTS)
        builder.store(integers, _address(context, builder, sig, args, 0, _INTS), align=4)
        return context.get_dummy_value()

    return types.void(array, index, vector), generate


@intrinsic
def load_records(typing_context: Any, array: Any, index: Any) -> Any:
    """Read LANES records of 16 float32 from array[index] on, as 16 vectors, one for each field; aligned as
    for `load`."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start, fields = _address(context, builder, sig, args, 0, _FLOATS), []
        parts = RECORD // LANES  # of a record
        for part in range(parts):
            places = [builder.gep(start, [ir.Constant(_I64, k * parts + part)]) for k in range(LANES)]
            fields += _transposed(builder, [builder.load(place, align=4 * LANES) for place in places])
        return cgutils.pack_array(builder, fields)

    return types.UniTuple(vector, RECORD)(array, index), generate


@intrinsic
def store_records(typing_context: Any, array: Any, index: Any, fields: Any) -> Any:
    """Write LANES records, given as a tuple of 16 vectors, to where `load_records` reads them."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = _address(context, builder, sig, args, 0, _FLOATS)
        given, parts = cgutils.unpack_tuple(builder, args[2], RECORD), RECORD // LANES
        for part in range(parts):
            rows = _transposed(builder, given[part * LANES : (part + 1) * LANES])
            for k, row in enumerate(rows):
                builder.store(row, builder.gep(start, [ir.Constant(_I64, k * parts + part)]), align=4 * LANES)
        return context.get_dummy_value()

    return types.void(array, index, fields), generate


@intrinsic
def load_block(typing_context: Any, picture: Any, first: Any, width: Any) -> Any:
    """Read a block of a flat image whose rows have `width` px; `first` is the block's first pixel."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = _address(context, builder, sig, args, 0)
        stride = context.cast(builder, args[2], sig.args[2], types.int64)
        whole = builder.load(builder.bitcast(start, _ROW.as_pointer()), align=4)
        for k in range(1, LANES // BLOCK_WIDTH):
            row = builder.gep(start, [builder.mul(stride, ir.Constant(_I64, k))])
            below = builder.load(builder.bitcast(row, _ROW.as_pointer()), align=4)
            every = ir.Constant(
                ir.VectorType(_I32, (k + 1) * BLOCK_WIDTH), list(range((k + 1) * BLOCK_WIDTH))
            )
            whole = builder.shuffle_vector(whole, below, every)
        return whole

    return vector(picture, first, width), generate


@intrinsic
def store_block(typing_context: Any, picture: Any, first: Any, width: Any, value: Any) -> Any:
    """Write a block to where `load_block` reads it."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = _address(context, builder, sig, args, 0)
        stride = context.cast(builder, args[2], sig.args[2], types.int64)
        for k in range(LANES // BLOCK_WIDTH):
            lanes = list(range(k * BLOCK_WIDTH, (k + 1) * BLOCK_WIDTH))
            picked = ir.Constant(ir.VectorType(_I32, BLOCK_WIDTH), lanes)
            row = builder.shuffle_vector(args[3], ir.Constant(_FLOATS, ir.Undefined), picked)
            address = builder.gep(start, [builder.mul(stride, ir.Constant(_I64, k))])
            builder.store(row, builder.bitcast(address, _ROW.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(picture, first, width, vector), generate


def _make_constant(values: Sequence[float]) -> Any:
    def constant(typing_context: Any) -> Any:
        return vector(), lambda context, builder, sig, args: ir.Constant(_FLOATS, list(values))

    return intrinsic(constant)


# Where a lane's pixel lies in its block, px; and the lane's number
block_x = _make_constant([float(lane % BLOCK_WIDTH) for lane in range(LANES)])
block_y = _make_constant([float(lane // BLOCK_WIDTH) for lane in range(LANES)])
lane_numbers = _make_constant([float(lane) for lane in range(LANES)])
# Of a vector in two halves: the lane's number in its half; 1 in the first half and -1 in the second
half_lanes = _make_constant([float(lane % (LANES // 2)) for lane in range(LANES)])
half_signs = _make_constant([1.0 - 2.0 * (lane // (LANES // 2)) for lane in range(LANES)])


# ---- sums over the lanes -----------------------------------------------------------------------------------


def _fold_masks() -> list[tuple[list[int], list[int]]]:
    """For each step of `_fold`, which lanes of two concatenated vectors are added: (first ones, second ones).

    Whole groups of 4 lanes move first, then lanes within them: each of these is a single instruction.
    """
    quarters = 2 * LANES // 4
    across = [[4 * quarter + k for quarter in range(odd, quarters, 2) for k in range(4)] for odd in (0, 1)]
    within = [
        [
            at + 4 * quarter + k
            for quarter in range(quarters // 2)
            for at in (0, LANES)
            for k in (odd, odd + 2)
        ]
        for odd in (0, 1)
    ]
    halvings = (LANES // 4).bit_length() - 1
    return [(across[0], across[1])] * halvings + [(within[0], within[1])] * 2


def _fold(items: list[Any], zero: Any, add: Callable[[Any, Any, Sequence[int], Sequence[int]], Any]) -> Any:
    """Halve the number of vectors and of lanes still to be added, until one vector holds all sums."""
    for masks in _fold_masks():
        items = [*items, zero] if len(items) % 2 else items
        items = [add(items[k], items[k + 1], *masks) for k in range(0, len(items), 2)]
    return items[0]


def _sum_lanes(count: int) -> list[int]:
    """The lane of `_fold`'s result that holds the sum of each of `count` vectors."""
    labels = [[k] * LANES for k in range(count)]
    found = _fold(labels, [-1] * LANES, lambda x, y, one, other: [(x + y)[lane] for lane in one])
    return [found.index(k) for k in range(count)]


def _add_lanes(builder: Any, given: Sequence[Any]) -> tuple[Any, list[int]]:
    """The sums over the lanes of up to LANES vectors, in one vector, and the lane that holds each sum."""

    def add(x: Any, y: Any, one: Sequence[int], other: Sequence[int]) -> Any:
        parts = [builder.shuffle_vector(x, y, ir.Constant(_INTS, lanes)) for lanes in (one, other)]
        return builder.fadd(*parts, flags=_FLAGS)

    return _fold(list(given), ir.Constant(_FLOATS, [0.0] * LANES), add), _sum_lanes(len(given))


@intrinsic
def lane_sums(typing_context: Any, vectors: Any) -> Any:
    """Return the sum over the lanes of each of up to 8 vectors, given as a tuple: one float32 for each. Four
    hardly cost more than one."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        given = cgutils.unpack_tuple(builder, args[0], sig.args[0].count)
        sums, lanes = _add_lanes(builder, given)
        picked = [builder.extract_element(sums, ir.Constant(_I32, lane)) for lane in lanes]
        return cgutils.pack_array(builder, picked)

    return types.UniTuple(types.float32, vectors.count)(vectors), generate


@intrinsic
def smallest_lane(typing_context: Any, x: Any) -> Any:
    """The smallest number in a vector."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        least, width = args[0], LANES
        while width > 1:
            width //= 2
            far = [(lane + width) % LANES for lane in range(LANES)]
            other = _shuffle(builder, least, least, far)
            least = builder.select(builder.fcmp_ordered("<", least, other), least, other)
        return builder.extract_element(least, ir.Constant(_I32, 0))

    return types.float32(vector), generate


@intrinsic
def store_sums(typing_context: Any, array: Any, index: Any, vectors: Any) -> Any:
    """Fill a record of 16 float32 at array[index] with the sums over the lanes of up to 16 vectors, given as
    a tuple. The rest of the record is undefined. Aligned as for `load`."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        given = cgutils.unpack_tuple(builder, args[2], sig.args[2].count)
        to = _address(context, builder, sig, args, 0, _FLOATS)
        undefined = ir.Constant(_FLOATS, ir.Undefined)
        for k in range(0, len(given), LANES):
            some = given[k : k + LANES]
            sums, lanes = _add_lanes(builder, some)
            rest = [lane for lane in range(LANES) if lane not in lanes]
            placed = builder.shuffle_vector(sums, undefined, ir.Constant(_INTS, lanes + rest))
            builder.store(placed, builder.gep(to, [ir.Constant(_I64, k // LANES)]), align=4 * LANES)
        return context.get_dummy_value()

    return types.void(array, index, vectors), generate
