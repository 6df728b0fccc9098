"""Weighted sums over four entries of each of sixteen neighbouring rows, four at a time.

Written as scalar sums, these are half of the time of a cubic sweep. LLVM is told here to work on vectors of four, which
processors have instructions for, or do in halves.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_FOUR = ir.VectorType(ir.DoubleType(), 4)
_INDEX = ir.IntType(32)


def _lane(n: int) -> ir.Constant:
    return ir.Constant(_INDEX, n)


def _everywhere(builder: Any, value: Any) -> Any:
    """Return a vector of four equal numbers."""
    undefined = ir.Constant(_FOUR, ir.Undefined)
    first = builder.insert_element(undefined, value, _lane(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_INDEX, 4), [0] * 4))


def _weighted(builder: Any, weights: list[Any], vectors: list[Any]) -> Any:
    """Return the sum of four vectors by weights, in pairs."""
    terms = [builder.fmul(weight, vector) for weight, vector in zip(weights, vectors, strict=True)]
    return builder.fadd(builder.fadd(terms[0], terms[1]), builder.fadd(terms[2], terms[3]))


def _sum_of_rows(typing: Any, q: Any, i: Any, j: Any, k: Any, a: Any, b: Any, c: Any) -> Any:
    """Return the sum over m, n, l of a[m] b[n] c[l] q[i + m, j + n, k + l], each from 0 to 3, within compiled code.

    Parameters
    ----------
    q : ndarray of float64, shape (n0, n1, n2)
        Contiguous along the last axis.
    i, j, k : int
        Not checked.
    a, b, c : tuple of four float
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        strides = cgutils.unpack_tuple(builder, array.strides, 3)
        row = builder.ptrtoint(array.data, ir.IntType(64))
        for index, stride in zip(arguments[1:4], strides, strict=True):
            row = builder.add(row, builder.mul(index, stride))
        weights = [[builder.extract_value(argument, n) for n in range(4)] for argument in arguments[4:]]
        along_a, along_b = ([_everywhere(builder, w) for w in of] for of in weights[:2])
        planes = []
        for _ in range(4):
            place, rows = row, []
            for _ in range(4):
                four = builder.load(builder.inttoptr(place, _FOUR.as_pointer()))
                four.align = 8
                rows.append(four)
                place = builder.add(place, strides[1])
            planes.append(_weighted(builder, along_b, rows))
            row = builder.add(row, strides[0])
        total = _weighted(builder, along_a, planes)
        lanes = [builder.extract_element(total, _lane(n)) for n in range(4)]
        return _weighted(builder, weights[2], lanes)

    return types.float64(q, i, j, k, a, b, c), generate


sum_of_rows: Any = intrinsic(_sum_of_rows)
