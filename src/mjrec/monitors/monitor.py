# SPDX-License-Identifier: Apache-2.0
"""`mjrec.Monitor`, which creates the right kind of monitor for an environment."""

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
def Monitor(  # noqa: N802  named like gym's class
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
    """Record an environment to a monitor directory.

    Use the monitor instead of `env`, and close it, preferably with `with`::

        with mjrec.Monitor(env, "recordings/run1") as env:
            observation, info = env.reset(seed=0)

    If the state of a MuJoCo environment determines its frames, `step` only saves the
    state, and worker processes render frames that are byte-identical to those of
    `env.render()`. Any recorded episode can be rerendered (`mjrec.render`). Other
    environments are rendered during `step`, with their own `render()`.

    Args:
        env: a Gymnasium environment, a vector environment (see `VectorMonitor`), or a
            dm_env environment such as `dm_control.suite.load(...)`. Live recording
            needs `render_mode="rgb_array"` (or `"rgb_array_list"`, `"ansi"`); deferred
            rendering needs no `render_mode`, and no OpenGL in this process.
        directory: the monitor directory. It is created if needed.
        video_callable: a function that takes an episode number (from 0) and returns
            whether the episode gets a video. None means `capped_cubic_video_schedule`,
            False means no videos.
        force: delete the monitor files in the directory first. Overrides `resume`.
        resume: add to existing recordings. Killed monitors are recovered first, as by
            `mjrec.recover`. Episode numbers continue from the highest number of all
            closed or dead monitors (with `uid`, only of those with this `uid`).
            Monitors that use a directory simultaneously all need `resume`, and number
            their episodes independently. `"join"` does not read other monitors' files,
            so it is fast even among thousands of monitors: it recovers nothing, numbers
            episodes from 0, and does not check that the environments are the same.
        write_upon_reset: write the statistics and manifest at every reset, not only at
            the end. A line is always added to the journal when an episode ends.
        uid: an id to use in file names instead of the process id.
        mode: type of the episodes, "training" or "evaluation".
        fps: frame rate of the video files. None means real time, one frame per step.
        camera: a camera's name or number, or a `mujoco.MjvCamera`. None means the
            environment's own view. A list yields one video per camera:
            `....video000027.mp4` for the first, `....video000027.<camera>.mp4` for
            others. Live frames come from the environment's `render()`, so with
            `render="live"` a different camera or size is an error.
        width: width of the videos in pixels; if None, the environment's own.
        height: height of the videos in pixels; if None, the environment's own.
        max_fps: maximum frames per second of simulated time: steps 0, n, 2n ... and the
            last one are recorded. None means every step.
        quality: "full" (the model's own settings), or "draft" (several times faster,
            without multisampling and with small shadow maps). Deferred rendering only.
        render: "deferred" (save states now, render later), "live" (render in `step`),
            "off" (only statistics and trajectories), or None: deferred if the states
            are known to determine the frames, otherwise live. The log and the metadata
            state the mode and the reason.
        workers: number of processes that render deferred frames. None means one per
            usable CPU, shared by all monitors of a directory. 0 renders nothing now and
            leaves the videos pending for `mjrec render DIR`.
        trajectory_callable: a function that takes an episode number and returns whether
            the trajectory is kept. True keeps all. False keeps none, and a video's
            trajectory is removed once the video exists. None keeps those of evaluation
            episodes and episodes with a video.
        observations: also record observations in trajectories.
        allow_early_reset: allow resets during an episode. An interrupted episode is not
            included in the statistics, and its video is marked incomplete. None follows
            the framework: not allowed for Gymnasium, allowed for its vector
            environments and for dm_env.
        on_error: "raise" or "warn". With "warn", if something cannot be recorded (full
            disk, dead encoder, failed video), the simulation continues, the log has one
            warning, and `mjrec.faults` in the manifest lists what is missing. Errors in
            the environment, incorrect calls, and a `close()` that cannot write results
            always raise.
        strict: treat a blank video (black, one color, no movement) as an error:
            `BlankVideo` at the end of its episode or, for a deferred video,
            `RenderError` in `close`. In any case, the video is kept, its metadata has
            `suspect_black` or `suspect_constant`, and the log has a warning.
        keep: choose the videos after episodes have ended, instead of with
            `video_callable`: "best:3" or "worst:3" (by return), "failures" or
            "failures:20" (the first 20), "median", several of these separated by
            commas, or a function that takes the finished episodes
            (`mjrec.trackers.FinishedEpisode`) and returns the numbers of those to keep.
            An episode failed if `info["is_success"]` or `info["success"]` is false in
            its last step or, without either, if it terminated. Other episodes are
            deleted as soon as the rule allows; "median" and functions keep all states
            on disk until `close`. Incomplete episodes are never chosen. Trajectories
            kept for another reason remain, without their video. The manifest and
            metadata state the rule. After a kill, all candidates are pending. If the
            function fails or names unknown episodes, `close` reports it and keeps all.
        step_trigger: a function that is called before each step with the number of
            steps so far, and returns whether a clip starts. Replaces `video_callable`.
            A clip's first frame is the frame before the step.
        video_length: number of steps in a clip after its first frame, across resets.
            None means until the end of the episode.
        name_prefix: also link finished videos under Gymnasium's names:
            `<name_prefix>-episode-27.mp4` or `<name_prefix>-step-1000.mp4`.
        episode_info: add `info["episode"]` to the last step of an episode: return "r",
            length "l" and seconds "t", like Gymnasium's RecordEpisodeStatistics. An
            existing key is kept. Gymnasium environments only.
        annotate: write episode, step, simulated time and return on the frames, which
            then differ from those of `env.render()`.
        tiled: record one video with all cameras side by side, instead of one per
            camera. For a vector environment, also record a video of all
            sub-environments side by side.
        trackers: trackers to notify of finished episodes and videos; see
            `mjrec.trackers`.
        policy_file: the policy's file, such as a checkpoint. Its SHA-256 is stored in
            the manifest, as evidence.
        env_id: the environment's name in the recordings. None means the name in its
            spec. dm_env environments have no spec, so pass a name:
            `dm_control/<domain>-<task>`.

    Returns:
        A `GymnasiumMonitor`, a `VectorMonitor` or a `DmEnvMonitor`.

    Raises:
        InvalidArgument: `env` is not a supported environment, or an argument has an
            invalid value.
        NoPictures: videos were requested, but the environment provides no frames.
        MissingDependency: `annotate` was given, but Pillow is not installed.
        PicturesDiffer: `render="deferred"` was given, but the state does not determine
            the frames; the message gives the reason.
        ExistingRecordings: the directory contains recordings, and neither `force` nor
            `resume` was given.
        DirectoryInUse: `force` was given, but another monitor is recording there.
        DifferentEnvironment: `resume` was given, but the recordings are from a
            different environment.
        DirectoryNotWritable: the directory cannot be created or written to.

    If an error is raised, `env` is unchanged and no files are left.
    """
    # This must come first: `locals()` must contain only the arguments.
    options = dict(locals())
    del options["env"], options["directory"]
    view = {name: options.pop(name) for name in ("camera", "height", "width", "env_id")}
    if allow_early_reset is None:
        options["allow_early_reset"] = _monitor_class(env).allows_early_reset
    return monitored(env, directory, RecorderOptions(**options), **view)


def monitored(
    env: Any, directory: str | os.PathLike[str], options: RecorderOptions, **view: Any
) -> GymnasiumMonitor | VectorMonitor | DmEnvMonitor:
    """Create a monitor like `Monitor`, but from an options object.

    Args:
        env: see `Monitor`.
        directory: see `Monitor`.
        options: the other options of `Monitor`.
        **view: `camera`, `height`, `width` and `env_id`.
    """
    monitor = _monitor_class(env)
    if options.resume is True and not options.force and Path(directory).is_dir():
        # Recover the files of killed monitors first.
        recovery = recover(directory)
        if recovery.failures:
            logger.warning("%s", recovery)
        elif recovery:
            logger.info("%s", recovery)
    return monitor(env, directory, options, **view)


def _monitor_class(
    env: Any,
) -> type[GymnasiumMonitor] | type[VectorMonitor] | type[DmEnvMonitor]:
    # Instances of a framework's classes exist only if the framework is imported.
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
        "Monitor records a Gymnasium environment (gymnasium.Env), a vector environment "
        "(gymnasium.vector.VectorEnv) or a dm_env environment (dm_env.Environment), "
        f"got {type(env).__module__}.{type(env).__qualname__}."
    )
