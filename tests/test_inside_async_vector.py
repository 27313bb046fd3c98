# SPDX-License-Identifier: Apache-2.0
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from gymnasium.vector import AsyncVectorEnv
from parts import parametrize
from recordings import hashes_at
from vector_environments import DISABLED, NEXT_STEP, SAME_STEP, play
from waiting import wait_until

import mjrec
from mjrec.formats.locks import is_locked

_STEPS = 3
_PATIENCE = 90

# A program with two workers, in which one episode of each has ended.
_PROGRAM = """if True:
    import os, signal, sys
    import gymnasium, mjrec
    from gymnasium.vector import AsyncVectorEnv

    directory, context, ending = sys.argv[1:]

    def make():
        env = gymnasium.make("Hopper-v5", max_episode_steps=3, width=64, height=64)
        return mjrec.Monitor(env, directory, resume=True, workers=1)

    if __name__ == "__main__":
        env = AsyncVectorEnv([make, make], context=context)
        print(*(process.pid for process in env.processes), flush=True)
        env.reset(seed=1)
        for _ in range(5):
            env.step(env.action_space.sample())
        if ending == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if ending == "raise":
            raise RuntimeError("enough")
"""


def monitored_hopper(directory):
    """Return what makes a monitored environment, in whichever process."""

    def make():
        # In here, because a spawned process has imported nothing.
        import gymnasium

        import mjrec

        env = gymnasium.make("Hopper-v5", max_episode_steps=3, width=64, height=64)
        return mjrec.Monitor(env, directory, resume=True, render="deferred", workers=1)

    return make


@parametrize(
    ("context", "mode"),
    [("spawn", NEXT_STEP), ("forkserver", SAME_STEP), ("fork", DISABLED)],
)
def test_each_worker_records_its_own(tmp_path, context, mode):
    """Videos are rendered from states, whole, also in daemonic processes."""
    make = monitored_hopper(tmp_path)
    env = AsyncVectorEnv([make, make], context=context, autoreset_mode=mode)
    workers = {process.pid for process in env.processes}
    play(env, _STEPS + 1, seed=3)
    env.close()
    for worker in workers:
        [hashes] = tmp_path.glob(f"*.{worker}.video000000.framehash")
        assert len(hashes_at(hashes)) == _STEPS + 1
        assert hashes.with_suffix(".mp4").exists()
    results = mjrec.load_results(tmp_path)
    assert list(results["episode_lengths"]) == [_STEPS, _STEPS]
    assert not list(tmp_path.glob(".*"))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("context", "ending"), [("fork", "kill"), ("spawn", "kill"), ("fork", "raise")]
)
def test_a_parent_that_is_gone_leaves_nothing_hanging(tmp_path, context, ending):
    """The workers end by themselves, and each video is there or pending."""
    target = tmp_path / "run"
    program = tmp_path / "train.py"
    program.write_text(_PROGRAM)
    command = [sys.executable, str(program), str(target), context, ending]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as parent:
        assert parent.stdout is not None
        workers = [int(pid) for pid in parent.stdout.readline().split()]
        parent.wait(_PATIENCE)
    expected = -signal.SIGKILL if ending == "kill" else 1
    assert parent.returncode == expected
    _wait_for_end(workers)
    # Whoever renders for them ends after them, when it sees that they are gone.
    wait_until(lambda: not [p for p in target.glob(".*.lock") if is_locked(p)])
    mjrec.recover(target)
    for worker in workers:
        [manifest] = target.glob(f"*.manifest.*.{worker}.manifest.json")
        content = manifest.read_text()
        assert f"{worker}.video000000.mp4" in content


def _wait_for_end(pids):
    deadline = time.monotonic() + _PATIENCE
    while left := [pid for pid in pids if _runs(pid)]:
        assert time.monotonic() < deadline, f"{left} go on"
        time.sleep(0.1)


def _runs(pid):
    try:
        # A zombie that nobody has collected is over too.
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
