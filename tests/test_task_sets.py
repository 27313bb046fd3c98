# SPDX-License-Identifier: Apache-2.0
import sys

import gymnasium
import pytest

from mjrec import EnvironmentNotMade, InvalidArgument, MissingDependency, UnknownName
from mjrec.evaluation.task_sets import TASK_SETS, tasks_from


def test_sets_and_names_without_version_give_the_newest():
    """Duplicates are dropped."""
    tasks = tasks_from(["gymnasium:mujoco"])
    assert len(tasks) == 11
    assert "HalfCheetah-v5" in tasks
    assert "HalfCheetah-v4" not in tasks
    assert set(tasks) <= set(gymnasium.registry)
    names = ["Hopper-v5", "dm_control/walker-walk", "Hopper", "Ant-v5", "Hopper-v5"]
    assert tasks_from(names) == ("Hopper-v5", "dm_control/walker-walk", "Ant-v5")
    assert tasks_from("No_such") == ("No_such",)
    assert tasks_from(["gymnasium:Ant-v5"]) == ("gymnasium:Ant-v5",)


@pytest.mark.thorough
@pytest.mark.dm_control
def test_sets_of_the_suite_are_sorted():
    """Versions of dm_control have them in different orders."""
    from dm_control import suite

    for tag in ("benchmarking", "easy", "hard", "extra"):
        expected = [f"dm_control/{d}-{t}" for d, t in getattr(suite, tag.upper())]
        assert tasks_from([f"dm_control:{tag}"]) == tuple(sorted(expected))
    everything = tasks_from(["dm_control:all"])
    assert len(everything) == len(suite.ALL_TASKS)


@pytest.mark.dm_control
def test_patterns_match_both_frameworks():
    assert tasks_from(["dm_control/walker-*", "HalfCheetah-v[45]"]) == (
        *("dm_control/walker-run", "dm_control/walker-stand"),
        *("dm_control/walker-walk", "HalfCheetah-v4", "HalfCheetah-v5"),
    )
    assert tasks_from(["Half*"]) == ("HalfCheetah-v5",)
    assert "dm_control/acrobot-swingup" in tasks_from(["*swingup"])


def test_patterns_can_name_a_registering_module(tmp_path, monkeypatch):
    """A module of the working directory is imported in another process."""
    (tmp_path / "their_environments.py").write_text(
        "import gymnasium\n"
        "gymnasium.register('Theirs-v0', 'gymnasium.envs.mujoco:HopperEnv')\n"
    )
    (tmp_path / "my_environments.py").write_text(
        "import gymnasium, their_environments\n"
        "for n in (0, 1, 10):\n"
        "    gymnasium.register(f'Mine-v{n}', 'gymnasium.envs.mujoco:HopperEnv')\n"
    )
    monkeypatch.chdir(tmp_path)
    assert tasks_from(["my_environments:Mine-v[01]", "my_environments:*"]) == (
        *("my_environments:Mine-v0", "my_environments:Mine-v1"),
        "my_environments:Mine-v10",
    )
    assert tasks_from("my_environments:Mine") == ("my_environments:Mine-v10",)
    with pytest.raises(UnknownName, match="Mine-v10"):
        tasks_from(["my_environments:Hopper*"])
    assert "my_environments" not in sys.modules
    with pytest.raises(EnvironmentNotMade, match="No module named 'no_such'"):
        tasks_from(["no_such:Mine-v*"])


@pytest.mark.parametrize("text", ["dm_control:bench", "gymnasium:atari", "Halv*"])
def test_unknown_set_lists_the_sets(text):
    with pytest.raises(UnknownName) as caught:
        tasks_from([text])
    assert all(name in str(caught.value) for name in TASK_SETS)


@pytest.mark.parametrize("texts", [[], [""], ["dm_control/walker"]])
def test_empty_and_incomplete_names_are_refused(texts):
    with pytest.raises(InvalidArgument):
        tasks_from(texts)


def test_missing_framework_says_what_to_install(tmp_path, monkeypatch):
    """Patterns that match other environments work without it."""
    (tmp_path / "dm_control.py").write_text(
        "raise ModuleNotFoundError('No dm_control', name='dm_control')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingDependency, match=r'pip install "mjrec\[dm-control\]"'):
        tasks_from(["dm_control:easy"])
    assert "HalfCheetah-v5" in tasks_from(["*-v5"])
