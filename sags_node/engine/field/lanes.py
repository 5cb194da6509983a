"""Vector access to flat float32 arrays, for kernels that gather and scatter rows.

A loop that reads many rows and writes others is not vectorised: LLVM would have to test at run time whether
any two of them overlap. `read_input` and `write_output` promise that they do not (LLVM's alias scopes);
`make_add_lanes` makes an addition that is one vector instruction whatever LLVM thinks.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


def _element(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


def _inputs(builder: Any) -> Any:
    """The list of one alias scope that all kernels share."""
    domain = builder.module.add_metadata(["kernel"])
    return builder.module.add_metadata([builder.module.add_metadata(["inputs", domain])])


@intrinsic
def read_input(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index], index uint64, of a flat array that nothing writes to while the kernel runs."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(_element(context, builder, signature.args[0], *args))
        value.set_metadata("alias.scope", _inputs(builder))
        return value

    return types.float32(array, types.uint64), generate


@intrinsic
def write_output(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index] = value, index uint64, in a flat array that `read_input` does not read in this kernel."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        store = builder.store(args[2], _element(context, builder, signature.args[0], *args[:2]))
        store.set_metadata("noalias", _inputs(builder))
        return context.get_dummy_value()

    return types.void(array, types.uint64, types.float32), generate


def make_add_lanes(count: int) -> Any:
    """add_lanes(rows, to, weight, values, at): rows[to : to + count] += weight * values[at : at + count] for
    flat arrays and uint64 indices, where the two stretches do not overlap."""
    lanes = ir.VectorType(ir.FloatType(), count)
    first = ir.Constant(ir.IntType(32), 0)
    every = ir.Constant(ir.VectorType(ir.IntType(32), count), [0] * count)

    def add_lanes(typing_context: Any, rows: Any, to: Any, weight: Any, values: Any, at: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            def address(k: int) -> Any:
                element = _element(context, builder, signature.args[k], args[k], args[k + 1])
                return builder.bitcast(element, lanes.as_pointer())

            one = builder.insert_element(ir.Constant(lanes, ir.Undefined), args[2], first)
            weights = builder.shuffle_vector(one, one, every)
            total, terms = address(0), builder.load(address(3), align=4)
            product = builder.fmul(weights, terms, flags=["contract"])
            found = builder.fadd(builder.load(total, align=4), product, flags=["contract"])
            builder.store(found, total, align=4)
            return context.get_dummy_value()

        return types.void(rows, types.uint64, types.float32, values, types.uint64), generate

    return intrinsic(add_lanes)
