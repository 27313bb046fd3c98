# SPDX-License-Identifier: Apache-2.0
"""mjrec: a headless MuJoCo recorder.

Importing this package does not load a simulator, OpenGL or ffmpeg, and does not change
environment variables. Each public name is loaded on first use.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

from . import errors

# All errors are public.
from .errors import *  # noqa: F403
from .errors import MissingDependency

# The stub next to this file lists the public names; type checkers read it too.
_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_IMPORT = re.compile(r"^from \.(\S+) import (\w+) as ", re.MULTILINE)
_LAZY = {name: module for module, name in _IMPORT.findall(_STUB)}

# Only names that need no extra, so that `from mjrec import *` always works.
# `DmEnvMonitor` needs dm_env, and replays need viser.
__all__ = sorted({*errors.KINDS, *_LAZY} - {"DmEnvMonitor", "Replay", "write_replay"})


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("mjrec")
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = importlib.import_module(f".{_LAZY[name]}", __name__)
    except ModuleNotFoundError as error:
        if error.name != "dm_env":
            raise
        raise MissingDependency(
            "dm_env", purpose=name, install='pip install "mjrec[dm-control]"'
        ) from error
    value = getattr(module, name)
    # Cached so that later uses cost nothing.
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
