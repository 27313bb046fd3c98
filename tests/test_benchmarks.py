# SPDX-License-Identifier: Apache-2.0
"""The benchmarks at a toy size: what they give, not how fast anything is."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from benchmarks import (
    disk,
    encoding,
    engines,
    evaluating,
    memory,
    rendering,
    reporting,
    scaling,
    stepping,
    time_to_video,
    verifying,
)
from benchmarks.children import ChildFailed, call
from benchmarks.many_monitors import TASK, write_evaluation, write_monitors
from benchmarks.results import Reference, Result, at_least, at_most
from benchmarks.rounds import take_turns
from benchmarks.tables import table_of
from rich.console import Console

import mjrec
from mjrec.evaluation.ledger import read_ledgers
from mjrec.evaluation.results_files import read_results

ROOT = Path(__file__).parents[1]
TINY = (16, 16)

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("moviepy") is None, reason="moviepy is not installed"
)


def silently(words: str) -> None:
    """Say nothing of the progress."""
    del words


def labels(results: list[Result]) -> list[tuple[str, str]]:
    return [(result.subject, result.variant) for result in results]


def promised(results: list[Result]) -> dict[str, str]:
    return {r.variant: str(r.promise) for r in results if r.promise}


# --- what is done with numbers -------------------------------------------------------


def result(*samples: float, **others: Any) -> Result:
    return Result(subject="s", variant="v", unit="s", samples=samples, **others)


def test_comparison_is_that_of_the_medians() -> None:
    """Its range is that of the rounds, each with its own reference."""
    reference = Reference("bare", (2.0, 4.0, 100.0))
    compared = result(1.0, 3.0, 90.0, reference=reference)
    assert compared.compared == 3.0 / 4.0
    assert compared.compared_quartiles == pytest.approx((0.625, 0.825))


def test_differences_are_subtracted() -> None:
    """Memory is compared so."""
    reference = Reference("bare", (70.0,), is_ratio=False)
    assert result(90.0, reference=reference).compared == 20.0


@pytest.mark.parametrize(
    ("promise", "value", "kept"),
    [
        (at_least(0.8), 0.8, True),
        (at_least(0.8), 0.79, False),
        (at_most(64), 64.0, True),
        (at_most(64), 65.0, False),
    ],
)
def test_promise_is_kept_at_its_bound(promise: Any, value: float, kept: bool) -> None:
    """And not beyond it."""
    assert result(value, promise=promise).is_kept is kept


def test_promise_of_a_comparison_is_about_the_comparison() -> None:
    """Not about the number itself."""
    reference = Reference("bare", (100.0,))
    assert result(70.0, reference=reference, promise=at_least(0.8)).is_kept is False


def test_what_was_not_measured_keeps_and_breaks_nothing() -> None:
    """It stands in the table, and says why."""
    missing = result(promise=at_least(1), note="moviepy is not installed")
    assert missing.is_kept is None
    assert json.dumps(missing.as_json(), allow_nan=False)
    assert "moviepy is not installed" in shown([missing])


def test_each_variant_has_each_place_in_the_order() -> None:
    """Rounds begin with another one each."""
    order: list[str] = []

    def ran(name: str) -> Callable[[], int]:
        def run() -> int:
            order.append(name)
            return len(order)

        return run

    samples = take_turns({n: ran(n) for n in "abc"}, rounds=3, say=silently)
    assert "".join(order) == "abcbcacab"
    assert samples == {"a": [1, 6, 8], "b": [2, 4, 9], "c": [3, 5, 7]}


def test_failing_child_says_what_it_printed() -> None:
    """An environment that there is not."""
    setup = {"env_id": "NoSuchThing-v5"}
    with pytest.raises(ChildFailed, match="NoSuchThing"):
        call(stepping.run_episodes, setup=setup, steps=1)


def shown(results: list[Result]) -> str:
    console = Console(width=200)
    with console.capture() as captured:
        console.print(table_of("title", results))
    return captured.get()


# --- the measurements ----------------------------------------------------------------


@pytest.mark.thorough
def test_stepping_compares_all_with_the_bare_environment() -> None:
    """The promises are those of counted and of captured episodes."""
    settings = stepping.Settings(
        environments=("HalfCheetah-v5",),
        rounds=1,
        steps=30,
        drawn_steps=2,
        make={"max_episode_steps": 10, "height": 16, "width": 16},
    )
    results = stepping.measure(settings, silently)
    assert len(results) == 6
    assert all(len(r.samples) == 1 and r.median > 0 for r in results)
    assert [r.reference is None for r in results] == [True] + [False] * 5
    assert set(promised(results).values()) == {"≥ 0.95", "≥ 0.8"}


@pytest.mark.thorough
def test_time_to_video_compares_with_record_video() -> None:
    """Each variant of a case has its promise."""
    settings = time_to_video.Settings(
        rounds=1, steps=2, size=TINY, workers=1, cases=time_to_video.CASES[1:]
    )
    results = time_to_video.measure(settings, silently)
    assert labels(results) == [
        ("Hopper-v5", "RecordVideo"),
        ("Hopper-v5", "max_fps=30, full quality"),
    ]
    assert results[1].reference == Reference("RecordVideo", results[0].samples)
    assert promised(results) == {"max_fps=30, full quality": "≤ 0.3"}


@pytest.mark.thorough
def test_memory_compares_processes_of_equal_episodes() -> None:
    """And the longer episode with the shorter one."""
    settings = memory.Settings(
        rounds=1, short=2, long=4, size=TINY, recorders=("bare", "workers=0")
    )
    results = memory.measure(settings, silently)
    assert {r.subject for r in results} == {"2 frames", "4 frames", "2 to 4 frames"}
    assert all(20 < r.median < 2000 for r in results)
    assert set(promised(results).values()) == {"≤ 64", "≤ 4"}


@pytest.mark.thorough
def test_rendering_draws_the_same_states_in_three_ways() -> None:
    """`mjrec.render` is what was promised."""
    settings = rendering.Settings(
        environments=("HalfCheetah-v5",), rounds=1, frames=3, size=TINY
    )
    results = rendering.measure(settings, silently)
    assert [r.variant for r in results] == [
        *("mujoco.Renderer", "mjrec.render(workers=1)", "worker alone"),
    ]
    assert promised(results) == {"mjrec.render(workers=1)": "≥ 0.9"}


@pytest.mark.thorough
def test_verifying_is_compared_with_stepping() -> None:
    """Its steps alone, and with the environment; and the memory of many episodes."""
    settings = verifying.Settings(rounds=1, episodes=2, few=1, steps=20)
    results = verifying.measure(settings, silently)
    kept = promised(results)
    assert kept["steps alone"] == "≤ 1.5"
    assert kept["steps and environment"] == "≤ 2.5"


@pytest.mark.thorough
@pytest.mark.dm_control
def test_evaluating_compares_two_workers_with_one() -> None:
    """The promise is a part of the time of one."""
    settings = evaluating.Settings(rounds=1, tasks=1, episodes=1, steps=2)
    results = evaluating.measure(settings, silently)
    assert labels(results) == [
        ("1 tasks, 1 episodes each", "1 worker"),
        ("1 tasks, 1 episodes each", "2 workers"),
    ]
    assert promised(results) == {"2 workers": "≤ 0.588235"}


@pytest.mark.thorough
def test_reporting_is_compared_with_loading() -> None:
    """And the memory of many episodes has a limit."""
    settings = reporting.Settings(rounds=1, episodes=20, videos=2, many_episodes=100)
    results = reporting.measure(settings, silently)
    kept = promised(results)
    assert kept["report written"] == "≤ 3"
    assert kept["results loaded, peak memory"] == "≤ 500"
    assert all(r.median > 0 for r in results if r.samples)


@pytest.mark.thorough
def test_scaling_compares_many_monitors_with_fewer() -> None:
    """Reading is to grow as their number does, and its memory has a limit."""
    settings = scaling.Settings(
        rounds=1, monitors=(2, 4), episodes=2, tasks=2, results=(10, 20)
    )
    results = scaling.measure(settings, silently)
    readers = [r for r in results if r.subject == "load_results"]
    assert [r.variant for r in readers] == [
        *("2 monitors", "4 monitors", "4 monitors, peak memory"),
    ]
    kept = promised(readers)
    assert kept["4 monitors"] == "≤ 3"
    assert kept["4 monitors, peak memory"] == "≤ 30.048"
    assert all(r.median > 0 for r in results)


def test_engines_gives_what_an_engine_adds() -> None:
    """How soon there is a worker, how fast jobs go, and how large a worker is."""
    settings = engines.Settings(rounds=1, workers=(2,), jobs=20)
    results = engines.measure(settings, silently)
    assert [r.unit for r in results] == ["s", "jobs/s", "MB"]
    assert all(r.median > 0 for r in results)


@pytest.mark.thorough
def test_disk_gives_the_size_of_every_file() -> None:
    """Log, finished file, and both of the model."""
    settings = disk.Settings(environments=("HalfCheetah-v5",), rounds=1, steps=10)
    sizes = {r.variant: r.median for r in disk.measure(settings, silently)}
    assert sizes.keys() == {
        *("log, per 1000 steps", "finished .h5, per 1000 steps"),
        *("time to finish, per 1000 steps", "model, .mjb.gz", "model, .zip"),
    }
    assert all(size > 0 for size in sizes.values())


@pytest.mark.thorough
def test_encoding_gives_the_rate_of_each_codec() -> None:
    """Lossless ones too."""
    settings = encoding.Settings(rounds=1, frames=2, size=TINY)
    results = encoding.measure(settings, silently)
    assert len(results) == 4
    assert all(r.unit == "frames/s" and r.median > 0 for r in results)


# --- the files that are measured ------------------------------------------------------


def test_written_monitors_are_as_recorded_ones(tmp_path: Path) -> None:
    """All readers find the same episodes, and nothing is to be put in order."""
    write_monitors(tmp_path / "task", monitors=3, episodes=2)
    results = mjrec.load_results(tmp_path / "task")
    assert results is not None
    assert len(results["manifests"]) == 3
    assert results["env_info"]["env_id"] == TASK
    assert results["episode_lengths"] == [1000] * 6
    listed = mjrec.iter_episodes(tmp_path / "task")
    assert [episode.episode_id for episode in listed] == [*range(6)]
    assert len(read_ledgers(tmp_path / "task")) == 6
    assert not mjrec.recover(tmp_path / "task")


def test_written_evaluation_can_be_read(tmp_path: Path) -> None:
    """Its tables have the episodes of all monitors."""
    write_evaluation(tmp_path / "e", tasks=2, monitors=3, episodes=2)
    read = read_results(tmp_path / "e", needs_timing=True)
    assert [len(columns) for columns in read.columns.values()] == [6, 6]
    assert all(columns.has_trajectory.any() for columns in read.columns.values())


# --- the command ---------------------------------------------------------------------


def test_command_names_what_can_be_measured() -> None:
    """An unknown name is refused before anything is measured."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "--only", "speed"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "stepping" in done.stderr
