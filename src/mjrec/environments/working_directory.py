# SPDX-License-Identifier: Apache-2.0
"""Modules in the working directory, as `python -m` finds them and commands do not."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def working_directory_importable() -> Iterator[None]:
    """Let modules in the working directory be imported, before installed ones."""
    directory = str(Path.cwd())
    sys.path.insert(0, directory)
    try:
        yield
    finally:
        # What was imported may have changed the list itself.
        with contextlib.suppress(ValueError):
            sys.path.remove(directory)
