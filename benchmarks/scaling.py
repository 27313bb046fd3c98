# SPDX-License-Identifier: Apache-2.0
"""The growth of costs with the number of monitors that recorded in a directory."""

from __future__ import annotations

import functools
import importlib
import math
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium

import mjrec
from mjrec.evaluation.episode_results import read_chunk
from mjrec.evaluation.evaluation import Evaluation, write_results
from mjrec.evaluation.plan import EvaluatedTask, EvaluationPlan
from mjrec.evaluation.statistics import Bootstrap
from mjrec.evaluation.summaries import summarize_results
from mjrec.rendering.recordings import remove_unfinished

from .children import call
from .many_monitors import TASK, results_of, write_evaluation, write_monitors
from .process_memory import peak_memory
from .results import Promise, Reference, Result, at_most
from .rounds import Say, take_turns

TITLE = "Scaling: a directory in which many monitors have recorded"

# The memory in MB that a reader keeps per monitor with ten episodes, and the memory
# that it needs in any case.
_KEPT_MB, _NEEDED_MB = 0.012, 30.0
_RESULT_MB = 0.001
# The time may grow 1.5 times as much as the number of monitors, because other effects
# contribute to it.
_LINEAR = 1.5

_Work = Callable[[], object]
_Prepare = Callable[[Path], _Work]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        rounds: number of rounds.
        monitors: numbers of monitors per directory, in ascending order.
        episodes: number of episodes per monitor.
        tasks: number of tasks over which the monitors of an evaluation are distributed.
        results: numbers of episodes that a driver holds, in ascending order.
    """

    rounds: int = 3
    monitors: tuple[int, ...] = (100, 1000, 10_000)
    episodes: int = 10
    tasks: int = 50
    results: tuple[int, ...] = (100_000, 1_000_000)


FULL = Settings()
QUICK = Settings(monitors=(10, 100, 1000), tasks=5, results=(10_000, 100_000))


@dataclass(frozen=True)
class _Cost:
    """The cost of an operation: seconds, and peak memory before and after it in MB."""

    seconds: float
    before: float
    after: float


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return the time of each operation, the growth of the time, and the memory."""
    with tempfile.TemporaryDirectory() as place:
        directories = _directories(Path(place), settings, say)
        variants: dict[tuple[str, int], Callable[[], _Cost]] = {
            (name, count): functools.partial(
                _cost, run, operation=name, directory=str(directory)
            )
            for count, (task, evaluation) in directories.items()
            for name, directory in (
                *((name, task) for name in _OF_MONITORS),
                *((name, evaluation) for name in _OF_EVALUATIONS),
            )
        }
        for count in settings.results:
            variants[_HELD, count] = functools.partial(_cost, hold, results=count)
        samples = take_turns(variants, rounds=settings.rounds, say=say)
    return [*_results(samples, settings)]


def run(operation: str, directory: str) -> list[float]:
    """Run an operation once, and return its time and the memory before and after."""
    prepare = {**_OF_MONITORS, **_OF_EVALUATIONS}[operation]
    return _measured(prepare(Path(directory)))


def hold(results: int) -> list[float]:
    """Hold the results of many episodes, as a driver does, and write them."""
    plan = EvaluationPlan(
        tasks=(EvaluatedTask(TASK, TASK),),
        policy="random",
        seeds=(0,),
        episodes=results,
        keep="none",
    )

    def work() -> None:
        held = list(results_of(TASK, monitors=results, episodes=1))
        with tempfile.TemporaryDirectory() as place:
            evaluation = Evaluation(
                directory=Path(place),
                plan=plan,
                summaries=[summarize_results(TASK, held)],
                across=None,
                bootstrap=Bootstrap(),
                selection={},
                versions={},
            )
            write_results(evaluation, held)

    return _measured(work)


def _measured(work: _Work) -> list[float]:
    before, start = peak_memory(), time.perf_counter()
    work()
    return [time.perf_counter() - start, before, peak_memory()]


def _cost(function: Callable[..., list[float]], **arguments: Any) -> _Cost:
    return _Cost(*call(function, **arguments))


def _directories(
    place: Path, settings: Settings, say: Say
) -> dict[int, tuple[Path, Path]]:
    """Write a task's folder and an evaluation for each number of monitors."""
    directories = {}
    for count in settings.monitors:
        say(f"writing the files of {count} monitors, twice")
        task, evaluation = place / f"task{count}", place / f"evaluation{count}"
        write_monitors(task, monitors=count, episodes=settings.episodes)
        write_evaluation(
            evaluation,
            tasks=min(settings.tasks, count),
            monitors=count // min(settings.tasks, count),
            episodes=settings.episodes,
        )
        directories[count] = task, evaluation
    return directories


# The operations. Each function prepares an operation, including its imports, so that
# preparation does not count as part of the cost.


def _load(directory: Path) -> _Work:
    load_results = mjrec.load_results
    return lambda: load_results(directory)


def _list(directory: Path) -> _Work:
    iter_episodes = mjrec.iter_episodes
    return lambda: sum(1 for _ in iter_episodes(directory))


def _report(directory: Path) -> _Work:
    write_report = mjrec.write_report
    importlib.import_module("jinja2")
    report = directory.with_name(f"{directory.name}-report")
    shutil.rmtree(report, ignore_errors=True)
    return lambda: write_report(directory, report)


def _join(directory: Path) -> _Work:
    env = gymnasium.make(TASK)
    return lambda: _monitor(env, directory)


def _resume(directory: Path) -> _Work:
    env = gymnasium.make(TASK)
    return lambda: _monitor(env, directory, resume=True)


def _monitor(env: Any, directory: Path, *, resume: bool | str = "join") -> Any:
    """Open a monitor with the options that a worker of an evaluation uses."""
    return mjrec.Monitor(
        env,
        directory,
        video_callable=False,
        resume=resume,
        mode="evaluation",
        render="deferred",
        workers=0,
        env_id=TASK,
    )


def _recover(directory: Path) -> _Work:
    recover = mjrec.recover
    return lambda: recover(directory)


def _read_journals(directory: Path) -> _Work:
    return lambda: read_chunk(directory, TASK)


def _remove_unfinished(directory: Path) -> _Work:
    return lambda: remove_unfinished(directory / "openaigym.video.0.1.video000000.mp4")


_LOADED, _LISTED, _REPORTED = "load_results", "iter_episodes", "mjrec report"
_OF_MONITORS: Mapping[str, _Prepare] = {
    _LOADED: _load,
    _LISTED: _list,
    _REPORTED: _report,
    "a monitor joins": _join,
    "a monitor resumes": _resume,
    "mjrec recover": _recover,
    "journals read": _read_journals,
    "a video's leftovers removed": _remove_unfinished,
}
_REPORTED_EVALUATION = "mjrec report of an evaluation"
_OF_EVALUATIONS: Mapping[str, _Prepare] = {_REPORTED_EVALUATION: _report}
_HELD = "results held and written"
_READERS = (_LOADED, _LISTED, _REPORTED, _REPORTED_EVALUATION)


def _results(
    samples: Mapping[tuple[str, int], Sequence[_Cost]], settings: Settings
) -> Iterator[Result]:
    for name in (*_OF_MONITORS, *_OF_EVALUATIONS, _HELD):
        counts = settings.results if name == _HELD else settings.monitors
        what = "results" if name == _HELD else "monitors"
        for fewer, count in zip((None, *counts), counts, strict=False):
            less = () if fewer is None else samples[name, fewer]
            growth = count / (fewer or count)
            yield _time(name, f"{count} {what}", samples[name, count], less, growth)
        if name in (*_READERS, _HELD):
            most = counts[-1]
            bound = _bound(name, most)
            yield _memory(name, f"{most} {what}", samples[name, most], bound)


def _bound(name: str, count: int) -> Promise:
    return at_most(_NEEDED_MB + count * (_RESULT_MB if name == _HELD else _KEPT_MB))


def _time(
    name: str,
    variant: str,
    costs: Sequence[_Cost],
    less: Sequence[_Cost],
    growth: float,
) -> Result:
    seconds = tuple(cost.seconds for cost in costs)
    reference, promise, note = None, None, ""
    if less:
        before = tuple(cost.seconds for cost in less)
        reference = Reference(f"{growth:g} times fewer", before)
        exponent = math.log(statistics.median(seconds) / statistics.median(before))
        note = f"grows with an exponent of {exponent / math.log(growth):.2f}"
        promise = at_most(growth * _LINEAR) if name in _READERS else None
    return Result(
        subject=name,
        variant=variant,
        unit="s",
        samples=seconds,
        reference=reference,
        promise=promise,
        note=note,
    )


def _memory(
    name: str, variant: str, costs: Sequence[_Cost], promise: Promise
) -> Result:
    return Result(
        subject=name,
        variant=f"{variant}, peak memory",
        unit="MB",
        samples=tuple(cost.after for cost in costs),
        reference=Reference(
            "imports", tuple(cost.before for cost in costs), is_ratio=False
        ),
        promise=promise,
    )
