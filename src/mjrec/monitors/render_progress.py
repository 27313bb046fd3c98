# SPDX-License-Identifier: Apache-2.0
"""Progress of a rendering: a bar on a terminal, nothing elsewhere."""

from __future__ import annotations

from types import TracebackType

import rich.console
import rich.progress

from ..rendering.progress import Progress

__all__ = ["RenderProgress"]


class RenderProgress:
    """Shows how far a rendering is.

    Args:
        console: where to; lines that are printed to it meanwhile stand above the bar.
        title: stands before the number of videos.
    """

    def __init__(self, console: rich.console.Console, *, title: str = "") -> None:
        self._bar = rich.progress.Progress(
            rich.progress.TextColumn("{task.description}{task.fields[videos]}"),
            rich.progress.BarColumn(bar_width=20),
            rich.progress.TextColumn("{task.completed}/{task.total} frames"),
            rich.progress.TimeElapsedColumn(),
            rich.progress.TextColumn("left:"),
            rich.progress.TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._task = self._bar.add_task(title, total=0, videos="")

    def __enter__(self) -> RenderProgress:
        self._bar.start()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def show(self, progress: Progress) -> None:
        """Show how far it is."""
        self._bar.update(
            self._task,
            completed=progress.frames_done,
            total=progress.frames,
            videos=f"{progress.videos_done}/{progress.videos} videos",
        )
