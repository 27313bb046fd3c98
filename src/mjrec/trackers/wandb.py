# SPDX-License-Identifier: Apache-2.0
"""Weights & Biases: curves of the episodes, and the videos themselves."""

from __future__ import annotations

import os
from typing import Any

from ..errors import InvalidArgument
from ..recorder.tracking import FinishedEpisode, FinishedVideo, Run, Tracker
from .required_packages import require
from .scalars import group_of, name_of, scalars_of

_STEPS = "total_steps"
_VIDEO_STEPS = "video_total_steps"


class WandbTracker(Tracker):
    """Logs to a run of Weights & Biases.

    Over the steps of the run, `training/total_steps`: `training/return`,
    `training/length` and, where the environment says it, `training/success`; those of
    evaluation episodes begin with `evaluation/`, those of a sub-environment with
    `training/env<i>/`. A finished mp4 file is uploaded as it is, as `training/video`,
    over `training/video_total_steps`: a deferred video comes later than the episodes
    that follow its own.

    Nothing is logged at a step of W&B's own, which must never go back; each call takes
    the next one. Whoever logs to the same run with `step=` should say
    `run.define_metric` instead too: W&B drops what comes with a lower step.

    Args:
        run: what `wandb.init` returned; it stays open. None is the one that is active
            when the first monitor begins, if no other argument is given either; and
            else a new one, which is finished when the last monitor has ended.
        project: of the new run, as `wandb.init`.
        mode: of the new run, as `wandb.init`: `"offline"`, for example.
        **init: the other arguments of `wandb.init`.

    Raises:
        MissingDependency: wandb is not installed.
        InvalidArgument: a run is given, and how to make one too.
    """

    def __init__(
        self,
        run: Any = None,
        *,
        project: str | None = None,
        mode: str | None = None,
        **init: Any,
    ) -> None:
        require("wandb", purpose="WandbTracker", extra="wandb")
        named = {"project": project, "mode": mode}
        self._init = {k: v for k, v in named.items() if v is not None} | init
        if run is not None and self._init:
            raise InvalidArgument(
                "WandbTracker takes a run, or how to make one, not both; got a run and "
                f"{', '.join(self._init)}."
            )
        if run is not None and not callable(getattr(run, "define_metric", None)):
            raise InvalidArgument(
                "WandbTracker takes a run as wandb.init returns it, or project= and "
                f"other arguments to make one, got {run!r}."
            )
        self._given = run
        self._service: _WandbRun | None = None
        self._last_episodes: dict[Run, FinishedEpisode | None] = {}

    def begin(self, run: Run) -> None:
        """Make the run of W&B, if need be."""
        if self._service is None:
            self._service = self._open()
        self._last_episodes[run] = None

    def episode(self, run: Run, episode: FinishedEpisode) -> None:
        """Log the episode's scalars."""
        self._last_episodes[run] = episode
        values = {_STEPS: episode.total_steps, **scalars_of(episode)}
        self._log(run, episode, values)

    def video(self, run: Run, video: FinishedVideo) -> None:
        """Log the file; W&B copies it."""
        # Not at the top: importing this module imports no service.
        import wandb

        episode = video.episode or self._last_episodes[run]
        picture = wandb.Video(
            str(video.path), caption=f"episode {video.episode_id}", format="mp4"
        )
        steps = episode.total_steps if episode else 0
        name = name_of(video)
        self._log(run, episode, {_VIDEO_STEPS: steps, name: picture}, video=name)

    def end(self, run: Run) -> None:
        """Finish the run of W&B, if it was made here and this was its last monitor."""
        del self._last_episodes[run]
        if not self._last_episodes and self._service is not None:
            service, self._service = self._service, None
            service.leave()

    def _open(self) -> _WandbRun:
        import wandb

        if self._given is not None:
            return _WandbRun(self._given, is_ours=False)
        if wandb.run is not None and not self._init:
            return _WandbRun(wandb.run, is_ours=False)
        # Without it, `init` returns the active run, and `leave` would finish that.
        made = wandb.init(**{"reinit": "create_new", **self._init})
        return _WandbRun(made, is_ours=True)

    def _log(
        self,
        run: Run,
        episode: FinishedEpisode | None,
        values: dict[str, Any],
        *,
        video: str | None = None,
    ) -> None:
        assert self._service is not None
        group = group_of(episode)
        if run.env_index is not None:
            group = f"{group}/env{run.env_index}"
        self._service.log(group, values, video=video)


class _WandbRun:
    """A run of W&B, and which axes it knows."""

    def __init__(self, run: Any, *, is_ours: bool) -> None:
        self._run = run
        self._is_ours = is_ours
        self._process_id = os.getpid()
        self._groups: set[str] = set()

    def log(
        self, group: str, values: dict[str, Any], *, video: str | None = None
    ) -> None:
        if group not in self._groups:
            self._groups.add(group)
            self._define(group)
        if video is not None and f"{group}/{video}" not in self._groups:
            self._groups.add(f"{group}/{video}")
            self._run.define_metric(
                f"{group}/{video}", step_metric=f"{group}/{_VIDEO_STEPS}"
            )
        self._run.log({f"{group}/{name}": value for name, value in values.items()})

    def leave(self) -> None:
        # A forked child would end its parent's.
        if self._is_ours and self._process_id == os.getpid():
            self._run.finish()

    def _define(self, group: str) -> None:
        for steps in (_STEPS, _VIDEO_STEPS):
            self._run.define_metric(f"{group}/{steps}")
        self._run.define_metric(f"{group}/*", step_metric=f"{group}/{_STEPS}")
