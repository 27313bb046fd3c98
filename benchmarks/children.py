# SPDX-License-Identifier: Apache-2.0
"""Calling a function in a Python process of its own.

What a process has imported, allocated and drawn before changes how fast it is and how
much memory it has; a fresh one has done nothing yet.
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
# Ten thousand frames in software take half an hour on a slow machine.
_TIMEOUT_S = 7200


class ChildFailed(RuntimeError):
    """A measurement did not come to its end."""


def call(
    function: Callable[..., Answer],
    *,
    environ: dict[str, str] | None = None,
    **arguments: Any,
) -> Answer:
    """Return what `function` returns in a fresh process.

    Args:
        function: at the top of a module of this package.
        environ: environment variables beside those of this process.
        arguments: of the function; they and the answer are what JSON can hold.

    Raises:
        ChildFailed: it raised, or its process died; the message has the end of what it
            printed.
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
    """Do what the parent asked for; the answer is all that goes to the real output."""
    output = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    # Libraries print progress bars.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    module, _, name = sys.argv[1].partition(":")
    function = getattr(importlib.import_module(module), name)
    with output:
        json.dump(function(**json.load(sys.stdin)), output)


if __name__ == "__main__":
    _answer()
