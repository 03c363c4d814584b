"""Loads and stores of tables with one column a pixel, for loops that become vectors although they look up entries.

    take(rows, at)          rows[at]: next to each other in neighbouring columns
    put(rows, at, value)    rows[at] = value, the same
    fetch(table, x)         the entry at the whole number x, a float32; any x is safe: one outside is moved to the end
    fetch_next(table, x)    the entry behind it
    pick(rows, first, i)    rows[first + i], with i an int32 from a list

A loop that stores to one array and reads another one at computed places becomes vectors only where LLVM can prove that
the stores never meet the reads. `put` and `take` declare that for `fetch` and `pick` (alias scopes). So what
`fetch` and `pick` read must not be written in the same loop. A plain load of `rows` in such a loop would join both
sets.

Fast because 16 look-ups then are one gather: with 32-bit indices, as 64-bit ones make it 8 at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_I64, _I32 = ir.IntType(64), ir.IntType(32)


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


def _entry(context: Any, builder: ir.IRBuilder, signature: Any, args: Any, behind: int) -> ir.Value:
    """Return the entry `behind` that at a float32 index."""
    kind = signature.args[0]
    items = context.make_array(kind)(context, builder, args[0]).nitems
    index = builder.fptosi(args[1], _I32)
    last = builder.sub(builder.trunc(items, _I32), ir.Constant(_I32, 2))
    inside = builder.select(builder.icmp_unsigned("<", index, last), index, last)
    first = ir.Constant(_I64, behind)
    value = builder.load(_address(context, builder, kind, args[0], first, builder.sext(inside, _I64)))
    value.set_metadata("alias.scope", _scope(builder))
    return value


def _fetch(typing_context: Any, table: Any, x: Any) -> tuple[Any, Any]:
    """Return the entry of a table at a whole number."""

    def code(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return _entry(context, builder, signature, args, 0)

    return table.dtype(table, x), code


def _fetch_next(typing_context: Any, table: Any, x: Any) -> tuple[Any, Any]:
    """Return the entry of a table behind that at a whole number."""

    def code(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return _entry(context, builder, signature, args, 1)

    return table.dtype(table, x), code


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


fetch, fetch_next, pick, take, put = (
    cast(Callable[..., Any], intrinsic(code)) for code in (_fetch, _fetch_next, _pick, _take, _put)
)
