"""Loads and stores of tables with one column a pixel, for loops that become vectors although they look up entries.

    take(rows, at)          rows[at]: next to each other in neighbouring columns
    put(rows, at, value)    rows[at] = value, the same
    fetch(table, x)         the entry of a `packed` table at the whole number x, a float32, and the one behind it; any x
                            is safe: one outside is moved to the end
    pick(rows, first, i)    rows[first + i], with i an int32 from a list

A loop that stores to one array and reads another one at computed places becomes vectors only where LLVM can prove that
the stores never meet the reads. `put` and `take` declare that for `fetch` and `pick` (alias scopes). So what
`fetch` and `pick` read must not be written in the same loop. A plain load of `rows` in such a loop would join both
sets.

Fast because 16 look-ups then are one gather: with 32-bit indices, as 64-bit ones make it 8 at a time. Gathers
were half of the time of `passages`, and most look-ups interpolate: so two neighbours are packed in one word.

    bits 0 to 15     the entry                e in bits 11 to 15, m in bits 0 to 10: (1 + m / 2048) 2^(e - 26)
    bits 16 to 31    the one behind it        the same
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_I64, _I32 = ir.IntType(64), ir.IntType(32)
_DROPPED = 12  # bits of the fraction of a float32
_FIRST = (127 - 26) << 11  # the least exponent, above them

Packed = npt.NDArray[np.int32]


def packed(values: npt.ArrayLike) -> Packed:
    """Return a table of values between 0 and 64 for `fetch`, each within 2^-12 of itself or 2^-26."""
    bits = np.asarray(values, np.float32).view(np.uint32).astype(np.int64)
    halves = np.clip(((bits + (1 << _DROPPED - 1)) >> _DROPPED) - _FIRST, 0, 0xFFFF)
    words: Packed = (halves | np.append(halves[1:], 0) << 16).astype(np.uint32).view(np.int32)
    return words


def _scope(builder: ir.IRBuilder) -> Any:
    """Return the alias scope of looked-up entries."""
    module = builder.module
    domain = module.add_metadata([ir.MetaDataString(module, "columns")])
    return module.add_metadata([module.add_metadata([ir.MetaDataString(module, "entries"), domain])])


def _address(context: Any, builder: ir.IRBuilder, kind: Any, array: Any, *indices: ir.Value) -> ir.Value:
    """Return the address of the entry at the sum of the indices, added one by one: the last may be a vector."""
    address = context.make_array(kind)(context, builder, array).data
    for index in indices:
        address = builder.gep(address, [index], inbounds=True)
    return address


def _fetch(typing_context: Any, table: Any, x: Any) -> tuple[Any, Any]:
    """Return the entry of a table at a whole number, and the one behind it."""

    def code(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        kind = signature.args[0]
        items = context.make_array(kind)(context, builder, args[0]).nitems
        index = builder.fptosi(args[1], _I32)
        last = builder.sub(builder.trunc(items, _I32), ir.Constant(_I32, 2))
        inside = builder.select(builder.icmp_unsigned("<", index, last), index, last)
        word = builder.load(_address(context, builder, kind, args[0], builder.sext(inside, _I64)))
        word.set_metadata("alias.scope", _scope(builder))
        halves = builder.and_(word, ir.Constant(_I32, 0xFFFF)), builder.lshr(word, ir.Constant(_I32, 16))
        first, dropped = ir.Constant(_I32, _FIRST << _DROPPED), ir.Constant(_I32, _DROPPED)
        values = [builder.bitcast(builder.add(builder.shl(half, dropped), first), ir.FloatType()) for half in halves]
        return context.make_tuple(builder, signature.return_type, values)

    return cast(Any, types).UniTuple(types.float32, 2)(table, x), code


def _pick(typing_context: Any, rows: Any, first: Any, i: Any) -> tuple[Any, Any]:
    """Return entry i of the row that begins at `first`."""

    def code(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        column = builder.sext(args[2], _I64) if args[2].type.width < _I64.width else args[2]
        value = builder.load(_address(context, builder, signature.args[0], args[0], args[1], column))
        value.set_metadata("alias.scope", _scope(builder))
        return value

    return rows.dtype(rows, types.int64, i), code


def _take(typing_context: Any, rows: Any, at: Any) -> tuple[Any, Any]:
    """Return the value at an index of a table."""

    def code(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        value = builder.load(_address(context, builder, signature.args[0], args[0], args[1]))
        value.set_metadata("noalias", _scope(builder))
        return value

    return rows.dtype(rows, types.int64), code


def _put(typing_context: Any, rows: Any, at: Any, value: Any) -> tuple[Any, Any]:
    """Store a value at an index of a table."""

    def code(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        store = builder.store(args[2], _address(context, builder, signature.args[0], args[0], args[1]))
        store.set_metadata("noalias", _scope(builder))
        return context.get_dummy_value()

    return types.none(rows, types.int64, rows.dtype), code


fetch, pick, take, put = (cast(Callable[..., Any], intrinsic(code)) for code in (_fetch, _pick, _take, _put))
