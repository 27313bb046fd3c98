# SPDX-License-Identifier: Apache-2.0
"""JSON that every reader accepts and that can be read back without loss.

JSON (RFC 8259) has no NaN or infinity. Infinity is written as the number `1e999`: this
is valid JSON, and every IEEE 754 reader, including Python's, reads it as infinity.
NaN is written as `null`. NumPy scalars and arrays are written as numbers and lists.

Input may be untrusted. It is rejected if two readers could interpret it differently
(because of a duplicate key), or if it needs far more memory or stack than its length
suggests.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from typing import Any

import numpy as np

# The maximum nesting depth. Python writes, compares and prints values recursively, and
# all of this must work for any value that can be read.
_DEEPEST = 100

# The maximum number of lists, objects and their items; each takes about 80 bytes at
# most. The statistics of four million episodes reach this number.
_MOST_VALUES = 1 << 24

_FLAT = {str, int, float, bool, type(None)}

# Strings, and Python's tokens for the numbers that JSON lacks.
_TOKENS = re.compile(r'"(?:[^"\\]|\\.)*"|-?Infinity|NaN')
_NUMBERS = {"NaN": "null", "Infinity": "1e999", "-Infinity": "-1e999"}


def dumps(value: object, *, indent: int | None = None) -> str:
    """Return `value` as JSON text.

    Objects that JSON cannot represent (a path, an environment's own option type, a dict
    with the keys 1 and "1") are written as `{"repr": ...}`, because purely informative
    values must never stop a run.
    """
    # Nearly all values are plain, and those can be written many times faster.
    try:
        text = json.dumps(
            value if _is_plain(value) else _made_plain(value), indent=indent
        )
    except TypeError:
        text = json.dumps(_made_plain(value), indent=indent)
    if "NaN" in text or "Infinity" in text:
        text = _TOKENS.sub(lambda match: _NUMBERS.get(match[0], match[0]), text)
    return text


def loads(text: str | bytes) -> Any:
    """Parse JSON text and return its value.

    The tokens `NaN` and `Infinity`, which are not JSON but which gym writes, are
    accepted too.

    Raises:
        ValueError: the text is not JSON or not UTF-8, contains an object with a
            duplicate key, or has far more values or much deeper nesting than any
            recording.
    """
    if isinstance(text, bytes):
        text = text.decode("utf-8-sig")
    beginnings = text.count("[") + text.count("{")
    if beginnings + text.count(",") > _MOST_VALUES:
        raise ValueError(f"it has more than {_MOST_VALUES} values")
    try:
        value = json.loads(text, object_pairs_hook=_object)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if beginnings > _DEEPEST and not _is_plain(value):
        raise ValueError("it is nested too deeply")
    return value


def float_from_json(value: float | None) -> float:
    """Convert a number read from JSON to a float; None (`null`) becomes NaN."""
    return math.nan if value is None else float(value)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        counts = Counter(key for key, _ in pairs)
        ((twice, _),) = counts.most_common(1)
        raise ValueError(f"it contains the key {twice!r:.100} twice")
    return values


def has_nan(value: object) -> bool:
    """Return whether a JSON value contains NaN, which would be written as `null`."""
    match value:
        case float():
            return math.isnan(value)
        case dict():
            return any(map(has_nan, value.values()))
        case list() | tuple():
            return any(map(has_nan, value))
    return False


def _is_plain(value: object, room: int = _DEEPEST) -> bool:
    """Return whether all keys are strings and nothing is nested too deeply."""
    if isinstance(value, dict):
        if not {str}.issuperset(map(type, value)):
            return False
        value = value.values()
    elif not isinstance(value, list | tuple):
        return True
    # Flat values are tested first because statistics are long lists of numbers.
    return room > 0 and (
        _FLAT.issuperset(map(type, value))
        or all(_is_plain(item, room - 1) for item in value if type(item) not in _FLAT)
    )


def _made_plain(value: object, outer: tuple[int, ...] = ()) -> Any:
    """Return `value` converted to types that JSON supports.

    Args:
        value: any object.
        outer: the ids of the objects that contain `value`.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    is_too_deep = len(outer) == _DEEPEST - 1 or id(value) in outer
    inside = (*outer, id(value))
    match value:
        case None | bool() | str() | int() | float():
            return value
        case dict() if not is_too_deep and len(set(map(_key, value))) == len(value):
            return {_key(k): _made_plain(item, inside) for k, item in value.items()}
        case list() | tuple() | set() | frozenset() if not is_too_deep:
            return [_made_plain(item, inside) for item in value]
    try:
        return {"repr": repr(value)}
    except RecursionError:
        return {"repr": f"<{type(value).__name__}, nested very deeply>"}


def _key(key: object) -> str:
    if key is None or isinstance(key, bool | int | float):
        return json.dumps(key)
    return str(key)
