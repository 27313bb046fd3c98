# SPDX-License-Identifier: Apache-2.0
"""`mjrec record`: record episodes of an environment into a monitor directory."""

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
from ..plain_text import counted
from ..recorder.options import RecorderOptions
from ..sessions import Session, SessionEpisode, record_session, with_chosen_videos
from .not_finite import ALLOWED, not_finite_lines
from .options import AsJson, camera_of, kwargs_of, size_of
from .terminal import FAILED, INTERRUPTED, print_json, print_lines


def record(
    env: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ENV")],
    /,
    *,
    out: Path,
    episodes: int = 1,
    policy: str = "random",
    seed: int | None = None,
    size: str | None = None,
    max_steps: int | None = None,
    camera: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    schedule: str | None = None,
    keep: str | None = None,
    force: bool = False,
    resume: bool = False,
    quality: Literal["full", "draft"] = "full",
    workers: int | None = None,
    render: Literal["deferred", "live", "off"] | None = None,
    max_fps: float = 60,
    fps: float | None = None,
    tiled: bool = False,
    annotate: bool = False,
    name_prefix: str | None = None,
    env_kwargs: str = "{}",
    policy_kwargs: str = "{}",
    allow_nan: bool = False,
    as_json: AsJson = False,
) -> int:
    """Record episodes of an environment.

    The exit status is 1 if a return is NaN or infinite.

    Args:
        env: a Gymnasium id (HalfCheetah-v5), dm_control/<domain>-<task>
            (dm_control/humanoid-run) or the path of an MJCF file.
        out: the monitor directory.
        episodes: number of episodes.
        policy: random, zero, module:name (a function, or a class that is instantiated
            with the environment), module:name() (called with the environment; returns
            the policy), or a file you trust: model.zip from Stable-Baselines3,
            TorchScript (.pt), ONNX (.onnx).
        seed: S; episode i starts from NumPy's SeedSequence([S, i]). Default: a new
            seed, which is printed.
        size: size of the videos, WIDTHxHEIGHT in pixels.
        max_steps: truncate episodes after this many steps. Default: the
            environment's limit, or 1000.
        camera: name or number, or a free camera as JSON ('{"distance": 3, "azimuth":
            90}'). Default: the model's tracking camera, if it has one. Repeat the
            option to get a video from each camera.
        schedule: which episodes get a video: cubic (0, 1, 8, 27 ... and every 1000th),
            all, none, every:N or at:0,5,9. Default: cubic.
        keep: choose the videos after the episodes have ended: best:N or worst:N (by
            return), failures, failures:N (the first N) or median. Other recordings
            are deleted.
        force: delete the recordings in the directory first.
        resume: add to the recordings in the directory.
        quality: full, or draft (several times faster, with coarser edges and shadows).
        workers: processes that render deferred videos. Default: one per CPU. 0
            renders nothing now and needs no OpenGL; mjrec render DIR does it later.
        render: deferred saves states and renders in worker processes; live renders
            while the simulation runs; off makes no videos. Default: deferred if
            the frames are known to be the same, otherwise live.
        max_fps: maximum frames per second of simulated time. Steps in between are left
            out of the video; the last step is always kept.
        fps: frames per second written into the videos. Default: real time.
        tiled: one video with all cameras side by side.
        annotate: write episode, step, time and return on the frames.
        name_prefix: also name the videos in the style of Gymnasium's RecordVideo:
            PREFIX-episode-27.mp4.
        env_kwargs: arguments for the environment, as a JSON object.
        policy_kwargs: arguments for the policy's class, factory or file loader, as a
            JSON object.
        allow_nan: do not exit with status 1 because of NaN or infinite returns.
        as_json: print one JSON object at the end, and nothing else.
    """
    height, width = size_of(size)
    first, *further = map(camera_of, camera or [None])
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
        placed_camera=first if isinstance(first, dict) else None,
        further_cameras=tuple(further),
        made=EnvironmentOptions(
            camera=None if isinstance(first, dict) else first,
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
    not_finite = [
        f"episode {e.episode_id}" for e in recorded if not math.isfinite(e.reward)
    ]
    if as_json:
        print_json(_fields(session, recorded, interrupted))
    else:
        print_lines(console, _summary(session, recorded, interrupted))
        print_lines(console, not_finite_lines(not_finite, ALLOWED))
    if interrupted:
        return INTERRUPTED
    return FAILED if not_finite and not allow_nan else 0


def _run(
    session: Session, console: rich.console.Console
) -> tuple[list[SessionEpisode], bool]:
    """Return the recorded episodes, and whether Ctrl-C ended the recording early."""
    recorded: list[SessionEpisode] = []
    steps, total = 0, session.episodes
    with progress_bar(console) as show:

        def show_progress() -> None:
            words = f"{len(recorded)}/{total} episodes, {steps} steps"
            show(session.environment, len(recorded), total, words)

        def count_step() -> None:
            nonlocal steps
            steps += 1
            # Updating the bar costs more than a step of a small environment.
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
        yield "Interrupted. Everything recorded so far is complete:"
    videos = [episode.video for episode in recorded if episode.video]
    files = [name for video in videos for name in _files(video)]
    episodes = counted(len(recorded), "episode")
    yield f"{episodes} of {session.environment}, seed {session.seed}, in"
    yield f"  {session.directory.absolute()}"
    yield counted(len(files), "video") + ":" * bool(files)
    yield from (f"  {name}" for name in files)


def _files(video: Path) -> list[str]:
    """Return the names of an episode's videos from all cameras."""
    # Incomplete videos never have their final name.
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
                **vars(episode),
                "video": episode.video and episode.video.name,
                "pending": bool(episode.video and not episode.video.exists()),
            }
            for episode in recorded
        ],
    }
