# SPDX-License-Identifier: Apache-2.0
"""Errors that come home from another process, as JSON.

Pickle would do it too, and would let whatever writes into the pipe run code.
"""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .errors import KINDS, Error


def carried(error: BaseException) -> dict[str, Any]:
    """Return what `unpacked` makes an error like `error` of, in plain JSON."""
    if not isinstance(error, Error):
        told = "".join(traceback.format_exception(error)).strip()
        return {
            "type": "Error",
            "message": f"A worker failed in a way that nobody foresaw.\n{told}",
        }
    # One that a module made of its own is known by the nearest that everybody knows.
    kinds = (kind.__name__ for kind in type(error).__mro__)
    return {
        "type": next(name for name in kinds if name in KINDS),
        "message": str(error),
        "facts": {k: _plain(v) for k, v in vars(error).items() if _is_plain(v)},
    }


def unpacked(plain: Mapping[str, Any]) -> Error:
    """Return the error that was carried.

    It has the class, the message and, of the attributes, numbers, texts, lists of them
    and paths.
    """
    kind = KINDS.get(plain["type"], Error)
    error = kind.__new__(kind)
    error.args = (plain["message"],)
    for key, value in plain.get("facts", {}).items():
        setattr(error, key, Path(value["path"]) if isinstance(value, dict) else value)
    return error


def _is_plain(value: object) -> bool:
    if isinstance(value, list):
        return all(isinstance(item, str | int | float) for item in value)
    return value is None or isinstance(value, str | int | float | Path)


def _plain(value: Any) -> Any:
    return {"path": str(value)} if isinstance(value, Path) else value
