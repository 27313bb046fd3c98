# SPDX-License-Identifier: Apache-2.0
"""Reasons why an episode ended early, as recorded in files."""

from __future__ import annotations

import sys
from typing import Any

from ..signals import received

CLOSE, EXCEPTION, INTERRUPT, RESET = "close", "exception", "interrupt", "reset"

_LONGEST_MESSAGE = 1000


def ending(error: BaseException | None, *, otherwise: str = CLOSE) -> dict[str, Any]:
    """Return the facts about an early end, which an exception may have caused.

    Args:
        error: the exception, or None.
        otherwise: the reason to give if there was no exception, or if the program left
            in an ordinary way (`sys.exit()`).

    Returns:
        A dictionary with the key `reason`. If the reason is "exception", the key
        `exception` holds the exception's `type` (its module and name, or only its name
        if it is built in) and its `message`.
    """
    if error is None or type(error) is SystemExit:
        return {"reason": otherwise}
    if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit):
        return {"reason": INTERRUPT}
    return {
        "reason": EXCEPTION,
        "exception": {"type": _name(type(error)), "message": _message(error)},
    }


def last_error() -> BaseException | None:
    """Return the exception that is ending this process, if it can be found.

    At exit, the interpreter has already printed and stored the exception. In an
    interactive session, the stored exception is not evidence, because exceptions do not
    end such a session.
    """
    if hasattr(sys, "ps1"):
        return None
    # `last_exc` exists since Python 3.12.
    error = getattr(sys, "last_exc", None) or getattr(sys, "last_value", None)
    return error if isinstance(error, BaseException) else received()


def _name(kind: type) -> str:
    if kind.__module__ == "builtins":
        return kind.__qualname__
    return f"{kind.__module__}.{kind.__qualname__}"


def _message(error: BaseException) -> str:
    try:
        return str(error)[:_LONGEST_MESSAGE]
    except Exception:  # a user's __str__ may raise anything
        return ""
