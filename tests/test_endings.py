# SPDX-License-Identifier: Apache-2.0
"""Test that recordings say how they ended and that exceptions are not changed."""

import signal

import gymnasium
import pytest
from other_python import run_python
from recordings import frames_in, in_flight, manifest_of, metadata_of, stats_of

import mjrec
from mjrec import Monitor
from mjrec.recorder.endings import ending


class Breaking(gymnasium.Wrapper):
    """A wrapper that raises `error` in the next step or reset."""

    error = None

    def step(self, action):
        self._break()
        return self.env.step(action)

    def reset(self, **options):
        self._break()
        return self.env.reset(**options)

    def _break(self):
        if self.error is not None:
            error, self.error = self.error, None
            raise error


def pendulum(steps=None):
    view = {"render_mode": "rgb_array", "height": 32, "width": 48}
    return gymnasium.make("InvertedPendulum-v5", max_episode_steps=steps, **view)


@pytest.fixture(params=["live", "deferred"])
def monitored(request, tmp_path):
    """Return a pendulum that raises errors on demand, and its monitor."""
    env = Breaking(pendulum())
    options = {"render": request.param, "workers": 1, "allow_early_reset": True}
    return env, Monitor(env, tmp_path, lambda _: True, **options)


def steps(monitor, count):
    for _ in range(count):
        monitor.step(monitor.action_space.sample() * 0)


def test_failing_step_ends_its_episode_unless_it_goes_on(monitored, tmp_path):
    """The video keeps its frames, and its metadata contains the exception."""
    env, monitor = monitored
    for seed in range(2):
        monitor.reset(seed=seed)
        steps(monitor, 2)
        env.error = error = ValueError("the simulation is unstable")
        with pytest.raises(ValueError, match="unstable") as caught:
            steps(monitor, 1)
        assert caught.value is error
    # The second episode continues after the exception, so it is not marked as failed.
    steps(monitor, 2)
    monitor.close()
    metadata = metadata_of(tmp_path, 0)
    assert (metadata["complete"], metadata["reason"]) == (False, "exception")
    exception = {"type": "ValueError", "message": "the simulation is unstable"}
    assert metadata["exception"] == exception
    assert metadata_of(tmp_path, 1)["reason"] == "close"
    assert [len(frames_in(tmp_path, number)) for number in (0, 1)] == [3, 5]


def test_failing_reset_marks_the_unfinished_episode(monitored, tmp_path):
    env, monitor = monitored
    for _ in range(2):
        env.error = RuntimeError("no such level")
        with pytest.raises(RuntimeError, match="no such level"):
            monitor.reset()
        if monitor.episode_id == 0:
            monitor.reset(seed=0)
            steps(monitor, 2)
    assert monitor.episode_id == 1
    monitor.close()
    metadata = metadata_of(tmp_path, 0)
    assert metadata["reason"] == "exception"
    assert metadata["exception"]["type"] == "RuntimeError"
    assert len(frames_in(tmp_path, 0)) == 3


def test_exception_messages_may_fail_and_are_shortened():
    class Mute(Exception):
        def __str__(self):
            raise RuntimeError

    assert ending(Mute())["exception"]["message"] == ""
    assert ending(mjrec.Error("x" * 2000))["exception"] == {
        "type": "mjrec.errors.Error",
        "message": "x" * 1000,
    }


PROGRAM = """
import os, signal, sys, gymnasium, mjrec
mjrec.exit_on_signals()
env = gymnasium.make("InvertedPendulum-v5", height=32, width=48)
env = mjrec.Monitor(env, sys.argv[1], lambda _: True, workers=0)
for seed in range(2):
    env.reset(seed=seed)
    done = False
    while not done and (seed == 0 or env.stats_recorder.steps < 3):
        done = env.step(env.action_space.high * (1 - seed))[2]
"""


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(
    ("code", "status", "reason"),
    [
        ("os.kill(os.getpid(), signal.SIGTERM)", 143, "interrupt"),
        ("os.kill(os.getpid(), signal.SIGHUP)", 129, "interrupt"),
        ("os.kill(os.getpid(), signal.SIGINT)", -signal.SIGINT, "interrupt"),
        ("raise OverflowError('too far')", 1, "exception"),
        ("sys.exit(7)", 7, "close"),
        ("", 0, "close"),
        # Python ignores exceptions in finalizers, and no second SIGTERM follows.
        (
            "class Last:\n"
            "    def __del__(self): os.kill(os.getpid(), signal.SIGTERM)\n"
            "Last()\n"
            "import time; time.sleep(30)",
            *(143, "interrupt"),
        ),
    ],
)
def test_program_closes_its_files_however_it_ends(code, status, reason, tmp_path):
    """The program renders nothing while it exits, but reports the pending videos."""
    done = run_python(PROGRAM + code, tmp_path, status=status)
    assert done.stderr.count("2 videos pending: mjrec render") == 1
    assert len(stats_of(tmp_path)["episode_lengths"]) == 1
    assert len(manifest_of(tmp_path)["mjrec"]["pending"]) == 2
    assert not list(tmp_path.glob("*.mp4"))
    facts = mjrec.load_trajectory(in_flight(tmp_path)[-1]).facts
    assert (facts["episode_id"], facts["complete"]) == (1, False)
    assert facts["reason"] == reason
    if reason == "exception":
        assert facts["exception"]["message"] == "too far"


def test_full_disk_at_exit_prints_no_traceback(tmp_path):
    code = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\n"
    done = run_python(PROGRAM + code, tmp_path, status=0)
    assert "File too large" in done.stderr
    assert "Traceback" not in done.stderr


def test_ignored_hangup_stays_ignored(tmp_path):
    """`nohup` ignores SIGHUP; SIGTERM must still close the files."""
    code = (
        "os.kill(os.getpid(), signal.SIGHUP)\n"
        "print('still here', flush=True)\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    ignoring = ("env", "--ignore-signal=HUP")
    done = run_python(PROGRAM + code, tmp_path, status=143, under=ignoring)
    assert done.stdout == "still here\n"
    assert done.stderr.count("2 videos pending: mjrec render") == 1


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(
    "moment", ["states.StateRecorder.end", "recorder.Recorder._end_episode"]
)
def test_episode_interrupted_at_its_end_is_recovered(moment, tmp_path, monkeypatch):
    """Ctrl-C arrives while the monitor records the end of the episode."""
    monitor = Monitor(pendulum(3), tmp_path, lambda _: True, workers=0)
    monitor.reset(seed=0)
    steps(monitor, 2)
    with monkeypatch.context() as patch:
        interrupt = lambda *_, **__: signal.raise_signal(signal.SIGINT)  # noqa: E731
        patch.setattr(f"mjrec.recorder.{moment}", interrupt)
        with pytest.raises(KeyboardInterrupt):
            steps(monitor, 1)
    monitor.reset(seed=0)
    steps(monitor, 3)
    monitor.close()
    mjrec.recover(tmp_path)
    paths = sorted(tmp_path.glob("*.h5"))
    for facts in (mjrec.load_trajectory(path).facts for path in paths):
        ending = [facts[key] for key in ("complete", "truncated", "length")]
        assert ending == [True, True, 3]
    assert stats_of(tmp_path)["episode_lengths"] == [3, 3]
    assert len(paths) == 2
