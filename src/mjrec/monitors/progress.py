# SPDX-License-Identifier: Apache-2.0
"""The progress bar of all that takes long: on a terminal, nothing elsewhere."""

from __future__ import annotations

import contextlib
import random
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, TypeAlias

from ..rendering.jobs import Progress

if TYPE_CHECKING:
    import rich.console

# Shows how far something is: what it is, how much is done, of how much (None where that
# is not known), and that in words.
ShowProgress: TypeAlias = Callable[[str, int, int | None, str], None]


@contextlib.contextmanager
def progress_bar(console: rich.console.Console | None = None) -> Iterator[ShowProgress]:
    """Yield a function that shows a bar for each thing that it gets.

    The bars vanish at the end: what a program prints is its own business.

    Args:
        console: where to, standard error if None; lines that are printed to it
            meanwhile stand above the bars.
    """
    is_terminal = sys.stderr.isatty() if console is None else console.is_terminal
    if not is_terminal:
        yield lambda what, done, total, words: None
        return
    # Rich draws random numbers when it is imported, and the user's are not ours. Loaded
    # only where there is a bar to show.
    state = random.getstate()
    import rich.console
    import rich.progress

    random.setstate(state)
    bars = rich.progress.Progress(
        rich.progress.TextColumn("{task.description}", markup=False),
        rich.progress.BarColumn(bar_width=20),
        rich.progress.TextColumn("{task.fields[words]}"),
        rich.progress.TimeElapsedColumn(),
        rich.progress.TextColumn("left:"),
        rich.progress.TimeRemainingColumn(),
        console=console or rich.console.Console(stderr=True),
        transient=True,
    )
    tasks: dict[str, rich.progress.TaskID] = {}

    def show(what: str, done: int, total: int | None, words: str) -> None:
        if what not in tasks:
            tasks[what] = bars.add_task(what, total=None, words="")
        bars.update(tasks[what], completed=done, total=total, words=words)

    with bars:
        yield show


@contextlib.contextmanager
def render_progress(
    console: rich.console.Console | None = None, *, title: str = "rendering"
) -> Iterator[Callable[[Progress], None]]:
    """Yield a function that shows how far a rendering is.

    Args:
        console: as for `progress_bar`.
        title: what is rendered.
    """
    with progress_bar(console) as show:

        def show_rendering(progress: Progress) -> None:
            """Count frames, or videos where the number of frames is not known."""
            videos, frames = progress.videos_done, progress.frames_done
            words = f"{videos}/{progress.videos} videos, {frames}"
            if progress.frames is None:
                show(title, videos, progress.videos, f"{words} frames")
            else:
                words = f"{words}/{progress.frames} frames"
                show(title, frames, progress.frames, words)

        yield show_rendering
