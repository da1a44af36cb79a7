"""Named tuples as Arrow columns and back, exactly: a column for each field, its type from the field's annotation.

A field that is added to a descriptor or a directive is kept without a change here, as long as its type is one of:
numbers, text, bytes, an enumeration of integers, a named tuple of such, tuples and mappings of such, or one of them
or None.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import IntEnum
from functools import cache
from types import NoneType, UnionType
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints

import pyarrow as pa

_PLAIN: dict[Any, pa.DataType] = {
    bool: pa.bool_(),
    int: pa.int64(),
    float: pa.float64(),
    str: pa.string(),
    bytes: pa.binary(),
}


class _Form(NamedTuple):
    """How values of a type are stored. None stands for a function that returns its argument."""

    type: pa.DataType
    write: Callable[[Any], Any] | None = None
    read: Callable[[Any], Any] | None = None


def columns_of(kind: type[NamedTuple]) -> dict[str, pa.DataType]:
    """The columns of a named tuple's class.

    Raises:
        TypeError: a field of a type that is not listed above, by its name.
    """
    return {name: form.type for name, form in _forms(kind).items()}


def to_table(kind: type[NamedTuple], rows: Sequence[Sequence[Any]]) -> pa.Table:
    """Named tuples of one class as a table, a row each."""
    values = zip(*rows, strict=True) if rows else [()] * len(_forms(kind))
    return pa.table(
        {
            name: pa.array(column if write is None else map(write, column), type_)
            for (name, (type_, write, _)), column in zip(_forms(kind).items(), values, strict=True)
        }
    )


def from_table(kind: type[NamedTuple], table: pa.Table) -> list[Any]:
    """The named tuples that `to_table` wrote, equal to the last bit; a field that a table of before lacks has its default."""
    columns: list[Iterable[Any]] = []
    for name, (_, _, read) in _forms(kind).items():
        if name not in table.column_names and name in kind._field_defaults:
            columns.append([kind._field_defaults[name]] * len(table))
            continue
        column = table[name].to_pylist()
        columns.append(column if read is None else map(read, column))
    return [kind(*row) for row in zip(*columns, strict=True)]


@cache
def _forms(kind: type[NamedTuple]) -> dict[str, _Form]:
    hints = get_type_hints(kind)
    return {name: _form(hints[name], f"{kind.__name__}.{name}") for name in kind._fields}


def _form(hint: Any, where: str) -> _Form:
    origin, of = get_origin(hint), get_args(hint)
    if hint in _PLAIN:
        return _Form(_PLAIN[hint])
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        return _Form(pa.int64(), int, hint)
    if isinstance(hint, type) and hasattr(hint, "_fields"):
        return _struct(_forms(hint), lambda values: hint(*values))
    if origin in (UnionType, Union) and len(of) == 2 and NoneType in of:
        type_, write, read = _form(next(one for one in of if one is not NoneType), where)
        return _Form(type_, _or_none(write), _or_none(read))
    if origin is tuple and len({one for one in of if one is not Ellipsis}) == 1:
        type_, write, read = _form(of[0], where)
        return _Form(pa.list_(type_), _each(write, list), _each(read, tuple))
    if origin is tuple and of and Ellipsis not in of:
        return _struct({f"{k}": _form(one, where) for k, one in enumerate(of)}, tuple)
    if origin in (Mapping, dict):
        key, value = (_form(one, where) for one in of)
        if (key.write, value.write) == (None, None):
            return _Form(pa.map_(key.type, value.type), lambda pairs: list(pairs.items()), dict)
    raise TypeError(f"{where}: {hint} has no form as a column")


def _struct(forms: Mapping[str, _Form], make: Callable[[Iterator[Any]], Any]) -> _Form:
    def write(value: Any) -> dict[str, Any]:
        return {
            name: one if form.write is None else form.write(one)
            for (name, form), one in zip(forms.items(), value, strict=True)
        }

    def read(value: dict[str, Any]) -> Any:
        return make(value[name] if form.read is None else form.read(value[name]) for name, form in forms.items())

    return _Form(pa.struct([(name, form.type) for name, form in forms.items()]), write, read)


def _or_none(function: Callable[[Any], Any] | None) -> Callable[[Any], Any] | None:
    return None if function is None else lambda value: None if value is None else function(value)


def _each(function: Callable[[Any], Any] | None, make: Callable[[Iterable[Any]], Any]) -> Callable[[Any], Any]:
    return make if function is None else lambda values: make(map(function, values))
