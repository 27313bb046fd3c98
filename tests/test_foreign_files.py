# SPDX-License-Identifier: Apache-2.0
"""Test that each version of a foreign recording is checked once in a sandbox."""

import os
import shutil

import gymnasium
import pytest
from sound_files import finished
from trajectories_by_hand import write_log

import mjrec
import mjrec.simulation.foreign_files as foreign_files
from mjrec.rendering.recorded_facts import open_for_rendering
from mjrec.simulation.model_trust import directory_digest, note_models


@pytest.fixture
def started(monkeypatch):
    """Return a list that receives the modules started in a sandbox."""
    modules, real = [], foreign_files.Sandbox

    def counted(module, *arguments, **options):
        modules.append(module)
        return real(module, *arguments, **options)

    monkeypatch.setattr(foreign_files, "Sandbox", counted)
    return modules


def test_foreign_file_is_checked_once_until_it_changes(tmp_path, started):
    """A log is not checked, because it contains no compressed data."""
    mjrec.load_trajectory(write_log(tmp_path, 1))
    assert started == []
    path = finished(tmp_path)
    assert mjrec.load_trajectory(path).snapshots
    open_for_rendering(path).close()
    assert len(started) == 1
    os.utime(path, (0, 0))
    mjrec.load_trajectory(path)
    assert len(started) == 2


def test_own_files_start_no_sandbox(tmp_path, started, monkeypatch):
    """A file counts as the user's own if its models are in the user's list."""
    own = tmp_path / "own"
    with mjrec.Monitor(gymnasium.make("InvertedPendulum-v5"), own, workers=0) as env:
        env.reset(seed=1)
        env.step(env.action_space.sample())
    [path] = own.glob("*.h5")
    mjrec.load_trajectory(path)
    assert started == []
    copy = shutil.copytree(own, tmp_path / "copy") / path.name
    mjrec.load_trajectory(copy)
    assert len(started) == 1
    note_models([directory_digest(copy.parent)])
    os.utime(copy, (0, 0))
    mjrec.load_trajectory(copy)
    # Another user has a different list of models.
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "elsewhere"))
    mjrec.load_trajectory(path)
    assert len(started) == 2
