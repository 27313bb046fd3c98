# SPDX-License-Identifier: Apache-2.0
"""The benchmarks at a toy size: their results, not their speed."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks import stepping, time_to_video
from benchmarks.children import ChildFailed, call
from benchmarks.results import Reference, Result, at_least, at_most
from benchmarks.tables import table_of
from parts import parametrize
from rich.console import Console

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("moviepy") is None, reason="moviepy is not installed"
)


def result(*samples, **others):
    return Result(subject="s", variant="v", unit="s", samples=samples, **others)


def test_results_compare_medians_and_check_promises():
    """Quartiles are those of the rounds; memory is subtracted, and bounds inclusive."""
    reference = Reference("bare", (2.0, 4.0, 100.0))
    compared = result(1.0, 3.0, 90.0, reference=reference, promise=at_least(0.8))
    assert compared.compared == 3.0 / 4.0
    assert compared.compared_quartiles == pytest.approx((0.625, 0.825))
    # The promise concerns the comparison, not the number.
    assert compared.is_kept is False
    for promise, kept, broken in ((at_least(0.8), 0.8, 0.79), (at_most(64), 64.0, 65)):
        assert result(kept, promise=promise).is_kept is True
        assert result(broken, promise=promise).is_kept is False
    difference = Reference("bare", (70.0,), is_ratio=False)
    assert result(90.0, reference=difference).compared == 20.0


def test_a_missing_measurement_is_in_the_table_with_its_reason():
    """It neither keeps nor breaks its promise."""
    missing = result(promise=at_least(1), note="moviepy is not installed")
    assert missing.is_kept is None
    assert json.dumps(missing.as_json(), allow_nan=False)
    console = Console(width=200)
    with console.capture() as captured:
        console.print(table_of("title", [missing]))
    assert "moviepy is not installed" in captured.get()


def test_the_error_of_a_failed_child_has_its_output():
    setup = {"env_id": "NoSuchThing-v5"}
    with pytest.raises(ChildFailed, match="NoSuchThing"):
        call(stepping.run_episodes, setup=setup, steps=1)


CHEETAH = {"environments": ("HalfCheetah-v5",)}
TINY = {"size": (16, 16)}
SHORT = {"make": {"max_episode_steps": 10, "height": 16, "width": 16}}
ONE_CASE = {"cases": time_to_video.CASES[1:]}
RECORDERS = {"recorders": ("bare", "workers=0")}
EPISODES = {"episodes": 2, "short": 3, "long_episodes": 1, "long": 5}
ONE_VIDEO = {"videos": 1, "frames": 3, "size": 32, "workers": 1}

# Settings, the number or names of the results, and their promises.
MEASURED = {
    "engines": ({"engines": ("local",), "workers": (2,), "jobs": 20}, 3, ("≤ 5",)),
    "starting": ({}, ["mjrec --help", "mjrec list"], ("≤ 0.4", "≤ 0.5")),
    "stepping": (
        {**CHEETAH, **SHORT, "steps": 30, "drawn_steps": 2},
        *(6, ("≥ 0.95", "≥ 0.8")),
    ),
    "time_to_video": (
        {**TINY, **ONE_CASE, "steps": (2,), "workers": 1},
        *(["RecordVideo", "max_fps=30, full quality"], ("≤ 0.3",)),
    ),
    "video_phases": ({**TINY, "steps": (2,), "workers": 1}, None, ()),
    "memory": ({**TINY, **RECORDERS, "short": 2, "long": 4}, None, ("≤ 64", "≤ 4")),
    "rendering": (
        {**CHEETAH, **TINY, "frames": 3},
        ["mujoco.Renderer", "mjrec.render(workers=1)", "worker alone"],
        ("≥ 0.9",),
    ),
    "verifying": (
        {**EPISODES, **ONE_VIDEO},
        *(None, ("≤ 20", "≤ 4.2", "≤ 0.0025", "≤ 1.5")),
    ),
    "evaluating": (
        {"tasks": 1, "episodes": 1, "steps": 2, "bare": (4,)},
        ["1 worker", "2 workers", "2 bare processes", "2 workers"],
        ("≤ 0.588235", "≤ 1.11111"),
    ),
    "reporting": (
        {"episodes": 20, "videos": 2, "many_episodes": 100},
        *(None, ("≤ 3", "≤ 500")),
    ),
    "scaling": (
        {"monitors": (2, 4), "episodes": 2, "tasks": 2, "results": (10, 20)},
        *(None, ("≤ 3", "≤ 30.048")),
    ),
    "disk": ({**CHEETAH, "steps": 10}, 5, ()),
    "encoding": ({**TINY, "frames": 2}, 4, ()),
}


@parametrize("name", MEASURED)
def test_each_measurement_gives_its_results_and_promises(name):
    if name == "evaluating":
        pytest.importorskip("dm_control")
    settings, expected, promises = MEASURED[name]
    module = importlib.import_module(f"benchmarks.{name}")
    results = module.measure(module.Settings(rounds=1, **settings), lambda words: None)
    variants = [r.variant for r in results]
    assert expected in (None, len(variants), variants)
    assert all(r.median > 0 for r in results if r.samples)
    assert {*promises} <= {str(r.promise) for r in results if r.promise}


def test_the_command_lists_measurements_for_an_unknown_name():
    command = [sys.executable, "-m", "benchmarks", "--only", "speed"]
    root = Path(__file__).parents[1]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True)
    assert done.returncode == 2
    assert "stepping" in done.stderr
