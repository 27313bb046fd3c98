# SPDX-License-Identifier: Apache-2.0
"""A video that is counted in steps, written down as states and rendered later.

It may go on across resets, and a log is of one episode: so there is a log for each
part of it that is of one episode. `clip` in the facts of a part says

- `first_step`: how many steps the monitor had recorded when the video began;
- `part`: its number, from 0;
- `steps_before`: of the running episode, before the part begins;
- `reward_before`: their rewards;
- `reset_time`: the simulated time of that episode's reset, where it is to be written on
  the pictures.

The last part ends as an episode's trajectory does, with `complete`; those before say
`continues`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import FileNotWritten, PicturesDiffer
from ..formats.monitor_directory import Infix, clip_part_name
from ..formats.span_writer import SpanLogs
from .trajectory_recorder import Pace, TrajectoryRecorder

if TYPE_CHECKING:
    from ..simulation.capture import Capture, EpisodeStart

logger = logging.getLogger(__name__)


@dataclass
class ClipLogs:
    """What all deferred clips of a run have in common.

    Attributes:
        logs: of the monitor.
        infix: the monitor's.
        states: of the simulation; nobody else's, who would miss what the other has
            noticed of the model.
        pace: how simulated time becomes frames. Which of the frames are wanted is
            chosen when they are drawn, as they are counted over all parts.
        facts: returns what is known of the running episode, for the header of a part
            that begins now, given what `states` has said.
        before: returns what was before it in that episode, for `clip` in the header.
        tolerates: tells whether to go on after an error.
        on_end: called with each clip that is over and has left something.
    """

    logs: SpanLogs
    infix: Infix
    states: Capture
    pace: Pace
    facts: Callable[[EpisodeStart], Mapping[str, Any]]
    before: Callable[[], Mapping[str, Any]]
    tolerates: Callable[[Exception], bool]
    on_end: Callable[[DeferredClip], object]


class DeferredClip:
    """Writes down one such video; a `Clip`.

    Args:
        logs: what it has in common with the others.
        start: what `logs.states.begin_episode` has just returned.
        first_step: how many steps were recorded so far.
        episode_id: of the running episode.
        video: where the video will be.
        facts: what else each part says.

    Attributes:
        episode_id: as given.
        first_step: as given.
        video: as given.
        first_part: what its first part is called.
    """

    def __init__(
        self,
        logs: ClipLogs,
        start: EpisodeStart,
        *,
        first_step: int,
        episode_id: int,
        video: Path,
        facts: Mapping[str, Any],
    ) -> None:
        self.episode_id = self._last_episode_id = episode_id
        self.first_step = first_step
        self.video = video
        self._logs = logs
        self.first_part = logs.logs.directory / self._name(0)
        self._start = start
        self._facts = facts
        self._part: TrajectoryRecorder | None = None
        self._parts = 0
        self._is_over = False

    def begin(self) -> None:
        """Take down the picture of this moment."""
        self._part = self._new_part(self._start)
        self._parts = 1

    def reset(self, episode_id: int) -> None:
        """Take down the picture of an episode that has just begun."""
        self._last_episode_id = episode_id
        part = self._part
        if part is None or part.is_stopped:
            return
        try:
            start = self._logs.states.begin_episode()
            if start.refusal is not None:
                raise PicturesDiffer(start.refusal)
            coming = self._new_part(start)
            part.note(continues=True, end_time=time.time())
            part.end({})
        except (PicturesDiffer, FileNotWritten) as error:
            self._stop(part, error)
        else:
            self._part = coming
            self._parts += 1

    def step(
        self, reward: float, *, terminated: bool, truncated: bool, is_there: bool
    ) -> None:
        """Take down the picture of a step."""
        part = self._part
        if part is None or part.is_stopped:
            return
        try:
            if not is_there:
                part.note(final_frame="missing")
            # What was done is of no use to a picture.
            part.before_step(None)
            part.step(reward, terminated, truncated, None, False, is_there)
        except (PicturesDiffer, FileNotWritten) as error:
            self._stop(part, error)

    def end(self, facts: Mapping[str, Any]) -> None:
        """Write what is known of the end. Where it was interrupted, call it again."""
        part = self._part
        if part is None or self._is_over:
            return
        try:
            # Not by `end`, which may have been told already that the video goes on.
            part.note(
                **facts, last_episode_id=self._last_episode_id, end_time=time.time()
            )
            part.end({})
        except FileNotWritten as error:
            # What is there is as much of a video as of a process that was killed.
            part.abandon()
            self._list(part)
            if not self._logs.tolerates(error):
                raise
        else:
            self._list(part)

    def _new_part(self, start: EpisodeStart) -> TrajectoryRecorder:
        """Return what writes the part that begins now. Its log comes later."""
        logs, number = self._logs, self._parts
        return TrajectoryRecorder(
            logs.logs,
            self._name(number),
            facts={
                **logs.facts(start),
                **self._facts,
                "clip": {
                    "first_step": self.first_step,
                    "part": number,
                    **logs.before(),
                },
            },
            states=logs.states,
            start=start,
            pace=replace(logs.pace, max_fps=None),
        )

    def _stop(
        self, part: TrajectoryRecorder, error: PicturesDiffer | FileNotWritten
    ) -> None:
        """Take down nothing more of the video, after an error."""
        part.stop(str(error))
        if isinstance(error, FileNotWritten):
            if not self._logs.tolerates(error):
                raise error
            return
        logger.warning("The video %s ends early: %s", self.video.name, error)

    def _list(self, part: TrajectoryRecorder) -> None:
        self._is_over = True
        # Where the disk was too full for a single row there is nothing to promise.
        if self._parts > 1 or part.is_there:
            self._logs.on_end(self)

    def _name(self, number: int) -> str:
        return clip_part_name(self._logs.infix, self.first_step, number)
