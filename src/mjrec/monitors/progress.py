# SPDX-License-Identifier: Apache-2.0
"""Progress of long operations: bars on a terminal, or an occasional line in a log."""

from __future__ import annotations

import contextlib
import logging
import random
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, TypeAlias

from ..plain_text import counted
from ..rendering.jobs import Progress

if TYPE_CHECKING:
    import rich.console

# Shows the progress of an operation: its name, the amount done, the total amount (None
# if unknown), and the same in words.
ShowProgress: TypeAlias = Callable[[str, int, int | None, str], None]

logger = logging.getLogger(__name__)

# Seconds before a log's first line about rendering, and between later lines.
_FIRST_LINE_S = 5.0
_LINES_EVERY_S = 30.0


@contextlib.contextmanager
def progress_bar(console: rich.console.Console | None = None) -> Iterator[ShowProgress]:
    """Yield a function that shows a progress bar for each operation passed to it.

    The bars are removed at the end, so they do not remain in the program's output.

    Args:
        console: the console to use; if None, standard error. Lines printed to the
            console in the meantime appear above the bars.
    """
    if not _is_terminal(console):
        yield lambda what, done, total, words: None
        return
    # Imported only if there is a bar to show. Importing Rich draws random numbers,
    # which must not change the user's random state.
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
    """Yield a function that shows the progress of rendering.

    Without a terminal, it writes a line after 5 seconds, and then one every 30 seconds.

    Args:
        console: see `progress_bar`.
        title: the bar's label.
    """
    if not _is_terminal(console):
        yield _progress_lines(console, title)
        return
    with progress_bar(console) as show:

        def show_rendering(progress: Progress) -> None:
            """Count frames, or videos if the number of frames is unknown."""
            videos, frames = progress.videos_done, progress.frames_done
            words = f"{videos}/{progress.videos} videos, {frames}"
            if progress.frames is None:
                show(title, videos, progress.videos, f"{words} frames")
            else:
                words = f"{words}/{progress.frames} frames"
                show(title, frames, progress.frames, words)

        yield show_rendering


def _progress_lines(
    console: rich.console.Console | None, title: str
) -> Callable[[Progress], None]:
    next_line = time.monotonic() + _FIRST_LINE_S

    def show_line(progress: Progress) -> None:
        nonlocal next_line
        if time.monotonic() < next_line or not progress.videos:
            return
        next_line = time.monotonic() + _LINES_EVERY_S
        line = (
            f"{title.capitalize()}: {progress.videos_done} of "
            f"{counted(progress.videos, 'video')} done"
        )
        if progress.frames:
            line += f", {progress.frames_done:,} of {counted(progress.frames, 'frame')}"
        if console is None:
            # Python shows warnings on stderr even if nothing configures logging.
            logger.warning("%s.", line)
        elif not console.quiet:
            # A command's results are on standard output.
            sys.stderr.write(f"{line}.\n")

    return show_line


def _is_terminal(console: rich.console.Console | None) -> bool:
    return sys.stderr.isatty() if console is None else console.is_terminal
