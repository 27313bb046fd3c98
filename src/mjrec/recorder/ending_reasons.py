# SPDX-License-Identifier: Apache-2.0
"""The recorded reasons why an episode ended early."""

from __future__ import annotations

import sys
from typing import Any

from ..signals import received

CLOSE, EXCEPTION, INTERRUPT, RESET = "close", "exception", "interrupt", "reset"

_LONGEST_MESSAGE = 1000


def ending(error: BaseException | None, *, otherwise: str = CLOSE) -> dict[str, Any]:
    """Return the facts about an early end, possibly caused by an exception.

    Args:
        error: the exception; None if there was none.
        otherwise: the reason to give if there was no exception, or only an ordinary
            way to leave a program (`sys.exit()`).

    Returns:
        `reason` and, for the reason "exception", `exception` with its `type` (module
        and name; built-in exceptions without a module) and its `message`.
    """
    if error is None or _is_ordinary(error):
        return {"reason": otherwise}
    if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit):
        return {"reason": INTERRUPT}
    return {
        "reason": EXCEPTION,
        "exception": {"type": _name(type(error)), "message": _message(error)},
    }


def last_error() -> BaseException | None:
    """Return the exception that is ending this process, if it can be found.

    At exit the interpreter has already printed and stored it. In an interactive session
    the stored exception proves nothing, because printed exceptions do not end it.
    """
    if hasattr(sys, "ps1"):
        return None
    # `last_exc` since Python 3.12.
    error = getattr(sys, "last_exc", None) or getattr(sys, "last_value", None)
    return error if isinstance(error, BaseException) else received()


def _is_ordinary(error: BaseException) -> bool:
    return type(error) is SystemExit


def _name(kind: type) -> str:
    if kind.__module__ == "builtins":
        return kind.__qualname__
    return f"{kind.__module__}.{kind.__qualname__}"


def _message(error: BaseException) -> str:
    try:
        return str(error)[:_LONGEST_MESSAGE]
    except Exception:  # a user's __str__ may do anything
        return ""
