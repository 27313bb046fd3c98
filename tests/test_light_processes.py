# SPDX-License-Identifier: Apache-2.0
"""Commands and modules import no simulator, OpenGL or engine unless needed."""

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
    # Importing mujoco fixes its OpenGL backend.
    (
        "import gymnasium\n"
        "from mjrec.environments.gymnasium_scenes import gymnasium_scenes\n"
        "assert gymnasium_scenes(gymnasium.make('CartPole-v1')).states is None",
        SIMULATORS,
    ),
    # Help and lists must be fast.
    (
        "from mjrec.commands import main\nmain(['--help'])",
        {*SIMULATORS, "tyro", "rich", "numpy", "h5py"},
    ),
    (
        "from mjrec.commands import main\nmain(['list', '.'])",
        {*SIMULATORS, "gymnasium", "h5py", "scipy", "imageio"},
    ),
    # Only the workers of an evaluation load policies and simulators.
    pytest.param(
        "import pathlib, test_evaluating\ntest_evaluating.run(pathlib.Path('e'))",
        SIMULATORS,
        marks=pytest.mark.thorough,
    ),
]


@pytest.mark.parametrize(("code", "unneeded"), CASES)
def test_unneeded_modules_are_not_imported(code, unneeded, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    report = (
        "import atexit, sys\natexit.register(lambda: print('loaded:', *sys.modules))"
    )
    output = run_python("-c", f"{report}\n{code}")
    assert not unneeded & set(output.rpartition("loaded:")[2].split())
