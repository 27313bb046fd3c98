# SPDX-License-Identifier: Apache-2.0
"""Checked access to values in untrusted JSON, and dataclasses as JSON objects.

The functions here raise `ValueError` with a reason that fits after "Cannot read FILE:".
The readers of the file formats turn this error into `UnreadableFile`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import functools
import re
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, TypeVar

from ..errors import UnreadableFile
from ..json_text import float_from_json, loads
from .regular_files import read_regular

D = TypeVar("D")
T = TypeVar("T")

_Read = Callable[[Any], Any]

# Enough for the statistics of several million episodes.
_LONGEST_FILE = 1 << 28

# The largest integer that every language's JSON reader can hold.
_LARGEST_INTEGER = 2**63 - 1

_LONGEST_NAME = 255

_RATE = re.compile(r"\d{1,18}(/\d{1,18})?", re.ASCII)

_KINDS = {
    bool: "true or false",
    dict: "an object",
    float: "a number",
    int: "a whole number",
    list: "a list",
    str: "a string",
    type(None): "null",
}


@contextlib.contextmanager
def unreadable(path: Path) -> Iterator[None]:
    """Turn errors about a file's content in the block into `UnreadableFile`."""
    try:
        yield
    except OSError as error:
        raise UnreadableFile(path, error.strerror or error) from error
    except MemoryError as error:
        raise UnreadableFile(path, "it needs more memory than is available") from error
    except ValueError as error:
        raise UnreadableFile(path, error) from error


def read_object(path: Path) -> Mapping[str, Any]:
    """Return the JSON object in a file.

    Raises:
        OSError: the file does not exist or cannot be read.
        ValueError: the file is not a regular file in its directory, is too large, or
            does not contain a JSON object.
    """
    return json_object(read_regular(path, limit=_LONGEST_FILE))


def json_object(data: bytes) -> Mapping[str, Any]:
    """Return the JSON object encoded in `data`."""
    try:
        value = loads(data)
    except UnicodeDecodeError as error:
        raise ValueError("it is not UTF-8 text") from error
    except ValueError as error:
        raise ValueError(f"it is not valid JSON ({error})") from error
    return mapping(value)


def field(
    values: Mapping[str, Any], key: str, convert: Callable[[Any], T], **default: T
) -> T:
    """Return the converted `values[key]`, or `default` if the key is missing."""
    if key not in values:
        if default:
            return default["default"]
        raise ValueError(f"it has no {key!r}")
    try:
        return convert(values[key])
    except ValueError as error:
        raise ValueError(f"its {key!r} is wrong: {error}") from error


def optional(convert: Callable[[Any], T]) -> Callable[[Any], T | None]:
    """Return a conversion that leaves null unchanged."""
    return lambda value: None if value is None else convert(value)


def list_of(convert: Callable[[Any], T]) -> Callable[[Any], tuple[T, ...]]:
    """Return a conversion that converts each item of a list."""
    return lambda value: tuple(map(convert, _checked(value, list)))


def one_of(*known: str) -> Callable[[Any], str]:
    """Return a conversion that accepts only these strings."""

    def convert(value: Any) -> str:
        if value not in known:
            raise ValueError(f"{value!r:.80} is not one of {', '.join(known)}")
        return str(value)

    return convert


def mapping(value: Any) -> Mapping[str, Any]:
    """Return a value unchanged if it is an object."""
    return _checked(value, dict)


def facts_in(value: object) -> Mapping[str, Any]:
    """Return a mapping unchanged, or an empty one for any other value."""
    return value if isinstance(value, Mapping) else {}


def text(value: Any) -> str:
    """Return a value unchanged if it is a valid string."""
    try:
        _checked(value, str).encode()
    except UnicodeEncodeError as error:
        raise ValueError("it is not a valid Unicode string") from error
    return str(value)


def base_name(value: Any) -> str:
    """Return a value unchanged if it is the name of a file in the same directory."""
    name = text(value)
    if (
        name in ("", ".", "..")
        or any(c in name for c in "/\\")
        or not name.isprintable()
        or len(name.encode()) > _LONGEST_NAME
    ):
        raise ValueError(
            f"{name[:_LONGEST_NAME]!r} is not the name of a file in the same directory"
        )
    return name


def boolean(value: Any) -> bool:
    """Return a value unchanged if it is a boolean."""
    return _checked(value, bool)


def integer(value: Any) -> int:
    """Return a value as an integer; a float such as 3.0 is accepted."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if abs(_checked(value, int)) > _LARGEST_INTEGER:
        raise ValueError("it is too large for a count")
    return int(value)


def positive(value: Any) -> int:
    """Return a value as an integer that is at least 1."""
    count = integer(value)
    if count < 1:
        raise ValueError(f"{count} is less than 1")
    return count


def number(value: Any) -> float:
    """Return a value as a float. Null becomes NaN, which `json_text` writes as null."""
    if not isinstance(value, float | None):
        _checked(value, int)
    try:
        return float_from_json(value)
    except OverflowError as error:
        raise ValueError("it is too large for a float") from error


def rate(value: Any) -> Fraction:
    """Return a positive rate from a string such as "60000/1001"."""
    if not _RATE.fullmatch(text(value)):
        raise ValueError(f"{value!r:.80} is not a valid rate")
    above, _, below = value.partition("/")
    if not int(above) or not int(below or 1):
        raise ValueError(f"{value!r:.80} is not a valid rate")
    return Fraction(value)


def _checked(value: Any, kind: type[T]) -> T:
    # bool is a subclass of int, but true is not a number in JSON.
    if type(value) is not kind:
        found = _KINDS.get(type(value), type(value).__name__)
        raise ValueError(f"it must be {_KINDS[kind]}, not {found}")
    return value


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
    """Convert a dataclass to a JSON object. `json_text` writes NaN as null."""
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
    """Return each field's name and reader, and whether the field is required."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return [
        (
            each.name,
            _reader(hints[each.name]),
            each.default is each.default_factory is dataclasses.MISSING,
        )
        for each in dataclasses.fields(kind)
    ]


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
    read = _reader(inner[1])
    return lambda value: {text(k): read(v) for k, v in mapping(value).items()}


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
