# SPDX-License-Identifier: Apache-2.0
"""Why an episode ended before it was over, as files say it."""

from __future__ import annotations

import sys
from typing import Any

from ..signals import received

CLOSE, EXCEPTION, INTERRUPT, RESET = "close", "exception", "interrupt", "reset"

_LONGEST_MESSAGE = 1000


def ending(error: BaseException | None, *, otherwise: str = CLOSE) -> dict[str, Any]:
    """Return the facts of an end that an exception has brought about.

    Args:
        error: the exception; None where there was none.
        otherwise: the reason, where there was none, or one that is an ordinary way to
            leave a program (`sys.exit()`).

    Returns:
        `reason` and, for the reason "exception", `exception` with its `type` (module
        and name; those of Python itself without a module) and its `message`.
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
    """Return the exception that is ending this process, as far as that can be seen.

    At exit the interpreter has printed it already, and kept it. An interactive session
    keeps every one that it has printed, and does not end by it.
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
