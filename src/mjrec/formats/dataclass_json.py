# SPDX-License-Identifier: Apache-2.0
"""Conversion between dataclasses and JSON objects with the same field names."""

from __future__ import annotations

import dataclasses
import enum
import functools
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, TypeVar

from .json_fields import (
    boolean,
    field,
    integer,
    list_of,
    mapping,
    number,
    one_of,
    optional,
    text,
)

D = TypeVar("D")

_Read = Callable[[Any], Any]

_PLAIN: dict[object, _Read] = {
    Any: lambda value: value,
    bool: boolean,
    float: number,
    int: integer,
    str: text,
    Fraction: lambda value: Fraction(text(value)),
    Path: lambda value: Path(text(value)),
}


def to_json(instance: Any) -> dict[str, Any]:
    """Convert a dataclass to a JSON object. NaN is kept; `json_text` makes it null."""
    names = [each.name for each in dataclasses.fields(instance)]
    return {name: _plain(getattr(instance, name)) for name in names}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_json(value)
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    # Fractions become strings, which are exact.
    return str(value) if isinstance(value, Path | Fraction) else value


def from_json(kind: type[D], value: Any) -> D:
    """Create a dataclass from the output of `to_json`.

    Unknown keys are ignored, and missing keys get the field's default. For a field
    annotated as `Annotated[kind, read]`, `read` converts the value.

    Raises:
        ValueError: `value` is not a valid JSON object for this class.
    """
    values = mapping(value)
    given = {
        name: field(values, name, read)
        for name, read, is_needed in _readers(typing.cast(Any, kind))
        if is_needed or name in values
    }
    return kind(**given)


# Cached because a journal may have millions of entries.
@functools.cache
def _readers(kind: Any) -> list[tuple[str, _Read, bool]]:
    """Return name and reader of each field, and whether it has no default."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return [
        (each.name, _reader(hints[each.name]), _is_needed(each))
        for each in dataclasses.fields(kind)
    ]


def _is_needed(each: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return each.default is missing and each.default_factory is missing


def _reader(hint: Any) -> _Read:
    """Return a function that reads a field with this annotation."""
    if hint in _PLAIN:
        return _PLAIN[hint]
    if dataclasses.is_dataclass(hint):
        return functools.partial(from_json, typing.cast(type, hint))
    if isinstance(hint, enum.EnumType):
        return hint
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return typing.cast(_Read, hint.__metadata__[0])
    if origin is typing.Literal:
        return one_of(*inner)
    if origin in (types.UnionType, typing.Union):
        return optional(
            _any_of([_reader(each) for each in inner if each is not types.NoneType])
        )
    if origin is Sequence:
        return list_of(_reader(inner[0]))
    if origin is tuple:
        return _tuple(inner)
    return _values(_reader(inner[1]))


def _any_of(readers: list[_Read]) -> _Read:
    def read(value: Any) -> Any:
        for each in readers[:-1]:
            try:
                return each(value)
            except ValueError:
                continue
        return readers[-1](value)

    return read


def _tuple(inner: tuple[Any, ...]) -> Callable[[Any], tuple[Any, ...]]:
    if inner[1] is Ellipsis:
        return list_of(_reader(inner[0]))
    readers = [_reader(each) for each in inner]

    def read_so_many(value: Any) -> tuple[Any, ...]:
        items = list_of(_PLAIN[Any])(value)
        if len(items) != len(inner):
            raise ValueError(f"it must have {len(inner)} values, not {len(items)}")
        return tuple(read(item) for read, item in zip(readers, items, strict=True))

    return read_so_many


def _values(read: _Read) -> Callable[[Any], Mapping[str, Any]]:
    def read_values(value: Any) -> Mapping[str, Any]:
        return {text(key): read(item) for key, item in mapping(value).items()}

    return read_values
