# SPDX-License-Identifier: Apache-2.0
"""JSON that every reader accepts and that gives back what was written.

JSON (RFC 8259) has no NaN and no infinity. Infinity is written as the number
`1e999`, which is valid JSON and which every IEEE-754 reader, Python's among them,
reads as infinity; NaN is written as `null`. NumPy's scalars and arrays are written
as the numbers and lists that they hold.
"""

from __future__ import annotations

import json
import math
import uuid
from typing import Any

import numpy as np

__all__ = ["dumps", "float_from_json", "loads"]


def dumps(value: object, *, indent: int | None = None) -> str:
    """Return `value` as JSON text.

    Objects that JSON does not know (a path, an environment's own option type) are
    written as `{"repr": ...}`: what is recorded for people must never stop a run.
    """
    try:
        # Nearly everything is plain, and this is many times as fast.
        return json.dumps(value, indent=indent, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        return _dumps_any(value, indent=indent)


def loads(text: str | bytes) -> Any:
    """Return the value that `text` holds.

    Gym's own `NaN` and `Infinity` tokens, which are not JSON, are accepted too.

    Raises:
        ValueError: the text is not JSON.
    """
    return json.loads(text)


def float_from_json(value: float | None) -> float:
    """Return a number as it was before `dumps`: `null` was NaN."""
    return math.nan if value is None else float(value)


def _dumps_any(value: object, *, indent: int | None) -> str:
    # json offers no hook for floats. A string that cannot occur by chance stands in
    # for infinity and is exchanged for the number afterwards.
    mark = uuid.uuid4().hex
    try:
        plain = _plain(value, mark)
    except RecursionError:
        # A value that holds itself; Python's own text of it ends.
        plain = {"repr": repr(value)}
    text = json.dumps(plain, indent=indent, allow_nan=False)
    return text.replace(f'"-{mark}"', "-1e999").replace(f'"{mark}"', "1e999")


def _plain(value: object, mark: str) -> Any:
    match value:
        case None | bool() | str():
            return value
        case np.bool_():
            return bool(value)
        case int() | np.integer():
            return int(value)
        case float() | np.floating():
            return _plain_float(float(value), mark)
        case np.ndarray():
            return _plain(value.tolist(), mark)
        case dict():
            return {str(key): _plain(item, mark) for key, item in value.items()}
        case list() | tuple() | set() | frozenset():
            return [_plain(item, mark) for item in value]
        case _:
            return {"repr": repr(value)}


def _plain_float(value: float, mark: str) -> float | str | None:
    if math.isnan(value):
        return None
    if math.isinf(value):
        return mark if value > 0 else f"-{mark}"
    return value
