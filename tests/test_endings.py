# SPDX-License-Identifier: Apache-2.0
"""What an environment raises goes on unchanged, and the recording says it."""

import signal

import gymnasium
import pytest
from other_python import run_python
from recordings import frames_in, in_flight, manifest_of, metadata_of, stats_of

import mjrec
from mjrec import Monitor
from mjrec.recorder.endings import ending


class Breaking(gymnasium.Wrapper):
    """Raises `error` in the step, or at the reset, that is its turn."""

    error: BaseException | None = None

    def step(self, action):
        if self.error is not None:
            raise self.error
        return self.env.step(action)

    def reset(self, **options):
        if self.error is not None:
            raise self.error
        return self.env.reset(**options)


@pytest.fixture(params=["live", "deferred"])
def monitored(request, tmp_path):
    """A pendulum that breaks on demand, and its monitor."""
    env = gymnasium.make(
        "InvertedPendulum-v5", render_mode="rgb_array", height=32, width=48
    )
    broken = Breaking(env)
    return broken, Monitor(
        broken, tmp_path, lambda _: True, render=request.param, workers=1
    )


def steps(monitor, count):
    for _ in range(count):
        monitor.step(monitor.action_space.sample() * 0)


def test_step_that_raises(monitored, tmp_path):
    """What was captured is kept and marked; the exception is the environment's own."""
    broken, monitor = monitored
    monitor.reset(seed=0)
    steps(monitor, 3)
    broken.error = ValueError("the simulation is unstable")
    with pytest.raises(ValueError, match="unstable") as caught:
        steps(monitor, 1)
    assert caught.value is broken.error
    broken.error = None
    monitor.reset(seed=1)
    steps(monitor, 2)
    monitor.close()
    metadata = metadata_of(tmp_path, 0)
    assert (metadata["complete"], metadata["reason"]) == (False, "exception")
    assert metadata["exception"] == {
        "type": "ValueError",
        "message": "the simulation is unstable",
    }
    assert len(frames_in(tmp_path, 0)) == 4
    assert metadata_of(tmp_path, 1)["reason"] == "close"
    assert len(frames_in(tmp_path, 1)) == 3


def test_reset_that_raises(monitored, tmp_path):
    """The episode before it, which was not over, is marked with that."""
    broken, monitor = monitored
    monitor.stats_recorder.allow_early_reset = True
    monitor.reset(seed=0)
    steps(monitor, 2)
    broken.error = RuntimeError("no such level")
    with pytest.raises(RuntimeError, match="no such level"):
        monitor.reset()
    monitor.close()
    metadata = metadata_of(tmp_path, 0)
    assert (metadata["reason"], metadata["exception"]["type"]) == (
        "exception",
        "RuntimeError",
    )
    assert len(frames_in(tmp_path, 0)) == 3


def test_first_reset_that_raises_leaves_a_monitor_that_works(monitored):
    """There is no episode to be marked, and the next reset begins the first."""
    broken, monitor = monitored
    broken.error = RuntimeError("not yet")
    with pytest.raises(RuntimeError, match="not yet"):
        monitor.reset()
    broken.error = None
    monitor.reset(seed=0)
    assert monitor.episode_id == 1
    monitor.close()


def test_step_that_succeeds_the_second_time(monitored, tmp_path):
    """The episode goes on, and nothing is wrong with it."""
    broken, monitor = monitored
    monitor.reset(seed=0)
    steps(monitor, 1)
    broken.error = TimeoutError("again")
    with pytest.raises(TimeoutError):
        steps(monitor, 1)
    broken.error = None
    steps(monitor, 2)
    monitor.close()
    assert metadata_of(tmp_path, 0)["reason"] == "close"
    assert len(frames_in(tmp_path, 0)) == 4


def test_an_exception_that_has_no_text_or_much():
    """Its own __str__ may be what is broken; a message has a bounded length."""

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


def run(code, directory, status, *, under=()):
    return run_python(PROGRAM + code, directory, under=under, status=status)


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
    ],
)
def test_ways_of_ending_a_program(code, status, reason, tmp_path):
    """Without `with`, every file is closed and named, nothing is rendered, and said."""
    done = run(code, tmp_path, status)
    assert done.stderr.count("2 videos pending: mjrec render") == 1
    assert len(stats_of(tmp_path)["episode_lengths"]) == 1
    assert len(manifest_of(tmp_path)["mjrec"]["pending"]) == 2
    assert not list(tmp_path.glob("*.mp4"))
    [trajectory] = [
        mjrec.load_trajectory(path)
        for path in in_flight(tmp_path)
        if "episode000001" in path.name
    ]
    assert trajectory.facts["complete"] is False
    assert trajectory.facts["reason"] == reason
    if reason == "exception":
        assert trajectory.facts["exception"]["message"] == "too far"


def test_a_full_disk_at_exit_is_one_line(tmp_path):
    """No traceback of the interpreter's exit hooks, in which the reason would drown."""
    code = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\n"
    done = run(code, tmp_path, 0)
    assert "File too large" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_hangup_that_is_ignored_stays_ignored(tmp_path):
    """`nohup` asks for it; a SIGTERM closes the files all the same."""
    done = run(
        "os.kill(os.getpid(), signal.SIGHUP)\n"
        "print('still here', flush=True)\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n",
        tmp_path,
        143,
        under=("env", "--ignore-signal=HUP"),
    )
    assert done.stdout == "still here\n"
    assert done.stderr.count("2 videos pending: mjrec render") == 1


def test_a_signal_whose_exception_is_lost_comes_again(tmp_path):
    """Python ignores what finalisers raise, and there is no second SIGTERM."""
    done = run(
        "class Last:\n"
        "    def __del__(self): os.kill(os.getpid(), signal.SIGTERM)\n"
        "Last()\n"
        "import time\n"
        "time.sleep(30)\n",
        tmp_path,
        143,
    )
    assert "2 videos pending" in done.stderr


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(
    "moment", ["states.StateRecorder.end", "recorder.Recorder._end_episode"]
)
def test_the_end_of_an_episode_that_is_interrupted(moment, tmp_path, monkeypatch):
    """Ctrl-C while that is written down: recovery makes it, and the next, complete."""
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=3)
    monitor = Monitor(env, tmp_path, lambda _: True, workers=0)
    monitor.reset(seed=0)
    steps(monitor, 2)
    with monkeypatch.context() as patch:
        patch.setattr(
            f"mjrec.recorder.{moment}",
            lambda *_, **__: signal.raise_signal(signal.SIGINT),
        )
        with pytest.raises(KeyboardInterrupt):
            steps(monitor, 1)
    monitor.reset(seed=0)
    steps(monitor, 3)
    monitor.close()
    mjrec.recover(tmp_path)
    paths = list(tmp_path.glob("*.h5"))
    assert len(paths) == 2
    for facts in (mjrec.load_trajectory(path).facts for path in paths):
        ending = [facts[key] for key in ("complete", "truncated", "length")]
        assert ending == [True, True, 3]
    assert stats_of(tmp_path)["episode_lengths"] == [3, 3]


def test_a_handlers_exception_between_a_step_and_its_row(tmp_path, monkeypatch):
    """The step is not counted and has no row: it is that exception that ended it."""
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=1)
    monitor = Monitor(env, tmp_path, lambda _: True, workers=0)
    monitor.reset(seed=0)

    def handler(*_, **__):
        raise ArithmeticError("the handler's")

    row = "mjrec.recorder.states.StateRecorder.step"
    monkeypatch.setattr(row, handler)
    with pytest.raises(ArithmeticError), monitor:
        steps(monitor, 1)
    [path] = in_flight(tmp_path)
    facts = mjrec.load_trajectory(path).facts
    assert (facts["complete"], facts["reason"]) == (False, "exception")
    assert facts["exception"]["message"] == "the handler's"
    assert stats_of(tmp_path)["episode_lengths"] == []
