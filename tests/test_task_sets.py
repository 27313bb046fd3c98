# SPDX-License-Identifier: Apache-2.0
import sys

import gymnasium
import pytest

from mjrec import EnvironmentNotMade, InvalidArgument, MissingDependency, UnknownName
from mjrec.evaluation.task_sets import TASK_SETS, tasks_from


def test_gymnasium_mujoco_is_the_newest_version_of_each():
    """Eleven environments, all v5 as of Gymnasium 1; a name that is given twice is one.

    Without a version the newest is meant.
    """
    tasks = tasks_from(["gymnasium:mujoco"])
    assert len(tasks) == 11
    assert "HalfCheetah-v5" in tasks
    assert "HalfCheetah-v4" not in tasks
    assert set(tasks) <= set(gymnasium.registry)
    names = ["Hopper-v5", "dm_control/walker-walk", "Hopper", "Ant-v5", "Hopper-v5"]
    assert tasks_from(names) == ("Hopper-v5", "dm_control/walker-walk", "Ant-v5")
    assert tasks_from("No_such") == ("No_such",)


@pytest.mark.thorough
@pytest.mark.dm_control
def test_sets_of_the_suite_are_the_suites_own():
    """Sorted, so that no version of dm_control gives them in another order."""
    from dm_control import suite

    for tag in ("benchmarking", "easy", "hard", "extra"):
        expected = [f"dm_control/{d}-{t}" for d, t in getattr(suite, tag.upper())]
        assert tasks_from([f"dm_control:{tag}"]) == tuple(sorted(expected))
    everything = tasks_from(["dm_control:all"])
    assert len(everything) == len(suite.ALL_TASKS)


@pytest.mark.dm_control
def test_patterns_are_matched_against_both_frameworks():
    """With `*`, `?` and brackets."""
    assert tasks_from(["dm_control/walker-*", "HalfCheetah-v[45]"]) == (
        *("dm_control/walker-run", "dm_control/walker-stand"),
        *("dm_control/walker-walk", "HalfCheetah-v4", "HalfCheetah-v5"),
    )
    assert tasks_from(["Half*"]) == ("HalfCheetah-v5",)
    assert "dm_control/acrobot-swingup" in tasks_from(["*swingup"])


def test_a_pattern_may_name_a_module_that_registers(tmp_path, monkeypatch):
    """It may lie in the working directory, and is not imported here."""
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
def test_an_unknown_set_lists_the_sets(text):
    """Also one of Gymnasium's, whose own module could be meant by a colon."""
    with pytest.raises(UnknownName) as caught:
        tasks_from([text])
    assert all(name in str(caught.value) for name in TASK_SETS)
    assert tasks_from(["gymnasium:Ant-v5"]) == ("gymnasium:Ant-v5",)
    for texts in ([], [""], ["dm_control/walker"]):
        with pytest.raises(InvalidArgument):
            tasks_from(texts)


def test_a_set_without_its_framework_says_what_to_install(tmp_path, monkeypatch):
    """The line for pip, and a pattern that may mean others goes without it."""
    (tmp_path / "dm_control.py").write_text(
        "raise ModuleNotFoundError('No dm_control', name='dm_control')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingDependency, match=r'pip install "mjrec\[dm-control\]"'):
        tasks_from(["dm_control:easy"])
    assert "HalfCheetah-v5" in tasks_from(["*-v5"])
