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
    """Record what happens to an environment into a monitor directory.

    Use what this returns instead of `env`, and close it, best with `with`::

        with mjrec.Monitor(env, "recordings/run1") as env:
            observation, info = env.reset(seed=0)

    Where the pictures of a MuJoCo environment follow from its state, the state is
    recorded, and processes of their own draw the pictures beside the simulation:
    stepping is hardly slowed down, and any recorded episode can be rendered again
    (`mjrec.render`). They are byte for byte those of `env.render()` at that moment.
    Other environments are drawn while they step, through their own `render()`.

    Args:
        env: a Gymnasium environment, a vector environment, whose sub-environments are
            each recorded (`VectorMonitor` says how), or a dm_env
            environment such as `dm_control.suite.load(...)`. Where pictures are drawn
            live it must be made with `render_mode="rgb_array"` (or `"rgb_array_list"`,
            `"ansi"`); deferred rendering needs no `render_mode`, and no OpenGL in this
            process.
        directory: where the recordings go. It is made where it is missing.
        video_callable: which episodes get a video: a function from the episode's
            number, from 0, to a bool; None for `capped_cubic_video_schedule`; False
            for none.
        force: delete the monitor files that are in the directory. It wins over
            `resume`.
        resume: add to the recordings that are there. What killed monitors have left
            is put in order first, as `mjrec.recover` does. Episodes are numbered on
            from the highest number of the monitors that closed or died (with `uid`:
            of those with this `uid`). Monitors that share a directory at the same
            time each need it; they number independently. `"join"` looks at no other
            monitor's files, so that it takes as long among thousands as among none:
            nothing is put in order, episodes are numbered from 0, and that the others
            are of the same environment is for the caller to know.
        write_upon_reset: write statistics and manifest at every reset, not only at
            the end. The journal, with a line for each completed episode, is written
            as the episodes end in any case.
        uid: stands in the file names instead of the process id.
        mode: "training" or "evaluation": the type of the episodes.
        fps: the rate written into the videos. None is real time: one frame for each
            step, as long as the simulated time of the step.
        camera: a name or number, or an `mujoco.MjvCamera`, of a MuJoCo environment;
            None is what the environment itself shows. A list of them gives a video
            each: `....video000027.mp4` of the first, `....video000027.<camera>.mp4`
            of the others. What is drawn live comes from the environment's own
            `render()`: with `render="live"`, another camera or size than that gives is
            an error.
        width: of the videos, in pixels; None is the environment's own.
        height: likewise.
        max_fps: the most frames per second of simulated time: steps 0, n, 2n ... with
            the smallest whole n that fits, and the last. None is every step.
        quality: "full", the model's own settings, or "draft", without multisampling
            and with a small shadow map: several times faster, for a quick look.
            Deferred rendering only; what is drawn live is as the environment draws it.
        render: "deferred" (states now, pictures later), "live" (pictures in `step`),
            "off" (statistics and trajectories only), or None: deferred where the
            pictures are known to follow from the states, else live. The log and the
            metadata say which, and why.
        workers: how many processes draw deferred pictures; None is one for each CPU
            that may be used, shared by all monitors of a directory; 0 draws nothing
            now and leaves the videos pending: `mjrec render DIR` makes them.
        trajectory_callable: which episodes keep their trajectory: a function from the
            episode's number to a bool, True for all, False for none (that of a video
            is then removed once the video is there). None is all episodes of type
            evaluation, and of the others those with a video.
        observations: whether trajectories hold observations too.
        allow_early_reset: whether a reset in mid-episode is allowed; the episode is
            then no part of the statistics, and its video is marked incomplete. None
            is what the framework has: no for Gymnasium, yes for its vector environments
            and for dm_env.
        on_error: "raise", or "warn": where something cannot be recorded (a full disk,
            a dead encoder, a video that cannot be rendered) the simulation goes on,
            the log says so once, and the manifest lists under `mjrec.faults` which
            episodes lack what. What the environment itself raises is raised in any
            case, and so is wrong use, a step before the first reset for instance, and
            a `close()` that can write no results.
        strict: whether a video that shows nothing (all frames black, of one colour
            each, or all the same) is an error, `BlankVideo` as its episode ends or, of
            a deferred one, `RenderError` in `close`. The video is kept in any case, its
            metadata has `suspect_black` or `suspect_constant`, and the log a warning.
        keep: which episodes get a video, decided when they have ended, instead of
            `video_callable`: "best:3" or "worst:3" (by return), "failures" or
            "failures:20" (the first 20), "median", or a function from the finished
            episodes (`mjrec.trackers.FinishedEpisode`) to the numbers of those to
            keep. A failure is what `info["is_success"]` or `info["success"]` of the
            last step denies; where there is neither, what was terminated. Every
            episode is recorded, and what is not chosen is deleted, at once where the
            rule allows; with "median" and a function all states stay on disk until
            `close`. Episodes that are not completed are never chosen. Trajectories
            that are kept in any case (type evaluation, `trajectory_callable`) stay
            without their video. Manifest and metadata name the rule, and whether it
            was applied: of a killed run the candidates are pending. Where the function
            raises, or names no finished episodes, `close` says so and keeps all.
        step_trigger: which steps begin a video, instead of `video_callable`: a
            function from the number of steps taken so far to a bool, asked before
            each step. The first picture is that before the step.
        video_length: steps of a video after its first picture; it goes on across
            resets. None is until the end of the episode. Where pictures are deferred,
            so are these; the states that they are drawn from are then removed.
        name_prefix: finished videos have Gymnasium's names besides,
            `<name_prefix>-episode-27.mp4` or `<name_prefix>-step-1000.mp4`: links to
            the same files.
        episode_info: whether the last step of an episode has `info["episode"]`, a
            dictionary of return "r", length "l" and seconds "t", as Gymnasium's
            RecordEpisodeStatistics gives it. A key that is there stays as it is.
            Gymnasium environments only.
        annotate: whether episode, step, simulated time and return are written on the
            pictures. They are then not those of `env.render()` any more.
        tiled: one video of all `camera`s side by side, instead of one for each. Of a
            vector environment: also a video of all sub-environments side by side.
        trackers: are notified of finished episodes and videos, see `mjrec.trackers`.
        policy_file: the file in which the policy is, such as a checkpoint. Its sha256
            goes into the manifest, for packing the recording as evidence.
        env_id: the environment's name in the recordings. None is the name in its
            spec; dm_env environments have none, so theirs is worth giving, as
            `dm_control/<domain>-<task>`.

    Returns:
        A `GymnasiumMonitor`, a `VectorMonitor` or a `DmEnvMonitor`.

    Raises:
        InvalidArgument: `env` is none of these, or an argument cannot be.
        NoPictures: videos were asked for of an environment that gives no pictures.
        MissingDependency: `annotate`, and there is no Pillow.
        PicturesDiffer: `render="deferred"`, and what the environment shows cannot be
            made from its state; the message names what stands in the way.
        ExistingRecordings: the directory holds recordings, and neither `force` nor
            `resume` was given.
        DirectoryInUse: `force`, and another monitor is recording there.
        DifferentEnvironment: `resume` over recordings of another environment.
        DirectoryNotWritable: the directory cannot be made or written to.

    When it raises, `env` is as it was, and no file is left.
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
