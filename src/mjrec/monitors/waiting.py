# SPDX-License-Identifier: Apache-2.0
"""The progress bar of a monitor that waits for its videos."""

from __future__ import annotations

import contextlib
import random
import sys
from collections.abc import Callable, Iterator

from ..rendering.progress import Progress

__all__ = ["waiting_display"]


@contextlib.contextmanager
def waiting_display() -> Iterator[Callable[[Progress], None]]:
    """Yield a function that shows how far the rendering is, on a terminal only.

    The bar goes to standard error and vanishes at the end: what a program prints is
    its own business.
    """
    if not sys.stderr.isatty():
        yield _nothing
        return
    _load_rich()
    import rich.console
    import rich.progress

    with rich.progress.Progress(
        rich.progress.TextColumn("rendering {task.fields[videos]}"),
        rich.progress.BarColumn(),
        rich.progress.TextColumn("{task.completed}/{task.total} frames"),
        rich.progress.TimeRemainingColumn(),
        console=rich.console.Console(stderr=True),
        transient=True,
    ) as bar:
        task = bar.add_task("", total=None, videos="")

        def show(progress: Progress) -> None:
            bar.update(
                task,
                completed=progress.frames_done,
                total=progress.frames,
                videos=f"{progress.videos_done}/{progress.videos} videos",
            )

        yield show


def _load_rich() -> None:
    # It draws random numbers when it is imported, and the user's are not ours. Loaded
    # only where there is a bar to show.
    state = random.getstate()
    import rich.progress  # noqa: F401

    random.setstate(state)


def _nothing(progress: Progress) -> None:
    del progress
