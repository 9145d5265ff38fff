"""Sixteen single-precision numbers as one value, for compiled kernels.

What a scan takes is the same arithmetic on every channel, bin or bearing. Compilers turn loops over
them into a processor's wide instructions only where they can prove much about memory; here they
are told. `Lanes` has +, - and *; `load` and `store` move it from and to arrays. A processor whose
registers are narrower takes it in parts; one that cannot multiply and add at once rounds once more.

Arrays lie in memory in C order, positions in them count single numbers from the first, and nobody
checks them. None of this runs outside of compiled functions.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model
from numpy.typing import NDArray

LANES = 16

_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_UNDEFINED = ir.Constant(_VECTOR, ir.Undefined)
_FLOAT_BYTES = 4
_CACHE_LINE = 64
_instruction: Any = intrinsic


def lanes_array(*shape: int) -> NDArray[np.float32]:
    """Zeros that begin where a cache line does: lanes that straddle two are slow to load."""
    size = int(np.prod(shape))
    room = np.zeros(size + _CACHE_LINE // _FLOAT_BYTES, dtype=np.float32)
    start = -room.ctypes.data % _CACHE_LINE // _FLOAT_BYTES
    return room[start : start + size].reshape(shape)


def whole_lanes(count: int) -> int:
    """The least multiple of `LANES` that is not less."""
    return -(-count // LANES) * LANES


class LanesType(types.Type):
    """The type of such a value."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


Lanes = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _teach(operation: Any, instruction: str) -> None:
    """Give two lanes an operator, number by number."""

    @infer_global(operation)
    class _Template(AbstractTemplate):
        def generic(self, args: Any, _: Any) -> Any:
            return signature(Lanes, Lanes, Lanes) if args == (Lanes, Lanes) else None

    @lower_builtin(operation, LanesType, LanesType)
    def _lower(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args)


_teach(operator.add, "fadd")
_teach(operator.sub, "fsub")
_teach(operator.mul, "fmul")


def _check(array: Any) -> None:
    if not isinstance(array, types.Array) or array.dtype != types.float32 or array.layout != "C":
        raise TypingError("lanes are kept in arrays of float32 in C order")


def _pointer(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, array).data, [at])


def _load(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    pointer = _pointer(context, builder, kind, array, at)
    return builder.load(builder.bitcast(pointer, _VECTOR.as_pointer()), align=_FLOAT_BYTES)


def _store(context: Any, builder: Any, kind: Any, array: Any, at: Any, value: Any) -> None:
    pointer = _pointer(context, builder, kind, array, at)
    builder.store(value, builder.bitcast(pointer, _VECTOR.as_pointer()), align=_FLOAT_BYTES)


def _order(lanes: list[int]) -> Any:
    return ir.Constant(ir.VectorType(ir.IntType(32), LANES), lanes)


def _spread(builder: Any, number: Any) -> Any:
    first = builder.insert_element(_UNDEFINED, number, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, _UNDEFINED, _order([0] * LANES))


@_instruction
def load(_typing: Any, array: Any, at: Any) -> Any:
    """The lanes that begin at a position of an array."""
    _check(array)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _load(context, builder, signature.args[0], *args)

    return Lanes(array, types.intp), codegen


@_instruction
def store(_typing: Any, array: Any, at: Any, value: Any) -> Any:
    """Puts lanes where a position of an array begins."""
    _check(array)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        _store(context, builder, signature.args[0], *args)
        return context.get_dummy_value()

    return types.void(array, types.intp, Lanes), codegen


@_instruction
def spread(_typing: Any, array: Any, at: Any) -> Any:
    """One number of an array in all lanes."""
    _check(array)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _spread(builder, builder.load(_pointer(context, builder, signature.args[0], *args)))

    return Lanes(array, types.intp), codegen


@_instruction
def constant(_typing: Any, number: Any) -> Any:
    """A number, rounded to single precision, in all lanes."""

    def codegen(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _spread(builder, args[0])

    return Lanes(types.float32), codegen


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
    name = f"llvm.fmuladd.v{LANES}f32"  # one instruction where there is one
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [a, b, c])


@_instruction
def plus_product(_typing: Any, c: Any, a: Any, b: Any) -> Any:
    """The sum c + a b."""

    def codegen(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _multiply_add(builder, args[1], args[2], args[0])

    return Lanes(Lanes, Lanes, Lanes), codegen


@_instruction
def minus_product(_typing: Any, c: Any, a: Any, b: Any) -> Any:
    """The difference c - a b."""

    def codegen(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _multiply_add(builder, builder.fneg(args[1]), args[2], args[0])

    return Lanes(Lanes, Lanes, Lanes), codegen


@_instruction
def transpose(_typing: Any, rows: Any, at: Any, columns: Any, to: Any, step: Any) -> Any:
    """Sixteen lanes that follow one another become sixteen others, ``step`` numbers apart.

    Number j of row i, from ``rows[at]`` on, becomes number i of row j, from ``columns[to]`` on.
    """
    _check(rows)
    _check(columns)
    half = LANES // 2
    low = [lane for k in range(half) for lane in (k, LANES + k)]
    high = [lane + half for lane in low]

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        rows, at, columns, to, step = args
        value = [
            _load(context, builder, signature.args[0], rows, builder.add(at, at.type(LANES * i)))
            for i in range(LANES)
        ]
        for _ in range(LANES.bit_length() - 1):  # each round merges row k with row k + 8
            value = [
                builder.shuffle_vector(value[k], value[k + half], _order(order))
                for k in range(half)
                for order in (low, high)
            ]
        for row in value:
            _store(context, builder, signature.args[2], columns, to, row)
            to = builder.add(to, step)
        return context.get_dummy_value()

    return types.void(rows, types.intp, columns, types.intp, types.intp), codegen
