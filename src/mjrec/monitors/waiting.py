# SPDX-License-Identifier: Apache-2.0
"""The progress bar of a monitor that waits for its videos."""

from __future__ import annotations

import contextlib
import random
import sys
from collections.abc import Callable, Iterator

from ..rendering.progress import Progress


@contextlib.contextmanager
def waiting_display() -> Iterator[Callable[[Progress], None]]:
    """Yield a function that shows how far the rendering is, on a terminal only.

    The bar goes to standard error and vanishes at the end: what a program prints is
    its own business.
    """
    if not sys.stderr.isatty():
        yield _nothing
        return
    # Rich draws random numbers when it is imported, and the user's are not ours. Loaded
    # only where there is a bar to show.
    state = random.getstate()
    import rich.console

    from .render_progress import RenderProgress

    random.setstate(state)
    console = rich.console.Console(stderr=True)
    with RenderProgress(console, title="rendering ") as progress:
        yield progress.show


def _nothing(progress: Progress) -> None:
    del progress
