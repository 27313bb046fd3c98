# SPDX-License-Identifier: Apache-2.0
"""Weights & Biases tracker: curves of episode results, and the videos themselves."""

from __future__ import annotations

import os
from typing import Any

from ..errors import InvalidArgument, optional_module
from ..recorder.tracking import FinishedEpisode, FinishedVideo, Run, Tracker
from .services import group_of, name_of, scalars_of

_STEPS = "total_steps"
_VIDEO_STEPS = "video_total_steps"


class WandbTracker(Tracker):
    """A tracker that logs to a Weights & Biases run.

    `training/return`, `training/length` and, if the environment reports it,
    `training/success` are logged against the run's steps (`training/total_steps`).
    Evaluation episodes use `evaluation/`, and sub-environments use `training/env<i>/`.
    Each mp4 is uploaded as `training/video`. Its number of steps is logged separately,
    as `training/video_total_steps`, because a deferred video is finished after later
    episodes.

    Each call uses W&B's next step. W&B drops data with a lower step, so code that logs
    to the same run with `step=` should use `run.define_metric` instead.

    Args:
        run: a run from `wandb.init`, which stays open. If None and no other arguments
            are given, the tracker uses the run that is active when the first monitor
            starts, if there is one. Otherwise it creates a new run, and finishes it
            when the last monitor ends.
        project: the new run's project, as in `wandb.init`.
        mode: the new run's mode, as in `wandb.init`, such as `"offline"`.
        **init: other arguments of `wandb.init`.

    Raises:
        MissingDependency: wandb is not installed.
        InvalidArgument: `run` is not a W&B run, or is given together with arguments for
            a new one.
    """

    def __init__(
        self,
        run: Any = None,
        *,
        project: str | None = None,
        mode: str | None = None,
        **init: Any,
    ) -> None:
        optional_module("wandb", purpose="WandbTracker", install="mjrec[wandb]")
        named = {"project": project, "mode": mode}
        self._init = {k: v for k, v in named.items() if v is not None} | init
        if run is not None and self._init:
            raise InvalidArgument(
                "WandbTracker takes either a run or the arguments for a new one, not a "
                f"run and {', '.join(self._init)}."
            )
        if run is not None and not callable(getattr(run, "define_metric", None)):
            raise InvalidArgument(
                "WandbTracker takes a run from wandb.init, or project= and other "
                f"arguments for a new one, not {run!r}."
            )
        self._given = run
        # W&B's run while monitors are open, and the process that has to finish it.
        self._service: Any = None
        self._owner: int | None = None
        self._axes: set[str] = set()
        self._last_episodes: dict[Run, FinishedEpisode | None] = {}

    def begin(self, run: Run) -> None:
        """Start W&B's run if necessary."""
        if self._service is None:
            self._open()
        self._last_episodes[run] = None

    def episode(self, run: Run, episode: FinishedEpisode) -> None:
        """Log the episode's scalars."""
        self._last_episodes[run] = episode
        group = self._group(run, episode)
        self._define(f"{group}/*", over=f"{group}/{_STEPS}")
        self._log(group, {_STEPS: episode.total_steps, **scalars_of(episode)})

    def video(self, run: Run, video: FinishedVideo) -> None:
        """Log the video's file, which W&B copies."""
        # Imported late, so that importing this module does not import wandb.
        import wandb

        episode = video.episode or self._last_episodes[run]
        group, name = self._group(run, episode), name_of(video)
        frame = wandb.Video(
            str(video.path), caption=f"episode {video.episode_id}", format="mp4"
        )
        self._define(f"{group}/{name}", over=f"{group}/{_VIDEO_STEPS}")
        steps = episode.total_steps if episode else 0
        self._log(group, {_VIDEO_STEPS: steps, name: frame})

    def end(self, run: Run) -> None:
        """Finish W&B's run if the tracker started it and this was its last monitor."""
        del self._last_episodes[run]
        if self._last_episodes:
            return
        service, self._service = self._service, None
        # A forked child must not finish its parent's run.
        if service is not None and self._owner == os.getpid():
            service.finish()

    def _open(self) -> None:
        import wandb

        self._axes.clear()
        self._owner = None
        self._service = self._given
        if self._service is None and not self._init:
            self._service = wandb.run
        if self._service is None:
            # Without `reinit`, `init` may return the active run, which `end` would
            # then finish.
            self._service = wandb.init(**{"reinit": "create_new", **self._init})
            self._owner = os.getpid()

    def _group(self, run: Run, episode: FinishedEpisode | None) -> str:
        group = group_of(episode)
        return group if run.env_index is None else f"{group}/env{run.env_index}"

    def _define(self, metric: str, *, over: str) -> None:
        if metric not in self._axes:
            self._axes.add(metric)
            self._service.define_metric(over)
            self._service.define_metric(metric, step_metric=over)

    def _log(self, group: str, values: dict[str, Any]) -> None:
        self._service.log({f"{group}/{name}": value for name, value in values.items()})
