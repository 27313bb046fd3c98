# SPDX-License-Identifier: Apache-2.0
"""What the options of an environment say, on any command's line."""

from __future__ import annotations

from typing import Any

from ..errors import InvalidArgument
from ..json_text import has_nan, loads


def kwargs_of(text: str, option: str = "--env-kwargs") -> dict[str, Any]:
    """Return the arguments that an option names.

    Raises:
        InvalidArgument: it is no JSON object, or has a key twice, or NaN.
    """
    try:
        kwargs = loads(text)
    except ValueError as error:
        raise InvalidArgument(
            f"{option} must be a JSON object, got {text!r}: {error}."
        ) from None
    if not isinstance(kwargs, dict):
        raise InvalidArgument(f"{option} must be a JSON object, got {text!r}.")
    for name, value in kwargs.items():
        if has_nan(value):
            raise InvalidArgument(
                f"{option} must be a JSON object, and {name!r} holds NaN, which "
                "JSON has no number for."
            )
    return kwargs
