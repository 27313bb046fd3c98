# SPDX-License-Identifier: Apache-2.0
"""`mjrec.Monitor`: the monitor that fits an environment."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InvalidArgument
from ..recorder.options import RecorderOptions
from ..recorder.tracking import FinishedEpisode, Tracker
from ..rendering.recovery import recover

if TYPE_CHECKING:
    from .dm_env_monitor import DmEnvMonitor
    from .gymnasium_monitor import GymnasiumMonitor
    from .vector_monitor import VectorMonitor

logger = logging.getLogger(__name__)


# The positional arguments are gym's, in gym's order.
def Monitor(  # noqa: N802  named as the class that it was in gym
    env: Any,
    directory: str | os.PathLike[str],
    video_callable: Callable[[int], Any] | bool | None = None,
    force: bool = False,
    resume: bool | str = False,
    write_upon_reset: bool = False,
    uid: str | None = None,
    mode: str | None = None,
    *,
    fps: float | Fraction | None = None,
    camera: Any = None,
    width: int | None = None,
    height: int | None = None,
    max_fps: float | Fraction | None = None,
    quality: str = "full",
    render: str | None = None,
    workers: int | None = None,
    trajectory_callable: Callable[[int], Any] | bool | None = None,
    observations: bool = False,
    allow_early_reset: bool | None = None,
    on_error: str = "raise",
    strict: bool = False,
    keep: str | Callable[[Sequence[FinishedEpisode]], Iterable[int]] | None = None,
    step_trigger: Callable[[int], Any] | None = None,
    video_length: int | None = None,
    name_prefix: str | None = None,
    episode_info: bool = False,
    annotate: bool = False,
    tiled: bool = False,
    trackers: Tracker | Sequence[Tracker] = (),
    policy_file: str | os.PathLike[str] | None = None,
    env_id: str | None = None,
) -> GymnasiumMonitor | VectorMonitor | DmEnvMonitor:
    """Record an environment into a monitor directory.

    Use the monitor instead of `env`, and close it, best with `with`::

        with mjrec.Monitor(env, "recordings/run1") as env:
            observation, info = env.reset(seed=0)

    If the frames of a MuJoCo environment follow from its state, `step` only saves the
    state, and worker processes draw the frames: byte for byte those of `env.render()`
    at that moment. Any recorded episode can be rendered again (`mjrec.render`). Other
    environments are drawn in `step`, through their own `render()`.

    Args:
        env: a Gymnasium environment, a vector environment (see `VectorMonitor`), or a
            dm_env environment such as `dm_control.suite.load(...)`. Live recording
            needs `render_mode="rgb_array"` (or `"rgb_array_list"`, `"ansi"`); deferred
            rendering needs no `render_mode`, and no OpenGL in this process.
        directory: the monitor directory. It is created if needed.
        video_callable: maps an episode number, from 0, to whether it gets a video. None
            is `capped_cubic_video_schedule`, False is no videos.
        force: delete the monitor files in the directory first. Overrides `resume`.
        resume: add to existing recordings. Recovers killed monitors first, as
            `mjrec.recover` does. Episode numbers continue from the highest number of
            closed or dead monitors (with `uid`: of this `uid`). Monitors that share a
            directory at the same time all need it, and number independently. `"join"`
            reads no other monitor's files, so it is as fast among thousands: it
            recovers nothing, numbers from 0, and does not check that environments are
            the same.
        write_upon_reset: write statistics and manifest at every reset, not only at the
            end. The journal always gets a line when an episode ends.
        uid: used in file names instead of the process id.
        mode: "training" or "evaluation", the type of the episodes.
        fps: frame rate of the video files. None is real time: one frame per step.
        camera: a camera's name or number, or an `mujoco.MjvCamera`. None is what the
            environment shows. A list makes a video per camera: `....video000027.mp4`
            for the first, `....video000027.<camera>.mp4` for the others. Live frames
            come from the environment's `render()`, so with `render="live"` another
            camera or size is an error.
        width: of the videos, in pixels. None is the environment's own.
        height: likewise.
        max_fps: most frames per second of simulated time: steps 0, n, 2n ... and the
            last. None is every step.
        quality: "full", the model's own settings; or "draft", several times faster,
            without multisampling and with small shadow maps. Deferred rendering only.
        render: "deferred" (states now, frames later), "live" (frames in `step`), "off"
            (statistics and trajectories only), or None: deferred if the frames are
            known to follow from the states, else live. Log and metadata say which, and
            why.
        workers: processes that draw deferred frames. None is one per usable CPU, shared
            by all monitors of a directory. 0 draws nothing now and leaves the videos
            pending: `mjrec render DIR` draws them.
        trajectory_callable: maps an episode number to whether its trajectory is kept.
            True is all; False is none, and a video's trajectory is removed once the
            video exists. None is all evaluation episodes and those with a video.
        observations: record observations in trajectories too.
        allow_early_reset: allow resets in the middle of an episode. A cut episode is
            not in the statistics, and its video is marked incomplete. None is the
            framework's rule: no for Gymnasium, yes for its vector environments and for
            dm_env.
        on_error: "raise"; or "warn": if something cannot be recorded (full disk, dead
            encoder, failed video), the simulation continues, the log says so once, and
            `mjrec.faults` in the manifest lists what is missing. Errors of the
            environment, wrong use, and a `close()` that cannot write results always
            raise.
        strict: a video that shows nothing (black, one colour, no movement) is an error:
            `BlankVideo` at the end of its episode, or for a deferred one `RenderError`
            in `close`. The video is always kept; its metadata has `suspect_black` or
            `suspect_constant`, and the log a warning.
        keep: choose the videos after episodes have ended, instead of `video_callable`:
            "best:3" or "worst:3" (by return), "failures" or "failures:20" (the first
            20), "median", several of these joined by commas, or a function from the
            finished episodes (`mjrec.trackers.FinishedEpisode`) to the numbers to
            keep. A failure has `info["is_success"]` or `info["success"]` false in its
            last step; without either, it terminated. Other episodes are deleted as soon
            as the rule allows; "median" and functions keep all states on disk until
            `close`. Incomplete episodes are never chosen. Trajectories kept for another
            reason stay, without their video. Manifest and metadata name the rule. After
            a kill, all candidates are pending. If the function raises or names unknown
            episodes, `close` says so and keeps all.
        step_trigger: maps the number of steps so far to whether a clip starts, before
            each step; instead of `video_callable`. Its first frame is the one before
            the step.
        video_length: steps of a clip after its first frame, across resets. None is
            until the end of the episode.
        name_prefix: also link finished videos under Gymnasium's names:
            `<name_prefix>-episode-27.mp4` or `<name_prefix>-step-1000.mp4`.
        episode_info: add `info["episode"]` to the last step of an episode: return "r",
            length "l" and seconds "t", as Gymnasium's RecordEpisodeStatistics does. An
            existing key stays. Gymnasium environments only.
        annotate: write episode, step, simulated time and return on the frames. They
            then differ from those of `env.render()`.
        tiled: one video with all cameras side by side, instead of one per camera. For a
            vector environment: also a video of all sub-environments side by side.
        trackers: are notified of finished episodes and videos, see `mjrec.trackers`.
        policy_file: the policy's file, such as a checkpoint. Its sha256 goes into the
            manifest, as evidence.
        env_id: the environment's name in the recordings. None is the name in its spec.
            dm_env environments have none, so give theirs: `dm_control/<domain>-<task>`.

    Returns:
        A `GymnasiumMonitor`, a `VectorMonitor` or a `DmEnvMonitor`.

    Raises:
        InvalidArgument: `env` is none of these, or an argument has a wrong value.
        NoPictures: videos are wanted, but the environment gives no frames.
        MissingDependency: `annotate` without Pillow.
        PicturesDiffer: `render="deferred"`, but the frames do not follow from the
            state; the message names the reason.
        ExistingRecordings: the directory holds recordings, and neither `force` nor
            `resume` was given.
        DirectoryInUse: `force`, but another monitor is recording there.
        DifferentEnvironment: `resume` over recordings of another environment.
        DirectoryNotWritable: the directory cannot be created or written to.

    If it raises, `env` is unchanged and no file is left.
    """
    # First of all: the arguments by their names, before there are others.
    options = dict(locals())
    for name in ("env", "directory", "camera", "height", "width", "env_id"):
        del options[name]
    if allow_early_reset is None:
        options["allow_early_reset"] = _monitor_class(env).allows_early_reset
    return monitored(
        env,
        directory,
        RecorderOptions(**options),
        camera=camera,
        height=height,
        width=width,
        env_id=env_id,
    )


def monitored(
    env: Any,
    directory: str | os.PathLike[str],
    options: RecorderOptions,
    **view: Any,
) -> GymnasiumMonitor | VectorMonitor | DmEnvMonitor:
    """Do what `Monitor` does.

    Args:
        env: likewise.
        directory: likewise.
        options: likewise, in one.
        **view: `camera`, `height`, `width` and `env_id`.
    """
    monitor = _monitor_class(env)
    if options.resume is True and not options.force and Path(directory).is_dir():
        # What killed monitors have left is put in order first.
        recovery = recover(directory)
        if recovery.failures:
            logger.warning("%s", recovery)
        elif recovery:
            logger.info("%s", recovery)
    return monitor(env, directory, options, **view)


def _monitor_class(
    env: Any,
) -> type[GymnasiumMonitor] | type[VectorMonitor] | type[DmEnvMonitor]:
    # An instance of a framework's class exists only where the framework is loaded.
    gymnasium = sys.modules.get("gymnasium")
    if gymnasium is not None and isinstance(env, gymnasium.vector.VectorEnv):
        from .vector_monitor import VectorMonitor

        return VectorMonitor
    if gymnasium is not None and isinstance(env, gymnasium.Env):
        from .gymnasium_monitor import GymnasiumMonitor

        return GymnasiumMonitor
    dm_env = sys.modules.get("dm_env")
    if dm_env is not None and isinstance(env, dm_env.Environment):
        from .dm_env_monitor import DmEnvMonitor

        return DmEnvMonitor
    raise InvalidArgument(
        "Monitor goes around a Gymnasium environment (gymnasium.Env), a vector "
        "environment (gymnasium.vector.VectorEnv) or a dm_env one "
        f"(dm_env.Environment), got {type(env).__module__}.{type(env).__qualname__}."
    )
