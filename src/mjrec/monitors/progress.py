# SPDX-License-Identifier: Apache-2.0
"""Progress of a rendering: a bar on a terminal, nothing elsewhere."""

from __future__ import annotations

import contextlib
import random
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from ..rendering.jobs import Progress

if TYPE_CHECKING:
    import rich.console


@contextlib.contextmanager
def render_progress(
    console: rich.console.Console | None = None, *, title: str = ""
) -> Iterator[Callable[[Progress], None]]:
    """Yield a function that shows how far a rendering is, on a terminal only.

    The bar vanishes at the end: what a program prints is its own business.

    Args:
        console: where to, standard error if None; lines that are printed to it
            meanwhile stand above the bar.
        title: stands before the number of videos.
    """
    is_terminal = sys.stderr.isatty() if console is None else console.is_terminal
    if not is_terminal:
        yield lambda progress: None
        return
    # Rich draws random numbers when it is imported, and the user's are not ours. Loaded
    # only where there is a bar to show.
    state = random.getstate()
    import rich.console
    import rich.progress

    random.setstate(state)
    bar = rich.progress.Progress(
        rich.progress.TextColumn("{task.description}{task.fields[videos]}"),
        rich.progress.BarColumn(bar_width=20),
        rich.progress.TextColumn("{task.fields[frames]}"),
        rich.progress.TimeElapsedColumn(),
        rich.progress.TextColumn("left:"),
        rich.progress.TimeRemainingColumn(),
        console=console or rich.console.Console(stderr=True),
        transient=True,
    )
    task = bar.add_task(title, total=0, videos="", frames="")

    def show(progress: Progress) -> None:
        """Count frames, or videos where nobody knows how many frames there are."""
        done, total = progress.frames_done, progress.frames
        bar.update(
            task,
            completed=progress.videos_done if total is None else done,
            total=progress.videos if total is None else total,
            videos=f"{progress.videos_done}/{progress.videos} videos",
            frames=f"{done} frames" if total is None else f"{done}/{total} frames",
        )

    with bar:
        yield show
