# SPDX-License-Identifier: Apache-2.0
"""Recording on a full file system keeps everything from before and after."""

import os
import subprocess

import pytest
from other_python import run_python
from recordings import manifest_of, stats_of

import mjrec

STEPS = 8


@pytest.fixture
def disk(tmp_path):
    """Mount a file system of two megabytes."""
    if os.geteuid() != 0:
        pytest.skip("mounting a small file system takes root")
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "none", str(place)]
    done = subprocess.run(mount, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr}")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


PROGRAM = f"""
import os, signal, sys
import gymnasium, mjrec

disk, room, ending = sys.argv[1], int(sys.argv[2]), sys.argv[3]
env = gymnasium.make("InvertedPendulum-v5", max_episode_steps={STEPS})
monitor = mjrec.Monitor(env, disk + "/run", lambda _: True, workers=0, on_error="warn")

def episode():
    monitor.reset(seed=0)
    for _ in range({STEPS}):
        monitor.step(monitor.action_space.sample() * 0)

episode()
with open(disk + "/filler", "wb") as file:
    free = os.statvfs(disk)
    os.posix_fallocate(file.fileno(), 0, free.f_bavail * free.f_bsize - room)
episode()
episode()
if ending == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
os.unlink(disk + "/filler")
monitor.close(wait=False)
"""


@pytest.mark.parametrize("ending", ["closed", "killed"])
@pytest.mark.parametrize("room", [0, 4096, 65536])
def test_episodes_of_a_full_disk_are_complete(room, ending, disk):
    """Test a monitor that closes once there is room, and one that is killed.

    Rows replace missing journal lines, and no file makes a false claim. Without any
    room the third episode has no file, but closing with room still counts it.
    """
    run_python(PROGRAM, disk, room, ending, status=0 if ending == "closed" else -9)
    (disk / "filler").unlink(missing_ok=True)
    run = disk / "run"
    assert not mjrec.recover(run).failures
    paths = sorted(run.glob("*.h5"))
    counted = 3 if room or ending == "closed" else 2
    assert stats_of(run)["episode_lengths"] == [STEPS] * counted
    assert len(paths) == (3 if room else 2)
    for trajectory in map(mjrec.load_trajectory, paths):
        facts = trajectory.facts
        assert len(trajectory.rewards) == facts["length"] == STEPS
        assert (facts["complete"], facts["truncated"]) == (True, True)
        assert "reason" not in facts
    assert len(manifest_of(run)["mjrec"]["pending"]) == len(paths)
    assert not list(run.glob(".*"))


CUT = """
import contextlib, os, sys
import gymnasium, mjrec, numpy

disk, on_error = sys.argv[1:]
env = gymnasium.make("HalfCheetah-v5", max_episode_steps=200)
monitor = mjrec.Monitor(
    env, disk + "/run", lambda _: True, workers=0, on_error=on_error
)
with open(disk + "/filler", "wb") as file:
    free = os.statvfs(disk)
    room = 400_000
    os.posix_fallocate(file.fileno(), 0, free.f_bavail * free.f_bsize - room)
monitor.reset(seed=0)
for _ in range(200):
    with contextlib.suppress(mjrec.FileNotWritten):
        monitor.step(numpy.ones(6, numpy.float32))
os.unlink(disk + "/filler")
monitor.close(wait=False)
"""


@pytest.mark.parametrize("on_error", ["raise", "warn"])
def test_a_trajectory_without_room_for_its_last_rows_ends_with_them(on_error, disk):
    """Length and reward match the rows, and statistics count the whole episode."""
    run_python(CUT, disk, on_error)
    run = disk / "run"
    mjrec.recover(run)
    [path] = run.glob("*.h5")
    trajectory = mjrec.load_trajectory(path)
    facts, length = trajectory.facts, len(trajectory.rewards)
    assert 0 < length < 200
    assert (facts["complete"], facts["length"]) == (False, length)
    assert facts["reward"] == pytest.approx(sum(trajectory.rewards))
    assert facts["exception"]["type"] == "mjrec.errors.FileNotWritten"
    assert ".log" in facts["broken_reason"]
    assert "truncated" not in facts
    assert stats_of(run)["episode_lengths"] == [200]
    faults = manifest_of(run)["mjrec"]["faults"]
    assert "trajectory" in [fault["what"] for fault in faults]
