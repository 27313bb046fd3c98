# SPDX-License-Identifier: Apache-2.0
"""Processes load no simulator, no OpenGL and no engine that they do not need."""

import pytest
from engine_runs import run_python

SIMULATORS = {"mujoco", "dm_control", "OpenGL"}
CASES = [
    (
        "import mjrec.engines.jobs, mjrec.engines.child, mjrec.engines.choice",
        {*SIMULATORS, "numpy", "h5py", "ray", "submitit"},
    ),
    ("import mjrec.engines.ray, mjrec.engines.slurm", {"ray", "submitit"}),
    (
        "from mjrec.evaluation.task_sets import tasks_from\n"
        "tasks_from(['gymnasium:mujoco'])",
        {*SIMULATORS, "gymnasium"},
    ),
    # Importing mujoco settles its OpenGL backend.
    (
        "import gymnasium\n"
        "from mjrec.environments.gymnasium_scenes import gymnasium_scenes\n"
        "assert gymnasium_scenes(gymnasium.make('CartPole-v1')).states is None",
        SIMULATORS,
    ),
    # So that help is there at once, and a list nearly so.
    (
        "from mjrec.commands import main\nmain(['--help'])",
        {*SIMULATORS, "tyro", "rich", "numpy", "h5py"},
    ),
    (
        "from mjrec.commands import main\nmain(['list', '.'])",
        {*SIMULATORS, "gymnasium", "h5py", "scipy", "imageio"},
    ),
    # What hands out an evaluation; a policy's memory is the workers'.
    pytest.param(
        "import pathlib, test_evaluating\ntest_evaluating.run(pathlib.Path('e'))",
        SIMULATORS,
        marks=pytest.mark.thorough,
    ),
]


@pytest.mark.parametrize(("code", "unneeded"), CASES)
def test_what_is_not_needed_is_not_loaded(code, unneeded, tmp_path, monkeypatch):
    """Each in a process of its own."""
    monkeypatch.chdir(tmp_path)
    begin = (
        "import atexit, sys\natexit.register(lambda: print('loaded:', *sys.modules))"
    )
    said = run_python("-c", f"{begin}\n{code}")
    assert not unneeded & set(said.rpartition("loaded:")[2].split())
