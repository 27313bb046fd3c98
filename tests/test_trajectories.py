# SPDX-License-Identifier: Apache-2.0
"""Test reading recorded episodes as arrays, with the model of each step."""

import gymnasium
import mujoco
import numpy as np
import pytest
from other_python import run_python
from recordings import in_flight

import mjrec
from mjrec.errors import InvalidArgument, UnknownName, UnreadableFile
from mjrec.formats.trajectory_file import finish_trajectory


def record(directory, change=lambda step, model: None, **options):
    """Record twelve steps; return the recording in flight and the expected arrays."""
    env = gymnasium.make("HalfCheetah-v5", max_episode_steps=12)
    options = {"workers": 0, "observations": True, **options}
    monitor = mjrec.Monitor(env, directory, **options)
    model, data = env.unwrapped.model, env.unwrapped.data
    change(0, model)
    monitor.reset(seed=3)  # The next reset replaces this one.
    arrays = {"observations": [monitor.reset(seed=7)[0]], "qpos": [data.qpos.copy()]}
    arrays |= {"actions": [], "rewards": []}
    for step in range(1, 13):
        change(step, model)
        action = np.cos(np.arange(step, step + 6))
        observation, reward, *_ = monitor.step(action)
        values = (observation, data.qpos.copy(), action, reward)
        for name, value in zip(arrays, values, strict=True):
            arrays[name].append(value)
    monitor.close(wait=False)
    [path] = in_flight(directory)
    return path, arrays


def in_both_forms(path):
    """Yield the trajectory loaded in flight, then loaded from the finished file."""
    yield mjrec.load_trajectory(str(path))
    yield mjrec.load_trajectory(finish_trajectory(path))


def test_trajectory_has_all_arrays_in_documented_shapes(tmp_path):
    path, arrays = record(tmp_path, max_fps=10)
    qpos = arrays.pop("qpos")
    for trajectory in in_both_forms(path):
        assert isinstance(trajectory, mjrec.Trajectory)
        assert trajectory.path == path
        assert len(trajectory) == 12
        for name, values in arrays.items():
            np.testing.assert_array_equal(getattr(trajectory, name), values)
        assert trajectory.truncated.tolist() == [False] * 11 + [True]
        assert not trajectory.terminated.any()
        assert trajectory.frame_steps.tolist() == [0, 2, 4, 6, 8, 10, 12]
        assert trajectory.snapshots["geom_xpos"].shape == (7, 9, 3)
        np.testing.assert_array_equal(trajectory.component("qpos"), qpos)
        assert trajectory.component("warmstart").shape == (13, 9)
        np.testing.assert_array_equal(
            trajectory.component("ctrl")[1:], arrays["actions"]
        )
        np.testing.assert_allclose(trajectory.time, np.arange(13) * 0.05)
        assert {"time", "qpos", "qvel", "ctrl"} <= set(trajectory.components)
        with pytest.raises(UnknownName, match=r"no state component 'qqpos'.*qpos"):
            trajectory.component("qqpos")
        assert (trajectory.episode_id, trajectory.seed) == (0, 7)
        environment = {"framework": "gymnasium", "id": "HalfCheetah-v5"}
        assert trajectory.environment.items() >= environment.items()
        assert trajectory.complete
        assert trajectory.dropped == 0
        assert "HalfCheetah-v5, 12 steps" in repr(trajectory)


def test_model_includes_changes_up_to_the_step(tmp_path):
    def change(step, model):
        if step == 0:
            model.opt.gravity[2] = -1.5
        if step in (4, 6):
            model.geom_rgba[:] = step / 8

    for trajectory in in_both_forms(record(tmp_path, change)[0]):
        first = trajectory.model()
        assert first.opt.gravity[2] == -1.5
        shades = [trajectory.model(step=k).geom_rgba[1, 0] for k in (3, 4, 5, 6, -1)]
        assert shades == [first.geom_rgba[1, 0], 0.5, 0.5, 0.75, 0.75]
        assert shades[0] not in (0.5, 0.75)
    data = mujoco.MjData(first)
    trajectory.set_state(data, -1)
    assert data.time == trajectory.time[-1]
    for use in (trajectory.model, lambda step: trajectory.set_state(data, step)):
        for step in (13, -14):
            with pytest.raises(InvalidArgument, match="contains 13 states"):
                use(step)


def test_recording_without_a_simulation_has_rewards_but_no_model(
    tmp_path, corridor, play
):
    with pytest.raises(InvalidArgument, match="without trajectories"):
        mjrec.load_trajectory(tmp_path)
    with mjrec.Monitor(corridor, tmp_path, False, trajectory_callable=True) as env:
        play(env, 1)
    [path] = tmp_path.glob("*.h5")
    trajectory = mjrec.load_trajectory(path)
    assert trajectory.rewards.tolist() == [0.5] * 3
    assert trajectory.time is None
    with pytest.raises(UnreadableFile, match="no MuJoCo simulation"):
        trajectory.model()
    with pytest.raises(InvalidArgument, match=f"Choose one of .*: {path.name}\\."):
        mjrec.load_trajectory(tmp_path)


def test_reading_needs_no_simulator(tmp_path):
    """Arrays can be read without mujoco, but a model cannot."""
    path = finish_trajectory(record(tmp_path)[0])
    code = (
        "import sys; sys.modules.update(mujoco=None, gymnasium=None)\n"
        "import mjrec\n"
        f"t = mjrec.load_trajectory({str(path)!r})\n"
        "print(len(t), t.component('qpos').shape, len(t.snapshots['geom_xpos']))\n"
        "try: t.model()\n"
        "except ModuleNotFoundError as error: print(error.name)\n"
    )
    assert run_python(code).stdout == "12 (13, 9) 13\nmujoco\n"
