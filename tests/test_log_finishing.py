# SPDX-License-Identifier: Apache-2.0
"""Long logs get their final form in a process of their own."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import children
from trajectories_by_hand import write_log

from mjrec import Error, FileNotWritten, UnreadableFile
from mjrec.formats.in_flight import is_in_flight
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.rendering import log_finishing
from mjrec.rendering.log_finishing import finish_log

NAME = "openaigym.trajectory.0.7.episode000000.h5"

# Finishes argv[1], whatever its size, and prints how.
PROGRAM = """
import pathlib, sys
from mjrec.rendering import log_finishing
log_finishing._LARGEST_HERE = 0
print(log_finishing.finish_log(pathlib.Path(sys.argv[1])))
"""


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take every log for a long one, and let nothing be done in this process."""

    def fail(log: Path) -> Path:
        raise AssertionError(log)

    monkeypatch.setattr(log_finishing, "_LARGEST_HERE", 0)
    monkeypatch.setattr(log_finishing, "finish_trajectory", fail)


def test_a_short_log_is_finished_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Starting a process would take longer."""
    monkeypatch.setattr(sys, "executable", "/bin/false")
    assert finish_log(write_log(tmp_path)).exists()


@pytest.mark.usefixtures("no_process_is_left")
@pytest.mark.usefixtures("elsewhere")
def test_a_long_log_is_finished_in_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: Callable[[Path], list[str]]
) -> None:
    """With the same result, which the log makes room for; also by a relative path."""
    write_log(tmp_path, steps=4)
    monkeypatch.chdir(tmp_path)
    finished = finish_log(Path(NAME))
    assert finished == Path(NAME)
    assert names(tmp_path) == [NAME]
    with open_trajectory(finished) as reader:
        assert reader.step_count == 4


@pytest.mark.usefixtures("elsewhere")
def test_errors_come_home(tmp_path: Path) -> None:
    """With their class, their words and their attributes; the log stays."""
    log = write_log(tmp_path)
    [changes] = [path.with_suffix(".looks") for path in tmp_path.glob("*.log")]
    changes.mkdir()
    with pytest.raises(UnreadableFile, match="regular file") as caught:
        finish_log(log)
    assert caught.value.path == changes.with_suffix(".log")
    assert is_in_flight(log)
    changes.rmdir()
    log.mkdir()
    with pytest.raises(FileNotWritten):
        finish_log(log)
    assert is_in_flight(log)


def test_a_log_that_is_not_there(tmp_path: Path) -> None:
    """As `finish_trajectory` has it."""
    with pytest.raises(UnreadableFile):
        finish_log(tmp_path / NAME)


@pytest.mark.usefixtures("elsewhere")
def test_a_process_that_dies_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With how it died; the log stays."""
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\necho last words >&2\nkill -9 $$\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    log = write_log(tmp_path)
    with pytest.raises(Error, match=r"signal 9[^$]*last words"):
        finish_log(log)
    assert is_in_flight(log)


@pytest.mark.usefixtures("no_process_is_left")
@pytest.mark.thorough
@pytest.mark.usefixtures("elsewhere")
def test_a_process_that_hangs_is_ended(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Where it hung is in the log."""
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "if sys.argv[0] == '-m':\n"
        "    import threading\n"
        "    import mjrec.formats.trajectory_file as f\n"
        "    def wait_for_a_disk(log):\n"
        "        threading.Event().wait()\n"
        "    f.finish_trajectory = wait_for_a_disk\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MJREC_PATIENCE", "3")
    log = write_log(tmp_path)
    with pytest.raises(Error, match="did nothing for 3 seconds"):
        finish_log(log)
    assert is_in_flight(log)
    assert "in wait_for_a_disk" in caplog.text


def test_without_another_process_it_is_done_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the system grants none."""
    monkeypatch.setattr(log_finishing, "_LARGEST_HERE", 0)
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    assert finish_log(write_log(tmp_path)).exists()


@pytest.mark.usefixtures("no_process_is_left")
@pytest.mark.usefixtures("elsewhere")
def test_ctrl_c_leaves_no_process_and_no_half_file(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    names: Callable[[Path], list[str]],
) -> None:
    """Where it comes while the process is waited for; the log stays."""

    def interrupted(*_: object) -> Path:
        assert children()
        raise KeyboardInterrupt

    monkeypatch.setattr(log_finishing, "_result", interrupted)
    log = write_log(tmp_path)
    before = names(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        finish_log(log)
    assert names(tmp_path) == before


def test_being_ended_leaves_no_half_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: Callable[[Path], list[str]]
) -> None:
    """SIGTERM in the midst of writing."""
    (tmp_path / "sitecustomize.py").write_text(
        "import os, signal, sys\n"
        "if sys.argv[0] == '-m':\n"
        "    os.fsync = lambda _: signal.raise_signal(signal.SIGTERM)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(log_finishing, "_LARGEST_HERE", 0)
    directory = tmp_path / "recordings"
    directory.mkdir()
    log = write_log(directory)
    before = names(directory)
    with pytest.raises(Error, match="ended with 1"):
        finish_log(log)
    assert names(directory) == before


def _finish_in_daemon(log: Path) -> None:
    log_finishing._LARGEST_HERE = 0
    finish_log(log)


def test_it_works_in_a_daemonic_process(tmp_path: Path) -> None:
    """As workers of vectorised environments are."""
    log = write_log(tmp_path)
    process = multiprocessing.get_context("spawn").Process(
        target=_finish_in_daemon, args=(log,), daemon=True
    )
    process.start()
    process.join(60)
    assert process.exitcode == 0
    assert log.exists()


def test_a_script_without_a_guard_is_not_run_again(tmp_path: Path) -> None:
    """As multiprocessing would."""
    log = write_log(tmp_path)
    script = tmp_path / "script.py"
    script.write_text(PROGRAM)
    done = subprocess.run(
        [sys.executable, script, log], capture_output=True, text=True, check=False
    )
    assert (done.stdout, done.stderr) == (f"{log}\n", "")
