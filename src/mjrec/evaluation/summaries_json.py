# SPDX-License-Identifier: Apache-2.0
"""Summaries as JSON, and back: each of their classes is an object with its fields."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from ..formats.json_fields import (
    field,
    integer,
    list_of,
    mapping,
    number,
    optional,
    text,
)
from .summaries import AcrossTasks, Bootstrap, TaskSummary

S = TypeVar("S", TaskSummary, AcrossTasks, Bootstrap)

_PLAIN: dict[object, Callable[[Any], Any]] = {
    float: number,
    int: integer,
    str: text,
}


def summary_to_json(summary: TaskSummary | AcrossTasks | Bootstrap) -> dict[str, Any]:
    """Return a summary as a JSON object; what is NaN becomes null."""
    return dataclasses.asdict(summary)


def summary_from_json(kind: type[S], value: Any) -> S:
    """Return what `summary_to_json` wrote.

    Keys that this version does not know are ignored.

    Raises:
        ValueError: it is no such object.
    """
    return typing.cast(S, _object(kind, value))


def _object(kind: type, value: Any) -> Any:
    values = mapping(value)
    hints = _hints(kind)
    given = {}
    for each in dataclasses.fields(kind):
        if each.name in values or _is_needed(each):
            given[each.name] = field(values, each.name, _reader(hints[each.name]))
    return kind(**given)


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _is_needed(each: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return each.default is missing and each.default_factory is missing


def _reader(hint: Any) -> Callable[[Any], Any]:
    """Return what reads a field that is annotated so."""
    if hint in _PLAIN:
        return _PLAIN[hint]
    if dataclasses.is_dataclass(hint):
        return functools.partial(_object, typing.cast(type, hint))
    inner = typing.get_args(hint)
    match typing.get_origin(hint):
        case types.UnionType:
            (known,) = (each for each in inner if each is not types.NoneType)
            return optional(_reader(known))
        case origin if origin is tuple:
            return _tuple(inner)
    return _values(_reader(inner[1]))


def _tuple(inner: tuple[Any, ...]) -> Callable[[Any], tuple[Any, ...]]:
    read = list_of(_reader(inner[0]))
    if inner[1] is Ellipsis:
        return read

    def read_so_many(value: Any) -> tuple[Any, ...]:
        items = read(value)
        if len(items) != len(inner):
            raise ValueError(f"{len(inner)} values belong there, not {len(items)}")
        return items

    return read_so_many


def _values(read: Callable[[Any], Any]) -> Callable[[Any], Mapping[str, Any]]:
    def read_values(value: Any) -> Mapping[str, Any]:
        return {text(key): read(item) for key, item in mapping(value).items()}

    return read_values
