# SPDX-License-Identifier: Apache-2.0
"""Values taken out of JSON that a stranger may have written.

Every function here raises `ValueError` with a reason that can follow "Cannot read
FILE:"; the readers of the file formats turn it into `UnreadableFile`.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, TypeVar

from ..errors import UnreadableFile
from ..json_text import float_from_json, loads
from .regular_files import read_regular

T = TypeVar("T")

# The statistics of several million episodes.
_LONGEST_FILE = 1 << 28

# Counts and numbers of things, as every other language can hold them.
_LARGEST_INTEGER = 2**63 - 1

_LONGEST_NAME = 255

_RATE = re.compile(r"\d{1,18}(/\d{1,18})?", re.ASCII)

_KINDS = {
    bool: "true or false",
    dict: "an object",
    float: "a number",
    int: "a whole number",
    list: "a list",
    str: "a text",
    type(None): "null",
}


@contextlib.contextmanager
def unreadable(path: Path) -> Iterator[None]:
    """Turn an error of the block about the content of a file into `UnreadableFile`."""
    try:
        yield
    except OSError as error:
        raise UnreadableFile(path, error.strerror or error) from error
    except MemoryError as error:
        raise UnreadableFile(path, "it needs more memory than there is") from error
    except ValueError as error:
        raise UnreadableFile(path, error) from error


def read_object(path: Path) -> Mapping[str, Any]:
    """Return the object that the whole file holds.

    Raises:
        OSError: there is no such file.
        ValueError: it is no regular file of its directory, or does not hold a JSON
            object.
    """
    return json_object(read_regular(path, limit=_LONGEST_FILE))


def json_object(data: bytes) -> Mapping[str, Any]:
    """Return the JSON object that `data` is the text of."""
    try:
        value = loads(data)
    except UnicodeDecodeError as error:
        raise ValueError("it is not UTF-8 text") from error
    except ValueError as error:
        raise ValueError(f"it is not whole JSON ({error})") from error
    return mapping(value)


def field(
    values: Mapping[str, Any], key: str, convert: Callable[[Any], T], **default: T
) -> T:
    """Return `values[key]`, converted; `default=` stands in for a missing key."""
    if key not in values:
        if default:
            return default["default"]
        raise ValueError(f"it has no {key!r}")
    try:
        return convert(values[key])
    except ValueError as error:
        raise ValueError(f"its {key!r} is wrong: {error}") from error


def optional(convert: Callable[[Any], T]) -> Callable[[Any], T | None]:
    """Return a conversion that leaves null alone."""
    return lambda value: None if value is None else convert(value)


def list_of(convert: Callable[[Any], T]) -> Callable[[Any], tuple[T, ...]]:
    """Return a conversion of each item of a list."""

    def convert_items(value: Any) -> tuple[T, ...]:
        return tuple(convert(item) for item in _checked(value, list))

    return convert_items


def one_of(*known: str) -> Callable[[Any], str]:
    """Return a conversion that takes nothing but these texts."""

    def convert(value: Any) -> str:
        if value not in known:
            raise ValueError(f"{value!r:.80} is not one of {', '.join(known)}")
        return str(value)

    return convert


def mapping(value: Any) -> Mapping[str, Any]:
    """Return an object as it is."""
    return _checked(value, dict)


def text(value: Any) -> str:
    """Return a text as it is."""
    try:
        _checked(value, str).encode()
    except UnicodeEncodeError as error:
        raise ValueError("it is a text that no file can hold") from error
    return str(value)


def base_name(value: Any) -> str:
    """Return the name of a file in the same directory."""
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
    """Return true or false as it is."""
    return _checked(value, bool)


def integer(value: Any) -> int:
    """Return a whole number, also one written with a fraction of zero."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if abs(_checked(value, int)) > _LARGEST_INTEGER:
        raise ValueError("it is larger than any count")
    return int(value)


def positive(value: Any) -> int:
    """Return a whole number that is 1 or more."""
    count = integer(value)
    if count < 1:
        raise ValueError(f"{count} is not 1 or more")
    return count


def number(value: Any) -> float:
    """Return a number; null is NaN, as `json_text` writes it."""
    if not isinstance(value, float | None):
        _checked(value, int)
    try:
        return float_from_json(value)
    except OverflowError as error:
        raise ValueError("a number is larger than a float can be") from error


def rate(value: Any) -> Fraction:
    """Check that `value` is a positive number as text, such as "60000/1001"."""
    if not _RATE.fullmatch(text(value)):
        raise ValueError(f"{value!r:.80} is no rate")
    above, _, below = value.partition("/")
    if not int(above) or not int(below or 1):
        raise ValueError(f"{value!r:.80} is no rate")
    return Fraction(value)


def _checked(value: Any, kind: type[T]) -> T:
    # bool is a subclass of int, but true is no number in JSON.
    if type(value) is not kind:
        found = _KINDS.get(type(value), type(value).__name__)
        raise ValueError(f"{_KINDS[kind]} belongs there, not {found}")
    return value
