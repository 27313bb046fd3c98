# SPDX-License-Identifier: Apache-2.0
"""Help texts: the docstrings of commands, with their lines joined."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TypeVar

C = TypeVar("C", bound=Callable[..., object])

# The continuation lines of an argument's description in a Google-style docstring.
_CONTINUATION = re.compile(r"\n {12,}(?=\S)")


def flowing_help(command: C) -> C:
    """Join the lines of each description in an object's docstring; return the object.

    The object is a command, or a class of options that several commands share.
    Otherwise tyro would break a description where the docstring does, and again at the
    edge of the terminal.
    """
    command.__doc__ = _CONTINUATION.sub(" ", command.__doc__ or "")
    return command
