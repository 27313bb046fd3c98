# SPDX-License-Identifier: Apache-2.0
"""The background process, which finishes recordings beside a simulation."""

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import pytest
from parts import parametrize
from processes import children
from recordings import frames_of, in_flight
from trajectories_by_hand import write_log
from waiting import wait_until

from mjrec import Monitor
from mjrec.formats.spans import find_recording, is_in_flight
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.rendering.background import Background

# Submits all recordings of the directory in argv[1], forks, and waits.
PROGRAM = """
import os, pathlib, sys, threading, time
from mjrec.formats.spans import recordings_in_flight
from mjrec.rendering.background import Background
directory = pathlib.Path(sys.argv[1])
background = Background(directory, workers=1)
for recording in recordings_in_flight(directory):
    background.submit(recording.path)
assert threading.active_count() == 1
assert not {'mujoco', 'OpenGL', 'h5py'} & set(sys.modules)
if os.fork() == 0:
    time.sleep(60)
    os._exit(0)
print(background._child.pid, flush=True)
time.sleep(60)
"""


@pytest.fixture
def recorded(tmp_path, play):
    """Two short episodes, still without videos."""
    small = {"width": 40, "height": 32, "max_episode_steps": 3}
    env = gymnasium.make("InvertedPendulum-v5", **small)
    directory = tmp_path / "recorded"
    monitor = Monitor(env, directory, lambda _: True, workers=0, quality="draft")
    play(monitor, 2)
    monitor.close(wait=False)
    return directory


@pytest.fixture
def start(tmp_path):
    """A function that starts backgrounds with recordings; they stop at the end."""
    made = []

    def make(directory=tmp_path, *logs, workers=1):
        made.append(Background(directory, workers=workers))
        for log in logs:
            made[-1].submit(log)
        return made[-1]

    yield make
    for background in made:
        background.stop()


@pytest.fixture
def before():
    """The child processes from before the test."""
    return children()


def patch_child(tmp_path, monkeypatch, code):
    """Let the background process run this code first."""
    lines = "".join(f"    {line}\n" for line in code.splitlines())
    guarded = f"import sys\nif sys.argv[0] == '-m':\n{lines}"
    (tmp_path / "sitecustomize.py").write_text(guarded)
    monkeypatch.syspath_prepend(tmp_path)


def is_finished(log):
    return log.exists() and find_recording(log) is None


def has_ended(pid):
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True
    return stat.rpartition(")")[2].split()[0] == "Z"


def test_one_process_finishes_all_recordings(tmp_path, before, start, monkeypatch):
    """It stays for those after `wait`; without recordings it does not start."""
    background = start()
    background.wait()
    assert children() == before
    for round_ in range(2):
        logs = [write_log(tmp_path, 10 * round_ + k, video=None) for k in range(3)]
        for log in logs:
            background.submit(log)
        background.wait()
        assert all(map(is_finished, logs))
        assert (list(background.waiting), background.failures) == ([], {})
        [process] = children() - before
        # Ctrl-C in the terminal does not reach it, and its priority is low.
        assert os.getsid(process) == process
        assert os.getpriority(os.PRIO_PROCESS, process) == 10
    background.stop()
    assert children() == before


def test_submitting_never_waits(before, tmp_path, start):
    """The process is stopped here, and the names fill more than a pipe."""
    log = write_log(tmp_path, video=None)
    background = start(tmp_path, log)
    [process] = children() - before
    os.kill(process, signal.SIGSTOP)
    for number in range(1, 3000):
        background.submit(tmp_path / f"{log.stem[:-6]}{number:06d}.h5")
    os.kill(process, signal.SIGCONT)
    background.wait()
    assert list(background.waiting) == []
    assert is_finished(log)


def test_a_recording_waits_until_its_model_is_written(recorded, start):
    """After `wait`, a missing model is a failure."""
    [model] = recorded.glob("*.mjb.gz")
    hidden = model.rename(model.with_name("hidden"))
    first, second = in_flight(recorded)
    background = start(recorded, first)
    assert not list(recorded.glob("*.mp4"))
    hidden.rename(model)
    background.wait()
    assert background.failures == {}
    for each in recorded.glob("*.model.*"):
        each.unlink()
    background.submit(second)
    background.wait()
    [reason] = background.failures.values()
    assert "model" in reason
    assert len(list(recorded.glob("*.mp4"))) == 1


# Ends


def test_stopping_keeps_unfinished_recordings(recorded, before, start, stuck_encoder):
    """It takes effect within a video and leaves no process or temporary file."""
    logs = in_flight(recorded)
    background = start(recorded, *logs)
    wait_until(stuck_encoder.exists)
    began = time.monotonic()
    background.stop()
    assert time.monotonic() - began < 3
    background.stop()
    assert children() == before
    assert not list(recorded.glob("*.meta.json"))
    assert not list(recorded.glob(".*"))
    late = write_log(recorded, video=None)
    background.submit(late)
    background.wait()
    assert is_in_flight(late)
    assert background.failures == {}
    assert all(log.exists() or is_in_flight(log) for log in logs)


@parametrize("signum", [signal.SIGKILL, signal.SIGSEGV])
def test_a_dead_process_is_replaced(before, signum, recorded, start, caplog):
    """All videos are complete, and the log has the signal.

    SIGKILL arrives during a video, SIGSEGV before any work.
    """
    background = start(recorded, *in_flight(recorded))
    [process] = children() - before
    if signum == signal.SIGKILL:
        wait_until(lambda: list(recorded.glob(".*.mp4.*.part")))
    os.kill(process, signum)
    if signum == signal.SIGKILL:
        wait_until(functools.partial(has_ended, process))
    background.wait()
    assert background.failures == {}
    assert [len(frames_of(video)) for video in recorded.glob("*.mp4")] == [4, 4]
    assert signum.name in caplog.text
    background.stop()
    assert not list(recorded.glob(".*"))
    assert children() == before


def test_after_the_second_death_all_recordings_fail(before, tmp_path, start, caplog):
    """The failure has the signal, and no process starts again."""
    logs = [write_log(tmp_path, k, model={"mjb": "none"}) for k in range(3)]
    background = start(tmp_path, *logs[:2])
    for _ in range(2):
        [process] = children() - before
        os.kill(process, signal.SIGKILL)
        wait_until(functools.partial(has_ended, process))
        background.submit(logs[2])
    background.wait()
    assert list(background.failures) == [log.name for log in logs]
    assert "killed by SIGKILL" in background.failures[logs[2].name]
    assert caplog.text.count("SIGKILL") == 2
    background.submit(write_log(tmp_path, 3))
    background.wait()
    assert len(background.failures) == 4
    assert children() == before


HANGING = """
import subprocess, threading
def wait_for_a_disk_that_does_not_answer(*a, **k):
    child = subprocess.Popen(['sleep', '60'], start_new_session=True)
    open({pids!r}, 'a').write(f'{{child.pid}}\\n')
    threading.Lock().acquire() and threading.Event().wait()
import mjrec.rendering.finisher as f
f.finish_trajectory = wait_for_a_disk_that_does_not_answer
"""
SLOW = """
import time
import mjrec.rendering.finisher as f
finish = f.finish_trajectory
def slowly(log):
    for _ in range(40):
        time.sleep(0.1)
    return finish(log)
f.finish_trajectory = slowly
"""


@pytest.mark.thorough
def test_a_process_at_work_does_not_hang(tmp_path, start, monkeypatch):
    """One step may take several times the timeout."""
    patch_child(tmp_path, monkeypatch, SLOW)
    monkeypatch.setenv("MJREC_TIMEOUT", "0.7")
    log = write_log(tmp_path, video=None)
    background = start(tmp_path, log)
    background.wait()
    assert background.failures == {}
    assert is_finished(log)


@pytest.mark.thorough
def test_a_process_that_hangs_is_killed_with_its_children(
    before, tmp_path, start, caplog, monkeypatch
):
    """The log has its threads' stacks, and another process tries."""
    pids = tmp_path / "pids"
    patch_child(tmp_path, monkeypatch, HANGING.format(pids=str(pids)))
    monkeypatch.setenv("MJREC_TIMEOUT", "0.7")
    log = write_log(tmp_path, video=None)
    background = start(tmp_path, log)
    background.wait()
    assert "hung for 2.1 seconds" in background.failures[log.name]
    assert "in wait_for_a_disk_that_does_not_answer" in caplog.text
    assert caplog.text.count("Its threads' stacks") == 2
    assert is_in_flight(log)
    started = [int(pid) for pid in pids.read_text().split()]
    assert len(started) == 2
    wait_until(lambda: all(map(has_ended, started)))
    assert children() == before


def test_workers_are_forks_and_a_dead_one_is_replaced(recorded, before, start, caplog):
    """Forks share imports; they end even when the process is killed."""
    background = start(recorded, workers=2)
    for victim in ("a worker", "the process"):
        background.expect()
        [process] = children() - before
        wait_until(lambda: len(children(process)) == 2)  # noqa: B023  called at once
        commands = {
            Path(f"/proc/{pid}/cmdline").read_bytes()
            for pid in (process, *children(process))
        }
        assert len(commands) == 1
        workers = children(process)
        os.kill(min(workers) if victim == "a worker" else process, signal.SIGKILL)
        background.submit(in_flight(recorded)[0])
        background.wait()
        assert background.failures == {}
        if victim == "a worker":
            assert "A render worker died and is being replaced" in caplog.text
            background.stop()
            background = start(recorded, workers=2)
        wait_until(lambda: all(map(has_ended, workers)))  # noqa: B023  called at once
    assert "it was killed by SIGKILL" in caplog.text
    assert [len(frames_of(video)) for video in recorded.glob("*.mp4")] == [4, 4]


def test_the_only_worker_renders_with_one_thread(recorded, before, start, monkeypatch):
    """Mesa's rasterizer would start a thread for each CPU."""
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    background = start(recorded, in_flight(recorded)[0], workers=1)
    [process] = children() - before
    background.wait()
    [worker] = children(process)
    environ = Path(f"/proc/{worker}/environ").read_bytes().split(b"\0")
    assert b"LP_NUM_THREADS=0" in environ
    names = [file.read_text() for file in Path(f"/proc/{worker}/task").glob("*/comm")]
    assert not [name for name in names if name.startswith("llvmpipe")]


def test_the_process_ends_when_its_parent_is_killed(tmp_path):
    """The parent has forked a child that lives on.

    The parent needs no thread for it, and no library that renders or writes HDF5.
    """
    log = write_log(tmp_path, model={"mjb": "none"})
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(tmp_path)],
        stdout=subprocess.PIPE,
        start_new_session=True,
    ) as program:
        process = int(program.stdout.readline())
        program.kill()
        program.wait()
        wait_until(lambda: has_ended(process))
        # Kill the forked child.
        os.killpg(program.pid, signal.SIGKILL)
    with open_trajectory(log) as reader:
        assert reader.step_count == 4
