# SPDX-License-Identifier: Apache-2.0
"""A recording session: so many episodes of a named environment, under a policy.

This is what `mjrec record` does. Episode i of a session with the seed S starts from
`SeedSequence([S, i])` (`environments.episode_seeds` has the recipe), so any episode
can be recorded again without those before it.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from .environments.episode_seeds import EpisodeSeeds, episode_seeds
from .environments.from_name import NamedEnvironment, environment_from_name
from .environments.global_generators import seed_global_generators
from .environments.names import parse_environment_name
from .environments.options import EnvironmentOptions
from .environments.policies import Policy, load_policy, policy_file
from .environments.working_directory import working_directory_importable
from .errors import GLError, InvalidArgument
from .formats.manifest import read_manifest
from .formats.monitor_directory import Infix, infix_of, manifest_name
from .gl import use_gl
from .monitors import Monitor
from .recorder.options import LIVE, OFF, RecorderOptions
from .schedules import disable_videos, schedule_from_text

if TYPE_CHECKING:
    from .monitors.dm_env_monitor import DmEnvMonitor
    from .monitors.gymnasium_monitor import GymnasiumMonitor


@dataclass(frozen=True, kw_only=True)
class Session:
    """What is to be recorded.

    Attributes:
        environment: a Gymnasium id, `dm_control/<domain>-<task>`, or the path of an
            MJCF file.
        directory: the monitor directory.
        seed: of the session, a whole number from 0 to 2**32 - 1.
        episodes: how many.
        max_steps: ends an episode as truncated; None is the environment's own limit,
            and 1000 where it has none.
        policy: `random`, `zero` or `module:name`.
        schedule: which episodes get a video: `cubic`, `all`, `none`, `every:N` or
            `at:0,5,9`; None is `cubic`, unless there is `keep`.
        keep: which episodes get a video, decided when they have ended: `best:N`,
            `worst:N`, `failures`, `failures:N` or `median`, see `mjrec.Monitor`.
        force: delete the recordings that are in the directory.
        resume: add to the recordings that are in the directory.
        camera: a name or number; None is the model's tracking camera where there is
            one.
        further_cameras: of more videos of the same episodes.
        tiled: one video of all cameras side by side, instead of one for each.
        annotate: whether episode, step, time and return are written on the frames.
        name_prefix: of the second names of videos, see `mjrec.Monitor`.
        height: of the videos, in pixels; None is the environment's own.
        width: likewise.
        fps: the rate written into the videos; None is real time.
        max_fps: the most frames per second of simulated time; None is every step.
        render: when pictures are drawn, `"deferred"`, `"live"` or `"off"`, see
            `mjrec.Monitor`; None is deferred where it can be.
        workers: how many processes draw deferred pictures; None is one for each CPU;
            0 leaves the videos pending.
        quality: `"full"` or `"draft"`.
        env_kwargs: more arguments for the environment.
    """

    environment: str
    directory: Path
    seed: int
    episodes: int = 1
    max_steps: int | None = None
    policy: str = "random"
    schedule: str | None = None
    keep: str | None = None
    force: bool = False
    resume: bool = False
    camera: str | int | None = None
    further_cameras: tuple[str | int, ...] = ()
    tiled: bool = False
    annotate: bool = False
    name_prefix: str | None = None
    height: int | None = None
    width: int | None = None
    fps: float | None = None
    max_fps: float | None = None
    render: str | None = None
    workers: int | None = None
    quality: str = "full"
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class SessionEpisode:
    """An episode that was recorded.

    Attributes:
        episode_id: its number.
        length: number of steps.
        reward: sum of the rewards.
        video: its video, where the schedule chose it: where it is, or will be when
            it has been rendered. With `keep` also where it may still be chosen, or
            not: `with_chosen_videos` tells in the end.
    """

    episode_id: int
    length: int
    reward: float
    video: Path | None


def record_session(
    session: Session, *, on_step: Callable[[], None] = lambda: None
) -> Generator[SessionEpisode, None, None]:
    """Record a session, and yield each episode as it ends.

    The recordings are closed when the iterator ends, is closed, or raises; so close
    it, best with `contextlib.closing`. Only when it ends by itself are the videos
    waited for that are still to be rendered; else they are left pending.

    Args:
        session: what is to be recorded.
        on_step: called after every step.

    Raises:
        Error: the environment, policy, schedule, camera or directory cannot be; what
            they are is checked before anything is written.
    """
    _check(session)
    schedule = None
    if session.keep is None:
        schedule = schedule_from_text(session.schedule or "cubic")
    with contextlib.ExitStack() as stack:
        drawn = schedule is not disable_videos and session.render != OFF
        named = _environment(session, pictures=drawn)
        closing = stack.enter_context(contextlib.ExitStack())
        closing.callback(named.environment.close)
        policy = load_policy(session.policy, named.environment)
        recorded = Monitor(
            named.environment,
            session.directory,
            schedule,
            force=session.force,
            resume=session.resume,
            keep=session.keep,
            fps=session.fps,
            max_fps=session.max_fps,
            render=session.render,
            workers=session.workers,
            quality=session.quality,
            # Without videos it is still the schedule that chooses what is kept.
            trajectory_callable=schedule if session.render == OFF else None,
            env_id=named.env_id,
            tiled=session.tiled,
            annotate=session.annotate,
            name_prefix=session.name_prefix,
            policy_file=policy_file(session.policy),
            **_view(named, session),
        )
        # A name is that of one environment, never of a vector environment.
        monitor = cast("GymnasiumMonitor | DmEnvMonitor", recorded)
        # From here on the monitor closes the environment.
        closing.pop_all()
        stack.enter_context(monitor)
        for _ in range(session.episodes):
            seeds = episode_seeds(session.seed, monitor.episode_id)
            _run_episode(named, monitor, policy, seeds, on_step)
            yield _recorded(monitor)


def with_chosen_videos(episodes: Sequence[SessionEpisode]) -> list[SessionEpisode]:
    """Return the episodes of a session with `keep`, which has ended.

    They are as before, without the videos that were not chosen.

    Raises:
        UnreadableFile: the manifest, which tells that, is missing or damaged.
    """
    video = next((each.video for each in episodes if each.video), None)
    if video is None:
        return list(episodes)
    infix = Infix.parse(infix_of(video.name) or "")
    assert infix is not None
    manifest = read_manifest(video.with_name(manifest_name(infix)))
    chosen = (manifest.mjrec or {})["schedule"]["recorded"]
    return [
        each if each.episode_id in chosen else replace(each, video=None)
        for each in episodes
    ]


def _view(named: NamedEnvironment, session: Session) -> dict[str, Any]:
    """Return the monitor's cameras and size."""
    view = dict(named.view)
    if session.further_cameras:
        # An environment that was made with its camera shows it by itself.
        view["camera"] = [view.get("camera"), *session.further_cameras]
    return view


def _check(session: Session) -> None:
    """Check what can be checked before anything is imported or made."""
    if session.episodes < 1:
        raise InvalidArgument(
            f"episodes must be a positive whole number, got {session.episodes}."
        )
    RecorderOptions(
        fps=session.fps,
        max_fps=session.max_fps,
        render=session.render,
        workers=session.workers,
        quality=session.quality,
        keep=session.keep,
        tiled=session.tiled,
        annotate=session.annotate,
        name_prefix=session.name_prefix,
    )
    if session.keep is not None and session.schedule is not None:
        raise InvalidArgument(
            f"Either keep (--keep {session.keep}) chooses the episodes that get a "
            f"video, or a schedule does (--schedule {session.schedule}): leave one of "
            "them out."
        )
    parse_environment_name(session.environment)
    episode_seeds(session.seed, 0)


def _environment(session: Session, *, pictures: bool) -> NamedEnvironment:
    no_gl = _choose_gl() if pictures and _may_draw_here(session) else None
    named = environment_from_name(
        session.environment,
        EnvironmentOptions(
            camera=session.camera,
            height=session.height,
            width=session.width,
            max_steps=session.max_steps,
            pictures=pictures,
            seed=session.seed,
            kwargs=session.env_kwargs,
        ),
    )
    if no_gl is not None and "mujoco" in sys.modules:
        with contextlib.closing(named.environment):
            raise _without_gl(session, named, no_gl)
    return named


def _may_draw_here(session: Session) -> bool:
    """Tell whether this process may have to draw something."""
    if session.render is None:
        return session.workers != 0
    return session.render == LIVE


def _without_gl(session: Session, named: NamedEnvironment, error: GLError) -> GLError:
    if session.render == LIVE or not named.has_deferrable_pictures():
        return error
    return GLError(
        f"{error}\nRecording itself needs no OpenGL: with --workers 0 (workers=0) the "
        f"states are recorded, and `mjrec render {session.directory}` draws the videos "
        "from them on a machine where OpenGL works."
    )


def _choose_gl() -> GLError | None:
    """Choose a backend; return why there is none, which may not matter.

    A text environment, or one that draws by itself, needs no OpenGL, and only the
    environment tells which it is.
    """
    try:
        use_gl()
    except GLError as error:
        return error
    return None


def _run_episode(
    named: NamedEnvironment,
    monitor: GymnasiumMonitor | DmEnvMonitor,
    policy: Policy,
    seeds: EpisodeSeeds,
    on_step: Callable[[], None],
) -> None:
    with working_directory_importable():
        seed_global_generators(seeds.policy)
        policy.reset(seeds)
        observation = named.begin_episode(monitor, seeds)
        done = False
        while not done:
            observation, done = named.step(monitor, policy(observation))
            on_step()


def _recorded(monitor: GymnasiumMonitor | DmEnvMonitor) -> SessionEpisode:
    video = monitor.video_recorder
    recorded = video is not None and video.functional and not video.empty
    return SessionEpisode(
        episode_id=monitor.episode_id - 1,
        length=monitor.stats_recorder.episode_lengths[-1],
        reward=monitor.stats_recorder.episode_rewards[-1],
        video=Path(str(video.path)) if video is not None and recorded else None,
    )
