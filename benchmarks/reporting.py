# SPDX-License-Identifier: Apache-2.0
"""The cost of a report, compared with loading the results that it shows."""

from __future__ import annotations

import functools
import importlib.util
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import mjrec
from mjrec.reporting.gathering import gather
from mjrec.reporting.media import ReportProgress

from .children import call
from .process_memory import peak_memory
from .results import Reference, Result, at_most
from .rounds import Say, take_turns

TITLE = "Reporting: a page for a training run with many episodes"

_LOADED, _WRITTEN, _OPENED = "results loaded", "report written", "page opened"
_EMPTY = "empty page opened"
_WRITING_PROMISE = at_most(3)
# In milliseconds; people perceive this as immediate.
_OPENING_PROMISE = at_most(300)
_MEMORY_PROMISE = at_most(500)

_CHROMIUM = "/usr/bin/chromium"
_STEPS = 2
_SIZE = 64


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        rounds: number of rounds.
        episodes: number of episodes in the report.
        videos: number of episodes with a video.
        many_episodes: number of episodes to load when memory is measured.
    """

    rounds: int = 5
    episodes: int = 10_000
    videos: int = 100
    many_episodes: int = 1_000_000


FULL = Settings()
QUICK = Settings(rounds=3, episodes=2000, videos=20, many_episodes=100_000)


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return the times to load results, write the report and open the page."""
    with tempfile.TemporaryDirectory() as place:
        recordings, many = Path(place) / "recordings", Path(place) / "many"
        say(f"recording {settings.episodes} episodes")
        call(
            record,
            directory=str(recordings),
            episodes=settings.episodes,
            videos=settings.videos,
        )
        say(f"writing a journal of {settings.many_episodes} episodes")
        write_journal(many, settings.many_episodes)
        samples = take_turns(
            _variants(recordings, many, Path(place) / "report"),
            rounds=settings.rounds,
            say=say,
        )
    return _results(samples, settings)


class _Flicker(gymnasium.Env[Any, Any]):
    """An environment that costs nothing to step and shows a new image each time."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012  # Gymnasium's
    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    render_mode = "rgb_array"

    def __init__(self) -> None:
        self._step = 0

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._step = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self._step += 1
        reward = float(self.np_random.normal())
        ended = self._step >= _STEPS
        return np.zeros(1, np.float32), reward, False, ended, {}

    def render(self) -> Any:
        return np.full((_SIZE, _SIZE, 3), 40 * self._step, np.uint8)


def record(directory: str, episodes: int, videos: int) -> None:
    """Record a training run."""
    every = max(1, episodes // videos)
    monitor: Any = mjrec.Monitor(_Flicker(), directory, lambda n: n % every == 0)
    for number in range(episodes):
        monitor.reset(seed=number)
        for _ in range(_STEPS):
            monitor.step(np.zeros(1, np.float32))
    monitor.close()


def write_journal(directory: Path, episodes: int) -> None:
    """Write the journal that a monitor has after many episodes, before it is closed."""
    directory.mkdir()
    info = {"gym_version": "mjrec-1", "env_id": "HalfCheetah-v5"}
    # `JournalWriter` makes a system call for each line, which takes minutes here.
    with (directory / "openaigym.episodes.0.1.jsonl").open("w") as file:
        file.write(json.dumps({"run": {"env_info": info}}) + "\n")
        file.writelines(
            f'{{"episode_id": {n}, "length": 1000, "reward": {n % 1013}.0, "type": "t",'
            f' "start_time": {1.79e9 + n}, "end_time": {1.79e9 + n + 0.5}, "seed": {n},'
            ' "options": null, "terminated": false, "truncated": true,'
            ' "success": null}\n'
            for n in range(episodes)
        )


def seconds_to_load(directory: str) -> float:
    """Return the seconds that it takes to load the results."""
    start = time.perf_counter()
    gather(directory)
    return time.perf_counter() - start


def seconds_to_write(directory: str, report: str) -> float:
    """Return the seconds that it takes to write a report, without the posters."""
    at: dict[str, list[float]] = {}

    def note(progress: ReportProgress) -> None:
        at.setdefault(progress.what, []).append(time.perf_counter())

    shutil.rmtree(report, ignore_errors=True)
    start = time.perf_counter()
    mjrec.write_report(directory, report, on_progress=note)
    seconds = time.perf_counter() - start
    posters = at.get("posters", [])
    return seconds - (posters[-1] - posters[0]) if posters else seconds


def milliseconds_to_open(page: str, empty: str) -> float:
    """Return the milliseconds that a browser takes to read a page and run its script.

    Chromium starts without a profile, so the page is neither cached nor compiled. It
    opens an empty page first, because the browser is still loading parts of itself
    during its start. The time of the second page does not include that.

    Args:
        page: path of the page.
        empty: path of an empty page.
    """
    from playwright.sync_api import sync_playwright

    arguments = ("--no-sandbox", "--disable-gpu", "--disable-background-networking")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=_CHROMIUM, args=list(arguments)
        )
        tab = browser.new_page()
        tab.goto(Path(empty).as_uri())
        tab.goto(Path(page).as_uri())
        milliseconds: float = tab.evaluate(
            "performance.getEntriesByType('navigation')[0].domContentLoadedEventEnd"
        )
        browser.close()
    return milliseconds


def memory_to_load(directory: str) -> float:
    """Return the peak of this process's memory, in MB, after loading the results."""
    contents = gather(directory)
    if not len(contents.tasks[0].episodes):
        raise RuntimeError("nothing was loaded")
    return peak_memory()


def _variants(
    recordings: Path, many: Path, report: Path
) -> dict[str, Callable[[], float]]:
    variants: dict[str, Callable[[], float]] = {
        _LOADED: functools.partial(call, seconds_to_load, directory=str(recordings)),
        _WRITTEN: functools.partial(
            call, seconds_to_write, directory=str(recordings), report=str(report)
        ),
        "memory": functools.partial(call, memory_to_load, directory=str(many)),
    }
    has_browser = importlib.util.find_spec("playwright") and Path(_CHROMIUM).exists()
    if has_browser:
        empty = report.with_name("empty.html")
        empty.write_text("<!doctype html><title>Empty</title>")
        variants[_EMPTY] = functools.partial(
            call, milliseconds_to_open, page=str(empty), empty=str(empty)
        )
        variants[_OPENED] = functools.partial(_open_report, recordings, report, empty)
    return variants


def _open_report(recordings: Path, report: Path, empty: Path) -> float:
    if not report.exists():
        call(seconds_to_write, directory=str(recordings), report=str(report))
    page = report / "index.html"
    return call(milliseconds_to_open, page=str(page), empty=str(empty))


def _results(samples: Mapping[str, list[float]], settings: Settings) -> list[Result]:
    subject = f"{settings.episodes} episodes, {settings.videos} videos"
    loaded = Reference(_LOADED, tuple(samples[_LOADED]))
    opened = tuple(samples.get(_OPENED, ()))
    empty = tuple(samples.get(_EMPTY, ()))
    return [
        Result(subject=subject, variant=_LOADED, unit="s", samples=loaded.samples),
        Result(
            subject=subject,
            variant=_WRITTEN,
            unit="s",
            samples=tuple(samples[_WRITTEN]),
            reference=loaded,
            promise=_WRITING_PROMISE,
            note="without the posters",
        ),
        Result(subject="no report", variant=_EMPTY, unit="ms", samples=empty),
        Result(
            subject=subject,
            variant=_OPENED,
            unit="ms",
            samples=opened,
            promise=_OPENING_PROMISE,
            note="" if opened else "needs Playwright and Debian's chromium",
        ),
        Result(
            subject=f"{settings.many_episodes} episodes",
            variant="results loaded, peak memory",
            unit="MB",
            samples=tuple(samples["memory"]),
            promise=_MEMORY_PROMISE,
        ),
    ]
