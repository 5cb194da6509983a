"""Small dense layers over blocks of 128 columns, with their derivatives by hand.

A block of activations is an array [channels, 128]: one column is one point (or one token of one point), so
every inner loop runs along points, at full vector width whatever the number of channels, and no column ever
touches another. Weights are read as scalars: a transposed view costs nothing, and `accumulate` with it is the
backward pass of `accumulate`. Gradients of weights are sums over the columns of one block (`add_outer`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic

from sags_node.kernels.jit import inlined, kernel, round_to_even, scale_by_power_of_two
from sags_node.types import F32

f4 = np.float32
u8 = np.uint64

COLUMNS = (
    128  # per block: long enough to hide loop starts, short enough that 32 channels stay in the L1 cache
)
_ROW = u8(COLUMNS)  # from one channel to the next
_ROWS = tuple(u8(k * COLUMNS) for k in range(8))
_R1, _R2, _R3, _R4, _R5, _R6, _R7 = _ROWS[1:]

ZERO, HALF, ONE = f4(0.0), f4(0.5), f4(1.0)
LARGEST = f4(3e38)

# 2^x on -1/2 <= x <= 1/2, relative error 7.5e-8
_P0, _P1, _P2 = f4(1.0000001), f4(0.69314694), f4(0.2402212)
_P3, _P4, _P5 = f4(0.05550713), f4(0.009675541), f4(0.0013276471)
_LOG2_E = f4(math.log2(math.e))
_LEAST_EXPONENT = f4(-126.0)

# Gauss error function, absolute error 1.5e-7: Abramowitz and Stegun, 7.1.26
_E = f4(0.3275911 / math.sqrt(2.0))
_E1, _E2, _E3 = f4(0.5 * 0.254829592), f4(0.5 * -0.284496736), f4(0.5 * 1.421413741)
_E4, _E5 = f4(0.5 * -1.453152027), f4(0.5 * 1.061405429)
_NORMAL_DENSITY = f4(1.0 / math.sqrt(2.0 * math.pi))


@intrinsic
def stays_a_call(typing_context: Any) -> Any:
    """Keep LLVM from inlining the function that begins with this.

    These layers are called from some thirty places: inlined, they compile longer and run a quarter slower.
    Such a kernel must not be called from an `inlined` function, whose option it would inherit.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.function.attributes.add("noinline")
        return context.get_dummy_value()

    return types.void(), generate


@inlined
def exp_negative(x: Any) -> Any:
    """exp(x) of a float32 x <= 0 in vector instructions; relative error 2e-7 + 1e-7 |x|."""
    exponent = max(x * _LOG2_E, _LEAST_EXPONENT)
    whole = round_to_even(exponent)
    r = exponent - whole
    power = ((((_P5 * r + _P4) * r + _P3) * r + _P2) * r + _P1) * r + _P0
    return scale_by_power_of_two(power, whole)


@kernel
def load_points(values: F32, first: int, block: F32, usable: F32) -> None:
    """Columns of a block [C, 128] from up to 128 rows of `values` [N, C], starting at row `first`.

    `usable` [128] becomes 0 where a value is NaN or infinite. Columns where it is 0, and those beyond the
    last row, are 0.
    """
    stays_a_call()
    count = min(COLUMNS, len(values) - first)
    points = values[first : first + count]
    for channel in range(len(block)):
        row = block[channel]
        for c in range(count):
            row[u8(c)] = points[u8(c), u8(channel)]
        for c in range(count, COLUMNS):
            row[u8(c)] = ZERO
        for c in range(COLUMNS):
            usable[u8(c)] = usable[u8(c)] if abs(row[u8(c)]) < LARGEST else ZERO
    for channel in range(len(block)):
        row = block[channel]
        for c in range(COLUMNS):
            row[u8(c)] = row[u8(c)] if usable[u8(c)] > ZERO else ZERO


@kernel
def store_points(block: F32, first: int, values: F32) -> None:
    """The opposite of `load_points`, without the test: columns [C, 128] to rows of `values` [N, C]."""
    stays_a_call()
    points = values[first : min(first + COLUMNS, len(values))]
    for c in range(len(points)):
        for channel in range(len(block)):
            points[u8(c), u8(channel)] = block[u8(channel), u8(c)]


@kernel
def accumulate(weights: F32, x: F32, y: F32) -> None:
    """y [O, 128] += weights [O, I] x [I, 128]."""
    stays_a_call()
    outputs, inputs = weights.shape
    flat_x, flat_y = x.reshape(-1), y.reshape(-1)
    by_eight = inputs - inputs % 8
    for i in range(0, by_eight, 8):  # outside: eight rows of x are used while they are in the L1 cache
        x0 = u8(i) * _ROW
        for o in range(outputs):
            y0 = u8(o) * _ROW
            w0, w1, w2, w3 = weights[o, i], weights[o, i + 1], weights[o, i + 2], weights[o, i + 3]
            w4, w5, w6, w7 = weights[o, i + 4], weights[o, i + 5], weights[o, i + 6], weights[o, i + 7]
            for c in range(COLUMNS):
                j = x0 + u8(c)
                flat_y[y0 + u8(c)] += (
                    w0 * flat_x[j]
                    + w1 * flat_x[j + _R1]
                    + w2 * flat_x[j + _R2]
                    + w3 * flat_x[j + _R3]
                    + w4 * flat_x[j + _R4]
                    + w5 * flat_x[j + _R5]
                    + w6 * flat_x[j + _R6]
                    + w7 * flat_x[j + _R7]
                )
    for i in range(by_eight, inputs):
        x0 = u8(i) * _ROW
        for o in range(outputs):
            y0, w0 = u8(o) * _ROW, weights[o, i]
            for c in range(COLUMNS):
                flat_y[y0 + u8(c)] += w0 * flat_x[x0 + u8(c)]


@kernel
def linear(weights: F32, bias: F32, x: F32, y: F32) -> None:
    """y [O, 128] = weights [O, I] x [I, 128] + bias [O]."""
    stays_a_call()
    for o in range(len(bias)):
        y[o] = bias[o]
    accumulate(weights, x, y)


@kernel
def add_outer(v_y: F32, x: F32, v_weights: F32) -> None:
    """v_weights [O, I] += v_y [O, 128] x [I, 128]^T."""
    stays_a_call()
    outputs, inputs = v_weights.shape
    flat_x, flat_y = x.reshape(-1), v_y.reshape(-1)
    by_eight = inputs - inputs % 8
    for o in range(outputs):
        y0 = u8(o) * _ROW
        for i in range(0, by_eight, 8):
            x0 = u8(i) * _ROW
            s0, s1, s2, s3, s4, s5, s6, s7 = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
            for c in range(COLUMNS):
                j, v = x0 + u8(c), flat_y[y0 + u8(c)]
                s0 += v * flat_x[j]
                s1 += v * flat_x[j + _R1]
                s2 += v * flat_x[j + _R2]
                s3 += v * flat_x[j + _R3]
                s4 += v * flat_x[j + _R4]
                s5 += v * flat_x[j + _R5]
                s6 += v * flat_x[j + _R6]
                s7 += v * flat_x[j + _R7]
            v_weights[o, i] += s0
            v_weights[o, i + 1] += s1
            v_weights[o, i + 2] += s2
            v_weights[o, i + 3] += s3
            v_weights[o, i + 4] += s4
            v_weights[o, i + 5] += s5
            v_weights[o, i + 6] += s6
            v_weights[o, i + 7] += s7
        for i in range(by_eight, inputs):
            v_weights[o, i] += _dot(v_y[o], x[i])


@kernel
def linear_backward(v_y: F32, x: F32, v_weights: F32, v_bias: F32) -> None:
    """Add to the gradients of `linear`'s weights [O, I] and bias [O]."""
    stays_a_call()
    add_outer(v_y, x, v_weights)
    add_row_sums(v_y, v_bias)


@kernel
def add_row_sums(v_y: F32, v_bias: F32) -> None:
    """v_bias [O] += sum over the columns of v_y [O, 128]."""
    stays_a_call()
    for o in range(len(v_bias)):
        row, total = v_y[o], ZERO
        for c in range(COLUMNS):
            total += row[u8(c)]
        v_bias[o] += total


@kernel
def add_row_dots(v_y: F32, x: F32, v_scale: F32) -> None:
    """v_scale [O] += row by row dot products of v_y and x [O, 128]."""
    stays_a_call()
    for o in range(len(v_scale)):
        v_scale[o] += _dot(v_y[o], x[o])


@inlined
def _dot(a: F32, b: F32) -> Any:
    total = ZERO
    for c in range(COLUMNS):
        total += a[u8(c)] * b[u8(c)]
    return total


@kernel
def scale_rows(scale: F32, x: F32, y: F32) -> None:
    """y [O, 128] = scale [O] x [O, 128]."""
    stays_a_call()
    for o in range(len(scale)):
        row_x, row_y, factor = x[o], y[o], scale[o]
        for c in range(COLUMNS):
            row_y[u8(c)] = factor * row_x[u8(c)]


@kernel
def add_scaled_rows(scale: F32, x: F32, y: F32) -> None:
    """y [O, 128] += scale [O] x [O, 128]."""
    stays_a_call()
    for o in range(len(scale)):
        row_x, row_y, factor = x[o], y[o], scale[o]
        for c in range(COLUMNS):
            row_y[u8(c)] += factor * row_x[u8(c)]


@kernel
def affine_rows(scale: F32, shift: F32, x: F32, y: F32) -> None:
    """y [O, 128] = scale [O] x [O, 128] + shift [O]."""
    stays_a_call()
    for o in range(len(scale)):
        row_x, row_y, factor, offset = x[o], y[o], scale[o], shift[o]
        for c in range(COLUMNS):
            row_y[u8(c)] = factor * row_x[u8(c)] + offset


@kernel
def affine_rows_backward(v_y: F32, x: F32, v_scale: F32, v_shift: F32) -> None:
    """Add to the gradients of `affine_rows`'s scale and shift [O]."""
    stays_a_call()
    add_row_dots(v_y, x, v_scale)
    add_row_sums(v_y, v_shift)


@kernel
def copy(x: F32, y: F32) -> None:
    """y = x, element by element. (`y[:] = x` compiles fifteen times longer.)"""
    stays_a_call()
    flat_x, flat_y = x.reshape(-1), y.reshape(-1)
    for c in range(flat_y.size):
        flat_y[u8(c)] = flat_x[u8(c)]


@kernel
def add(x: F32, y: F32) -> None:
    """y += x, element by element."""
    stays_a_call()
    flat_x, flat_y = x.reshape(-1), y.reshape(-1)
    for c in range(flat_y.size):
        flat_y[u8(c)] += flat_x[u8(c)]


@kernel
def multiply(x: F32, y: F32) -> None:
    """y *= x, element by element."""
    stays_a_call()
    flat_x, flat_y = x.reshape(-1), y.reshape(-1)
    for c in range(flat_y.size):
        flat_y[u8(c)] *= flat_x[u8(c)]


@kernel
def multiply_by(factor: Any, y: F32) -> None:
    """y *= factor."""
    stays_a_call()
    flat_y = y.reshape(-1)
    for c in range(flat_y.size):
        flat_y[u8(c)] *= factor


@kernel
def gelu(x: F32, y: F32) -> None:
    """y = x Phi(x) with the normal distribution Phi (Hendrycks and Gimpel, 2016), not its tanh approximation.

    x is overwritten by the derivative Phi(x) + x phi(x): all that the backward pass needs of it.
    """
    stays_a_call()
    flat_x, flat_y = x.reshape(-1), y.reshape(-1)
    for c in range(flat_x.size):
        value = flat_x[u8(c)]
        density = exp_negative(-HALF * value * value)
        t = ONE / (ONE + _E * abs(value))
        tail = ((((_E5 * t + _E4) * t + _E3) * t + _E2) * t + _E1) * t * density
        share = ONE - tail if value > ZERO else tail
        flat_y[u8(c)] = value * share
        flat_x[u8(c)] = share + value * _NORMAL_DENSITY * density
