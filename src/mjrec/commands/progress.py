# SPDX-License-Identifier: Apache-2.0
"""Progress of a recording: a bar on a terminal, a line an episode elsewhere."""

from __future__ import annotations

from types import TracebackType

import rich.console
import rich.progress

from ..sessions import SessionEpisode


class EpisodeProgress:
    """Shows how far a recording is.

    Args:
        console: where to. On a terminal it is a bar that counts steps too; elsewhere
            (a CI log, a file) one plain line for each episode.
        title: what is recorded.
        episodes: how many episodes there will be.
    """

    def __init__(
        self, console: rich.console.Console, *, title: str, episodes: int
    ) -> None:
        self._console = console
        self._episodes = episodes
        self._done = 0
        self._steps = 0
        self._bar = rich.progress.Progress(
            rich.progress.TextColumn("{task.description}"),
            rich.progress.BarColumn(bar_width=20),
            rich.progress.TextColumn("{task.completed}/{task.total} episodes"),
            rich.progress.TextColumn("{task.fields[steps]} steps"),
            rich.progress.TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task(title, total=episodes, steps=0)

    def __enter__(self) -> EpisodeProgress:
        self._bar.start()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def step(self) -> None:
        """Count a step."""
        self._steps += 1
        # The bar is drawn ten times a second, whatever the number of updates; the
        # update itself costs more than a step of a small environment.
        if self._steps % 16 == 0:
            self._bar.update(self._task, steps=self._steps)

    def episode(self, episode: SessionEpisode) -> None:
        """Count an episode."""
        self._done += 1
        self._bar.update(self._task, completed=self._done, steps=self._steps)
        if not self._console.is_terminal:
            self._console.print(
                f"episode {episode.episode_id} ({self._done}/{self._episodes}): "
                f"{episode.length} steps, return {episode.reward:.6g}",
                highlight=False,
                soft_wrap=True,
            )
