# SPDX-License-Identifier: Apache-2.0
"""Help texts: the docstrings of commands, as shown in a terminal."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Annotated, TypeVar, get_type_hints

import tyro

C = TypeVar("C", bound=Callable[..., object])

# The continuation lines of an argument's description in a Google-style docstring.
_CONTINUATION = re.compile(r"\n {12,}(?=\S)")
_NO_DEFAULT = tyro.conf.arg(help_behavior_hint="")
# How all commands are parsed: flags have no --no-... form, and "None" is not a value.
PARSING = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)


def flowing_help(command: C) -> C:
    """Prepare an object's docstring and signature for tyro; return the object.

    The object is a command, or a class of options that several commands share. Lines of
    a description are joined, because tyro would otherwise break it where the docstring
    does and again at the edge of the terminal. Defaults that the description explains
    (None) or that are obvious (an omitted option) are not repeated after it.
    """
    command.__doc__ = _CONTINUATION.sub(" ", command.__doc__ or "")
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        default = parameter.default
        # Without a default, tyro shows an empty one for a list of any length.
        is_missing = default is inspect.Parameter.empty or default == ()
        if is_missing or default is None or default is False:
            hints[name] = Annotated[hints[name], _NO_DEFAULT]
    command.__annotations__ = hints
    return command
