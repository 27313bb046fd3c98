# SPDX-License-Identifier: Apache-2.0
"""A clip, a video that is counted in steps, written down as states.

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
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import FileNotWritten, PicturesDiffer
from ..formats.monitor_directory import clip_part_name
from .monitored_run import MonitoredRun
from .options import DEFERRED
from .trajectory_recorder import TrajectoryRecorder

if TYPE_CHECKING:
    from ..simulation.capture import Capture, EpisodeStart

logger = logging.getLogger(__name__)


class DeferredClip:
    """Writes down the states of one clip; a `Clip`.

    Args:
        run: of which it is.
        states: of the simulation; of no other reader, who would miss what this one has
            noticed of the model.
        start: what `states.begin_episode` has just returned.
        path: where the video will be, without the ending.
        second_name: what it is called besides.
    """

    def __init__(
        self,
        run: MonitoredRun,
        states: Capture,
        start: EpisodeStart,
        path: Path,
        *,
        second_name: Mapping[str, str],
    ) -> None:
        self._run = run
        self._states = states
        self._start = start
        self._first_step = run.stats.total_steps
        self._episode_id = self._last_episode_id = run.episode.episode_id
        self._video = path.with_name(f"{path.name}.mp4")
        promise = run.promise(path, DEFERRED, second_name=second_name)
        self._facts = {"kept": False, "video": promise}
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
            start = self._states.begin_episode()
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
            if not self._run.tolerates("video", error):
                raise
        else:
            self._list(part)

    def _new_part(self, start: EpisodeStart) -> TrajectoryRecorder:
        """Return what writes the part that begins now. Its rows come later."""
        run = self._run
        clip = {
            "first_step": self._first_step,
            "part": self._parts,
            "steps_before": run.stats.steps or 0,
            "reward_before": run.stats.rewards or 0.0,
            "reset_time": run.episode.reset_clock,
        }
        return TrajectoryRecorder(
            run.clip_logs,
            self._name(self._parts),
            facts={**run.recording_facts(start), **self._facts, "clip": clip},
            states=self._states,
            start=start,
            # Which of the frames are wanted is chosen when they are drawn: they are
            # counted over all parts.
            pace=replace(run.pace, max_fps=None),
        )

    def _stop(
        self, part: TrajectoryRecorder, error: PicturesDiffer | FileNotWritten
    ) -> None:
        """Take down nothing more of the clip, after an error."""
        part.stop(str(error))
        if isinstance(error, FileNotWritten):
            if not self._run.tolerates("video", error):
                raise error
            return
        logger.warning("The video %s ends early: %s", self._video.name, error)

    def _list(self, part: TrajectoryRecorder) -> None:
        self._is_over = True
        if self._parts == 1 and not part.is_there:
            # The disk was too full for a single row: there is nothing to promise.
            return
        run, first_part = self._run, self._name(0)
        run.journal.note(
            "clip",
            {
                "episode_id": self._episode_id,
                "clip": first_part,
                "video": self._video.name,
            },
        )
        run.videos.expect(self._video)
        run.finisher.submit(run.directory / first_part)

    def _name(self, number: int) -> str:
        return clip_part_name(self._run.infix, self._first_step, number)
