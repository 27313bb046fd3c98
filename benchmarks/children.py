# SPDX-License-Identifier: Apache-2.0
"""Calling a function in a new Python process.

The speed and memory of a process depend on what it has imported, allocated and drawn
before. A new process has done none of that.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

Answer = TypeVar("Answer")

_ROOT = Path(__file__).parents[1]
_END_OF_STDERR = 4000
# Rendering ten thousand frames in software takes half an hour on a slow machine.
_TIMEOUT_S = 7200


class ChildFailed(RuntimeError):
    """A measurement failed."""


def call(
    function: Callable[..., Answer],
    *,
    environ: dict[str, str] | None = None,
    **arguments: Any,
) -> Answer:
    """Call a function in a new process and return its result.

    Args:
        function: a module-level function in this package.
        environ: environment variables to set in addition to those of this process.
        arguments: keyword arguments for the function. JSON must be able to represent
            the arguments and the result.

    Raises:
        ChildFailed: the function raised an exception, or its process died. The message
            contains the end of the process's error output.
    """
    name = f"{function.__module__}:{function.__qualname__}"
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.children", name],
        input=json.dumps(arguments),
        capture_output=True,
        text=True,
        cwd=_ROOT,
        env={**os.environ, **(environ or {})},
        timeout=_TIMEOUT_S,
        check=False,
    )
    if done.returncode != 0:
        raise ChildFailed(
            f"{name} ended with exit status {done.returncode}:\n"
            f"{done.stderr[-_END_OF_STDERR:]}"
        )
    answer: Answer = json.loads(done.stdout)
    return answer


def _answer() -> None:
    """Call the requested function and write only its result to standard output."""
    output = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    # Libraries may print, for example progress bars, so their output goes to stderr.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    module, _, name = sys.argv[1].partition(":")
    function = getattr(importlib.import_module(module), name)
    with output:
        json.dump(function(**json.load(sys.stdin)), output)


if __name__ == "__main__":
    _answer()
