# SPDX-License-Identifier: Apache-2.0
"""Progress of a rendering: a bar on a terminal, nothing elsewhere."""

from __future__ import annotations

from types import TracebackType

import rich.console
import rich.progress

from ..rendering.progress import Progress


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
            rich.progress.TextColumn("{task.fields[frames]}"),
            rich.progress.TimeElapsedColumn(),
            rich.progress.TextColumn("left:"),
            rich.progress.TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._task = self._bar.add_task(title, total=0, videos="", frames="")

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
        """Show how far it is: by its frames, or by videos where nobody counts those."""
        done, total = progress.frames_done, progress.frames
        frames = f"{done} frames" if total is None else f"{done}/{total} frames"
        self._bar.update(
            self._task,
            completed=progress.videos_done if total is None else done,
            total=progress.videos if total is None else total,
            videos=f"{progress.videos_done}/{progress.videos} videos",
            frames=frames,
        )
