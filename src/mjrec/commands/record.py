# SPDX-License-Identifier: Apache-2.0
"""`mjrec record`: episodes of an environment into a monitor directory."""

from __future__ import annotations

import contextlib
import math
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import rich.console
import tyro

from ..environments.named_environment import EnvironmentOptions
from ..formats.video_metadata import finished_videos
from ..monitors.progress import progress_bar
from ..recorder.options import RecorderOptions
from ..sessions import (
    Session,
    SessionEpisode,
    record_session,
    with_chosen_videos,
)
from .options import AsJson, camera_of, kwargs_of, number_or_name, size_of
from .terminal import counted, print_json, print_lines

_FAILED = 1
_INTERRUPTED = 130


def record(
    env: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ENV")],
    /,
    *,
    out: Path,
    episodes: int = 1,
    max_steps: int | None = None,
    policy: str = "random",
    policy_kwargs: str = "{}",
    seed: int | None = None,
    schedule: str | None = None,
    keep: str | None = None,
    force: bool = False,
    resume: bool = False,
    camera: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    tiled: bool = False,
    annotate: bool = False,
    name_prefix: str | None = None,
    size: str | None = None,
    fps: float | None = None,
    max_fps: float = 60,
    render: Literal["deferred", "live", "off"] | None = None,
    workers: int | None = None,
    quality: Literal["full", "draft"] = "full",
    env_kwargs: str = "{}",
    allow_nan: bool = False,
    as_json: AsJson = False,
) -> int:
    """Record episodes of an environment.

    The exit status is 1 where a return is NaN or infinite.

    Args:
        env: a Gymnasium id (HalfCheetah-v5), dm_control/<domain>-<task>
            (dm_control/humanoid-run) or the path of an MJCF file.
        out: the monitor directory.
        episodes: how many to record.
        max_steps: ends an episode as truncated; 1000 where the environment itself has
            no limit.
        policy: random, zero, or module:name. A class is built with the environment, a
            function is the policy, module:name() is called with the environment and
            returns the policy. Or a file that you trust: model.zip of
            Stable-Baselines3, TorchScript (.pt) or ONNX (.onnx).
        policy_kwargs: more arguments for the class, the call or the file's reader
            (device), as a JSON object.
        seed: S; episode i starts from NumPy's SeedSequence([S, i]). A fresh one, which
            is printed, if it is not given.
        schedule: which episodes get a video: cubic (0, 1, 8, 27 ... and every 1000th),
            all, none, every:N or at:0,5,9. If neither it nor keep is given, cubic.
        keep: which episodes get a video, decided when they have ended: best:N or
            worst:N (by return), failures or failures:N (the first N), or median.
            Every episode is recorded, and what is not chosen is deleted.
        force: delete the recordings that are in the directory.
        resume: add to the recordings that are in the directory.
        camera: name or number; the model's tracking camera, where there is one, if it
            is not given. Given more than once: a video from each.
        tiled: one video of all cameras side by side.
        annotate: write episode, step, time and return on the frames.
        name_prefix: videos get the names that Gymnasium's RecordVideo would give them,
            PREFIX-episode-27.mp4, besides their own.
        size: of the videos, WIDTHxHEIGHT in pixels.
        fps: frames per second written into the videos; real time, if not given.
        max_fps: the most frames for a second of simulated time; of a faster simulation
            every second, third ... step is shown, and always the last.
        render: deferred: record states, and draw the videos from them in processes of
            their own. live: draw while the simulation runs. off: no videos, only
            statistics and trajectories. If it is not given, deferred where the
            pictures are known to be the same, else live.
        workers: how many processes draw deferred videos; one for each CPU, if it is not
            given. 0 draws nothing now, needs no OpenGL, and leaves the videos pending:
            mjrec render DIR makes them.
        quality: full, or draft: several times faster, with coarser edges and shadows.
        env_kwargs: more arguments for the environment, as a JSON object.
        allow_nan: returns that are NaN or infinite do not make the exit status 1.
        as_json: print one JSON object at the end, and nothing else.
    """
    height, width = size_of(size)
    if seed is None:
        seed = secrets.randbits(31)
    session = Session(
        environment=env,
        directory=out,
        episodes=episodes,
        policy=policy,
        policy_kwargs=kwargs_of(policy_kwargs, "--policy-kwargs"),
        seed=seed,
        schedule=schedule,
        further_cameras=tuple(number_or_name(each) for each in camera[1:]),
        made=EnvironmentOptions(
            camera=camera_of(camera[0] if camera else None),
            height=height,
            width=width,
            max_steps=max_steps,
            kwargs=kwargs_of(env_kwargs),
        ),
        monitor=RecorderOptions(
            keep=keep,
            force=force,
            resume=resume,
            tiled=tiled,
            annotate=annotate,
            name_prefix=name_prefix,
            fps=fps,
            max_fps=max_fps,
            render=render,
            workers=workers,
            quality=quality,
        ),
    )
    console = rich.console.Console(quiet=as_json)
    recorded, interrupted = _run(session, console)
    if keep is not None:
        recorded = with_chosen_videos(recorded)
    not_finite = [e.episode_id for e in recorded if not math.isfinite(e.reward)]
    if as_json:
        print_json(_fields(session, recorded, interrupted))
    else:
        print_lines(console, _summary(session, recorded, interrupted))
        if not_finite:
            what = counted(len(not_finite), "return")
            why = f"which is no success (--allow-nan): episode {not_finite[0]}"
            print_lines(console, [f"{what} NaN or infinite, {why}"])
    if interrupted:
        return _INTERRUPTED
    return _FAILED if not_finite and not allow_nan else 0


def _run(
    session: Session, console: rich.console.Console
) -> tuple[list[SessionEpisode], bool]:
    """Return the recorded episodes, and whether Ctrl-C ended them early."""
    recorded: list[SessionEpisode] = []
    steps, total = 0, session.episodes
    with progress_bar(console) as show:

        def show_progress() -> None:
            words = f"{len(recorded)}/{total} episodes, {steps} steps"
            show(session.environment, len(recorded), total, words)

        def count_step() -> None:
            nonlocal steps
            steps += 1
            # An update costs more than a step of a small environment.
            if steps % 16 == 0:
                show_progress()

        with contextlib.closing(record_session(session, on_step=count_step)) as run:
            try:
                for episode in run:
                    recorded.append(episode)
                    show_progress()
                    if not console.is_terminal:
                        print_lines(console, [_ended(episode, len(recorded), total)])
            except KeyboardInterrupt:
                return recorded, True
    return recorded, False


def _ended(episode: SessionEpisode, done: int, total: int) -> str:
    return (
        f"episode {episode.episode_id} ({done}/{total}): {episode.length} steps, "
        f"return {episode.reward:.6g}"
    )


def _summary(
    session: Session, recorded: list[SessionEpisode], interrupted: bool
) -> Iterator[str]:
    if interrupted:
        yield "Interrupted. What was recorded so far is complete:"
    videos = [episode.video for episode in recorded if episode.video]
    files = [name for video in videos for name in _files(video)]
    episodes = counted(len(recorded), "episode")
    yield f"{episodes} of {session.environment}, seed {session.seed}, in"
    yield f"  {session.directory.absolute()}"
    yield counted(len(files), "video") + ":" * bool(files)
    yield from (f"  {name}" for name in files)


def _files(video: Path) -> list[str]:
    """Return the names of an episode's videos, those of further cameras too."""
    # Nothing incomplete has a video's final name.
    if video.exists():
        return [name for name, _ in finished_videos(video)]
    return [f"{video.name}  (pending: mjrec render {video.parent})"]


def _fields(
    session: Session, recorded: list[SessionEpisode], interrupted: bool
) -> dict[str, object]:
    return {
        "directory": str(session.directory.absolute()),
        "environment": session.environment,
        "seed": session.seed,
        "interrupted": interrupted,
        "episodes": [
            {
                "episode_id": episode.episode_id,
                "length": episode.length,
                "reward": episode.reward,
                "video": episode.video.name if episode.video else None,
                "pending": bool(episode.video and not episode.video.exists()),
            }
            for episode in recorded
        ],
    }
