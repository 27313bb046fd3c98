# SPDX-License-Identifier: Apache-2.0
"""What `--help` shows: the docstrings, with their lines joined."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TypeVar

C = TypeVar("C", bound=Callable[..., object])

# The lines of an argument's description after its first, in a Google-style docstring.
_CONTINUATION = re.compile(r"\n {12,}(?=\S)")


def flowing_help(command: C) -> C:
    """Make each description in a docstring one line, and return what it is of.

    Of a command, or of a class that holds options of several commands.

    tyro breaks a description where the docstring does, and again where the terminal
    ends.
    """
    command.__doc__ = _CONTINUATION.sub(" ", command.__doc__ or "")
    return command
