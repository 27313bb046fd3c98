# SPDX-License-Identifier: Apache-2.0
"""A recording session: N episodes of a named environment under a policy.

`mjrec record` runs a session. Episode i of a session with seed S starts from
`SeedSequence([S, i])` (see `environments.episode_seeds`), so any episode can be
rerecorded without the episodes before it.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from .environments.episode_seeds import episode_seeds, seed_global_generators
from .environments.from_name import environment_from_name
from .environments.named_environment import EnvironmentOptions, NamedEnvironment
from .environments.names import parse_environment_name, working_directory_importable
from .environments.policies import load_policy, policy_file
from .errors import GLError, InvalidArgument
from .formats.manifest import read_manifest
from .formats.monitor_directory import infix_of, manifest_name
from .gl.choice import use_gl
from .monitors.monitor import monitored
from .recorder.options import DEFERRED, LIVE, OFF, RecorderOptions
from .rendering.jobs import PlainCamera
from .schedules import disable_videos, schedule_from_text
from .simulation.find_simulation import simulation_in

if TYPE_CHECKING:
    from .monitors.dm_env_monitor import DmEnvMonitor
    from .monitors.gymnasium_monitor import GymnasiumMonitor

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Session:
    """The options of a recording session.

    Attributes:
        environment: a Gymnasium id, `dm_control/<domain>-<task>`, or the path of an
            MJCF file.
        directory: the monitor directory.
        seed: the session's seed, a whole number from 0 to 2**32 - 1.
        episodes: number of episodes.
        policy: the policy's name; see `environments.policies`.
        policy_kwargs: extra arguments for the policy.
        schedule: the episodes that get a video: `cubic`, `all`, `none`, `every:N` or
            `at:0,5,9`. None means `cubic`, unless `monitor` has a `keep`.
        placed_camera: fields of a `mujoco.MjvCamera`, keyed by name, used instead of
            `made.camera`. Only workers can render from it.
        further_cameras: cameras for additional videos of the same episodes.
        made: options for creating the environment; the session sets `frames` and
            `seed`.
        monitor: options for the monitor; the session sets the schedule and the policy
            file.
    """

    environment: str
    directory: Path
    seed: int
    episodes: int = 1
    policy: str = "random"
    policy_kwargs: Mapping[str, Any] = field(default_factory=dict)
    schedule: str | None = None
    placed_camera: Mapping[str, Any] | None = None
    further_cameras: tuple[PlainCamera | None, ...] = ()
    made: EnvironmentOptions = field(default_factory=EnvironmentOptions)
    monitor: RecorderOptions = field(default_factory=RecorderOptions)


@dataclass(frozen=True)
class SessionEpisode:
    """A recorded episode.

    Attributes:
        episode_id: the episode's number.
        length: number of steps.
        reward: sum of the rewards.
        video: path of the video, which may still have to be rendered; None if the
            schedule did not choose the episode. With `keep`, the choice may not be
            final: see `with_chosen_videos`.
    """

    episode_id: int
    length: int
    reward: float
    video: Path | None


def record_session(
    session: Session, *, on_step: Callable[[], None] = lambda: None
) -> Generator[SessionEpisode, None, None]:
    """Record a session, and yield each episode as it ends.

    If the environment cannot be rendered here, only statistics are recorded, and the
    log gives the reason. If `render` requests videos, an error is raised instead.

    The recordings are closed when the iterator ends, is closed, or raises. So make sure
    to close the iterator, preferably with `contextlib.closing`. The iterator waits
    for pending videos only if it is exhausted; otherwise they stay pending.

    Args:
        session: the session's options.
        on_step: called after every step.

    Raises:
        Error: the environment, policy, schedule, camera or directory is invalid. All of
            this is checked before anything is written.
    """
    options = session.monitor
    _check(session)
    schedule = None
    if options.keep is None:
        schedule = schedule_from_text(session.schedule or "cubic")
    with contextlib.ExitStack() as stack:
        drawn = schedule is not disable_videos and options.render != OFF
        named = _environment(session, frames=drawn)
        closing = stack.enter_context(contextlib.ExitStack())
        closing.callback(named.environment.close)
        if named.not_drawn is not None:
            if options.render in (LIVE, DEFERRED):
                raise named.not_drawn
            logger.warning("Recording only statistics, no videos. %s", named.not_drawn)
            schedule, options = disable_videos, replace(options, keep=None)
        policy = load_policy(session.policy, named.environment, session.policy_kwargs)
        view = dict(named.view)
        if session.placed_camera is not None:
            view["camera"] = session.placed_camera
        if session.further_cameras:
            # An environment that was created with a camera already uses it.
            view["camera"] = [view.get("camera"), *session.further_cameras]
        recorded = monitored(
            named.environment,
            session.directory,
            replace(
                options,
                seed=session.seed,
                video_callable=schedule,
                # Even without videos, the schedule chooses the trajectories to keep.
                trajectory_callable=schedule if options.render == OFF else None,
                policy_file=policy_file(session.policy),
            ),
            env_id=named.env_id,
            **view,
        )
        # A name never refers to a vector environment.
        monitor = cast("GymnasiumMonitor | DmEnvMonitor", recorded)
        # From here on the monitor closes the environment.
        closing.pop_all()
        stack.enter_context(monitor)
        for _ in range(session.episodes):
            seeds = episode_seeds(session.seed, monitor.episode_id)
            with working_directory_importable():
                seed_global_generators(seeds.policy)
                policy.reset(seeds)
                observation = named.begin_episode(monitor, seeds)
                done = False
                while not done:
                    observation, _, *ends = named.step(monitor, policy(observation))
                    done = any(ends)
                    on_step()
            stats, video = monitor.stats_recorder, monitor.video_recorder
            has_video = video is not None and video.functional and not video.empty
            yield SessionEpisode(
                episode_id=monitor.episode_id - 1,
                length=stats.episode_lengths[-1],
                reward=stats.episode_rewards[-1],
                video=Path(str(video.path)) if video and has_video else None,
            )


def with_chosen_videos(episodes: Sequence[SessionEpisode]) -> list[SessionEpisode]:
    """Return the episodes of a finished session that used `keep`, with their videos.

    `video` is None for each episode whose video was not kept.

    Raises:
        UnreadableFile: the manifest, which lists the choice, is missing or damaged.
    """
    video = next((each.video for each in episodes if each.video), None)
    if video is None:
        return list(episodes)
    manifest = read_manifest(video.with_name(manifest_name(infix_of(video.name) or "")))
    chosen = (manifest.mjrec or {})["schedule"]["recorded"]
    return [
        each if each.episode_id in chosen else replace(each, video=None)
        for each in episodes
    ]


def _check(session: Session) -> None:
    """Check everything that can be checked before importing or creating anything."""
    keep = session.monitor.keep
    if session.episodes < 1:
        raise InvalidArgument(
            f"episodes must be a positive whole number, not {session.episodes}."
        )
    if keep is not None and session.schedule is not None:
        raise InvalidArgument(
            "The episodes that get a video are chosen either by keep (--keep "
            f"{keep}) or by a schedule (--schedule {session.schedule}), but not by "
            "both: omit one of them."
        )
    parse_environment_name(session.environment)
    episode_seeds(session.seed, 0)


def _environment(session: Session, *, frames: bool) -> NamedEnvironment:
    render, workers = session.monitor.render, session.monitor.workers
    no_gl = None
    # Will this process, or one that it starts, render?
    if frames and (render == LIVE or (render is None and workers != 0)):
        # A text environment, or one with its own renderer, needs no OpenGL, but this is
        # known only once the environment exists. So keep the error for later.
        try:
            use_gl()
        except GLError as error:
            no_gl = error
    # Imported late, because MuJoCo reads the backend when it is loaded.
    from .simulation.warnings import log_mujoco_warnings

    log_mujoco_warnings()
    named = environment_from_name(
        session.environment, replace(session.made, frames=frames, seed=session.seed)
    )
    if no_gl is None or simulation_in(named.environment) is None:
        return named
    with contextlib.closing(named.environment):
        if render == LIVE or not named.can_be_deferred():
            raise no_gl
        raise GLError(
            f"{no_gl}\nRecording itself needs no OpenGL: use --workers 0 (workers=0) "
            f"to record the states, and `mjrec render {session.directory}` to render "
            "the videos on a machine where OpenGL works."
        )
