# SPDX-License-Identifier: Apache-2.0
import tempfile

import numpy as np
import pytest
from absl.testing import absltest
from recordings import frames_in, journal_of, metadata_of

import mjrec

dm_env = pytest.importorskip("dm_env", reason="dm_env comes with dm_control")

from dm_env import specs, test_utils  # noqa: E402  needs importorskip

pytestmark = pytest.mark.dm_control


class Countdown(dm_env.Environment):
    """An environment of `length` steps that ends with `discount`."""

    def __init__(self, length=3, discount=0.0):
        self.length = length
        self.discount = discount
        self.left = None
        self.closed = 0

    def reset(self):
        self.left = self.length
        return dm_env.restart(self._observation())

    def step(self, action):
        if not self.left:
            return self.reset()
        self.left -= 1
        if self.left:
            return dm_env.transition(0.5, self._observation())
        return dm_env.truncation(0.5, self._observation(), self.discount)

    def observation_spec(self):
        return specs.Array((1,), np.float64)

    def action_spec(self):
        return specs.BoundedArray((1,), np.float64, -1, 1)

    def close(self):
        self.closed += 1

    def _observation(self):
        return np.array([self.left], np.float64)


def zeros(env):
    return np.zeros(env.action_spec().shape)


class ContractTest(test_utils.EnvironmentTestMixin, absltest.TestCase):
    """Apply dm_env's conformance test to the monitor."""

    def make_object_under_test(self):
        directory = tempfile.TemporaryDirectory()
        self.addCleanup(directory.cleanup)
        return mjrec.Monitor(Countdown(), directory.name, video_callable=False)


def test_step_resets_before_the_first_and_after_the_last_step(tmp_path):
    inner = Countdown()
    inner.reset()
    inner.step(np.zeros(1))
    with mjrec.Monitor(inner, tmp_path, video_callable=False) as env:
        assert env.step(zeros(env)).first()
        assert (env.get_total_steps(), env.episode_id) == (0, 1)
        for _ in range(7):
            env.step(zeros(env))
    assert env.get_episode_lengths() == [3, 3]
    assert env.get_episode_rewards() == [1.5, 1.5]
    # A closed monitor still forwards calls, but closes the environment only once.
    env.close()
    assert inner.closed == 1
    assert env.step(zeros(env)).first()
    assert env.episode_id == 2


@pytest.mark.parametrize(("discount", "terminated"), [(0.0, True), (1.0, False)])
def test_early_resets_are_allowed_unless_forbidden(tmp_path, discount, terminated):
    """The last discount distinguishes termination from truncation."""
    inner = Countdown(discount=discount)
    with mjrec.Monitor(inner, tmp_path, video_callable=False) as env:
        env.reset()
        env.step(zeros(env))
        env.reset()
        for _ in range(3):
            env.step(zeros(env))
    assert env.get_episode_lengths() == [3]
    [line] = journal_of(tmp_path)
    assert line["episode_id"] == 1
    assert (line["terminated"], line["truncated"]) == (terminated, not terminated)
    options = {"video_callable": False, "allow_early_reset": False}
    with mjrec.Monitor(Countdown(), tmp_path / "b", **options) as env:
        env.reset()
        env.step(zeros(env))
        with pytest.raises(mjrec.ResetNotAllowed):
            env.reset()


def test_impossible_options_are_errors_and_leave_nothing(tmp_path):
    inner = Countdown()
    with pytest.raises(mjrec.NoPictures, match="video_callable=False"):
        mjrec.Monitor(inner, tmp_path / "new")
    for option, message in (
        ({"camera": 0}, "no physics"),
        ({"episode_info": True}, "info"),
    ):
        with pytest.raises(mjrec.InvalidArgument, match=message):
            mjrec.Monitor(inner, tmp_path / "new", **option)
    assert not (tmp_path / "new").exists()
    assert inner.closed == 0


def test_records_dm_control_and_passes_on_its_attributes(tmp_path):
    suite = pytest.importorskip("dm_control.suite", reason="dm_control not installed")
    task_kwargs = {"random": 0, "time_limit": 0.04}
    cheetah = suite.load("cheetah", "run", task_kwargs=task_kwargs)
    view = {"width": 64, "height": 48}
    with mjrec.Monitor(cheetah, tmp_path, env_id="dm_control/cheetah", **view) as env:
        assert env.physics is cheetah.physics
        assert env.control_timestep() == cheetah.control_timestep()
        with pytest.raises(AttributeError, match="no_such_thing"):
            _ = env.no_such_thing
        for _ in range(5):
            env.step(zeros(env))
    frames = frames_in(tmp_path, 0)
    assert len(frames) == 5
    assert frames[0].shape == (48, 64, 3)
    assert frames[0].std() > 10
    metadata = metadata_of(tmp_path, 0)
    known = "fps playback_speed truncated camera env_id"
    values = ["100", 1.0, True, -1, "dm_control/cheetah"]
    assert [metadata[key] for key in known.split()] == values
    assert metadata["gl_renderer"]
