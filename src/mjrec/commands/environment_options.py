# SPDX-License-Identifier: Apache-2.0
"""What the options of an environment say, on any command's line."""

from __future__ import annotations

import json
from typing import Any

from ..errors import InvalidArgument


def kwargs_of(text: str) -> dict[str, Any]:
    """Return the arguments that `--env-kwargs` names.

    Raises:
        InvalidArgument: it is no JSON object.
    """
    try:
        kwargs = json.loads(text)
    except ValueError as error:
        raise InvalidArgument(
            f"--env-kwargs must be a JSON object, got {text!r}: {error}."
        ) from None
    if not isinstance(kwargs, dict):
        raise InvalidArgument(f"--env-kwargs must be a JSON object, got {text!r}.")
    return kwargs
