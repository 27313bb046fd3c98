# SPDX-License-Identifier: Apache-2.0
"""Test importing trackers, and the text of `monitor.csv`."""

import dataclasses
import json
import math
import time

import numpy as np
import pytest
from finished_files import episode
from full_disk import file_size_limit
from other_python import run_python

import mjrec.trackers
from mjrec.errors import DirectoryNotWritable, FileNotWritten, InvalidArgument
from mjrec.trackers import MonitorCsvTracker, Run


def test_import_loads_no_service_package():
    answer = run_python(
        "import sys; from mjrec.trackers import *; "
        "print([m for m in ('tensorboard', 'wandb', 'google') if m in sys.modules])"
    )
    assert answer.stdout.split() == ["[]"]
    with pytest.raises(AttributeError, match="no attribute 'Neptune'"):
        _ = mjrec.trackers.Neptune
    with pytest.raises(InvalidArgument, match="not a run and project, tags"):
        mjrec.trackers.WandbTracker(object(), project="p", tags=["a"])


@pytest.mark.parametrize(
    ("package", "call"),
    [
        ("tensorboard", "TensorBoardTracker('logs')"),
        ("wandb", "WandbTracker(mode='offline')"),
    ],
)
def test_missing_package_names_the_extra(package, call, tmp_path):
    code = f"import sys\nsys.modules[{package!r}] = None\n"
    code += f"import mjrec.trackers as t\nt.{call}"
    error = run_python(code, cwd=tmp_path, status=1).stderr
    assert "mjrec.errors.MissingDependency" in error
    assert f"{package}, which is not installed. Run: pip install" in error
    assert f'"mjrec[{package}]"' in error
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def run(tmp_path):
    return Run(directory=tmp_path / "recordings", infix="0.4711", env_id="Hopper-v5")


def test_header_and_rows(run):
    """Times are relative to the time in the header, and rewards are exact."""
    before = time.time()
    tracker = MonitorCsvTracker()
    tracker.begin(run)
    tracker.episode(run, episode(reward=np.float32(0.1), length=np.int64(7)))
    tracker.episode(run, episode(reward=math.nan))
    tracker.episode(run, episode(reward=-math.inf, end_time=before + 100))
    tracker.end(run)
    path = run.directory / "openaigym.results.0.4711.monitor.csv"
    header, columns, *rows = path.read_text().splitlines()
    start = json.loads(header.removeprefix("#"))
    assert start["env_id"] == "Hopper-v5"
    assert before <= start["t_start"] <= time.time()
    assert columns == "r,l,t"
    cells = [row.split(",") for row in rows]
    assert [(r, length) for r, length, _ in cells] == [
        (str(float(np.float32(0.1))), "7"),
        ("nan", "10"),
        ("-inf", "10"),
    ]
    assert float(cells[2][2]) == pytest.approx(before + 100 - start["t_start"])


def test_each_run_has_its_own_file(run, tmp_path, monkeypatch):
    """A relative path is resolved when the tracker is created."""
    (tmp_path / "logs").mkdir()
    monkeypatch.chdir(tmp_path)
    tracker = MonitorCsvTracker("logs")
    monkeypatch.chdir(tmp_path / "logs")
    runs = [dataclasses.replace(run, env_index=i, infix=f"{i}.4711") for i in range(2)]
    for each in runs:
        tracker.begin(each)
    for number, each in enumerate(reversed(runs)):
        tracker.episode(each, episode(number))
        tracker.end(each)
    texts = [path.read_text() for path in sorted((tmp_path / "logs").iterdir())]
    assert [text.splitlines()[2].split(",")[0] for text in texts] == ["1.5", "0.0"]


@pytest.mark.parametrize(
    ("path", "made"),
    [
        ("logs/a", {"a.1.monitor.csv", "a.2.monitor.csv", "a.monitor.csv"}),
        ("logs/monitor.csv", {"1.monitor.csv", "2.monitor.csv", "monitor.csv"}),
    ],
)
def test_existing_files_are_never_written_to(run, path, made, tmp_path):
    """The tracker uses the next free name that Stable-Baselines3 would find."""
    first = tmp_path / "logs" / max(made)
    first.parent.mkdir()
    first.write_text("precious")
    for _ in range(2):
        tracker = MonitorCsvTracker(tmp_path / path)
        tracker.begin(run)
        tracker.end(run)
    assert {path.name for path in first.parent.iterdir()} == made
    assert first.read_text() == "precious"
    with pytest.raises(DirectoryNotWritable, match="monitor"):
        MonitorCsvTracker(first / "a").begin(run)


def test_full_disk_is_an_error_and_tears_no_row(run):
    """Half a row would be read as a different, valid row."""
    tracker = MonitorCsvTracker()
    tracker.begin(run)
    [path] = run.directory.iterdir()
    whole = path.read_text()
    with (
        file_size_limit(len(whole) + 3),
        pytest.raises(FileNotWritten, match=r"monitor\.csv"),
    ):
        tracker.episode(run, episode())
    assert path.read_text() == whole
    tracker.episode(run, episode(4))
    tracker.end(run)
    assert path.read_text().splitlines()[2].startswith("6.0,10,")
