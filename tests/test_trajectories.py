# SPDX-License-Identifier: Apache-2.0
"""Recorded episodes are read back as arrays, and replayed bit for bit."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from other_python import run_python
from trajectories_by_hand import INFIX, add_row, new_logs

import mjrec
from mjrec.errors import InvalidArgument, UnknownName, UnreadableFile
from mjrec.formats.monitor_directory import trajectory_prefix
from mjrec.formats.trajectory import ModelChange, packed, row_dtype
from mjrec.formats.trajectory_file import finish_trajectory
from mjrec.simulation.model_store import ModelStore
from mjrec.simulation.states import STATE_SPEC, state_dtype

HALF_CHEETAH = (
    Path(gymnasium.__file__).parent / "envs/mujoco/assets/half_cheetah.xml"
).read_text()

# Without the solver's warm start the next step is another one: a heap, few iterations.
HEAP = """
<mujoco>
  <option iterations="3" solver="CG" timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body pos="0 0 .2"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
    <body pos=".05 0 .4"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
    <body name="arm" pos="0 .05 .6">
      <joint name="turn" axis="0 1 0"/><geom type="box" size=".1 .1 .1"/>
    </body>
  </worldbody>
  <actuator><general joint="turn" dyntype="filter" dynprm=".1" gainprm="5"/></actuator>
</mujoco>
"""
MODELS = {"half_cheetah": HALF_CHEETAH, "heap": HEAP}

SUBSTEPS = 5
SNAPSHOT = packed([("geom_xpos", ("<f8", (2, 3)))])


def state(model, data):
    row = np.empty(mujoco.mj_stateSize(model, STATE_SPEC))
    mujoco.mj_getState(model, data, row, STATE_SPEC)
    return row


class Recording:
    """The log of an episode with random controls, as a recorder writes it.

    A frame is taken after every second step; changes are of the model, by steps.
    """

    def __init__(self, directory, model, *, steps=12, changes=None, **facts):
        self.states = []
        self.actions = np.random.default_rng(5).uniform(-1, 1, (steps, model.nu))
        store = ModelStore(directory)
        known = {"model": store.add(model), "env_id": "Heap-v0", **facts}
        dtype = row_dtype(
            state=state_dtype(model),
            snapshot=SNAPSHOT,
            action=np.dtype(("<f8", (model.nu,))),
            observation=np.dtype(("<f4", (3,))),
        )
        store.finish()
        logs = new_logs(directory)
        name = trajectory_prefix(INFIX, 3)
        self.path = logs.path_of(name)
        self._span = logs.begin(name, known, dtype)
        self._changes = changes or {}
        self._simulate(model, steps)
        self._span.end({"complete": True})
        logs.close()

    def _simulate(self, model, steps):
        data = mujoco.MjData(model)
        # As a reset that lets things settle: it leaves a warm start behind.
        mujoco.mj_step(model, data, nstep=40)
        self._add(model, data, 0)
        for step in range(1, steps + 1):
            data.ctrl[:] = self.actions[step - 1]
            mujoco.mj_step(model, data, nstep=SUBSTEPS)
            self._add(model, data, step)

    def _add(self, model, data, step):
        if step in self._changes:
            fields = {k: np.asarray(v) for k, v in self._changes[step].items()}
            self._span.log.add_change(ModelChange(step=step, fields=fields))
        self.states.append(state(model, data))
        values = {"state": self.states[-1], "action": self.actions[max(step - 1, 0)]}
        if step % 2 == 0:
            values["snapshot"] = np.full(6, step, np.float64).view(np.uint64)
        ending = {"reward": 0.5 * step, "terminated": step == 12}
        add_row(self._span, step, observation=step, **values, **ending)


def model_of(name):
    return mujoco.MjModel.from_xml_string(MODELS[name])


def finished(recording):
    return finish_trajectory(recording.path)


def as_is(recording):
    return recording.path


@pytest.mark.parametrize("form", [as_is, finished])
def test_everything_is_there_as_arrays(tmp_path, form):
    """In flight and in the finished file alike, with the documented shapes."""
    environment = {"framework": "gymnasium", "id": "Heap-v0", "kwargs": {}}
    facts = {"episode_id": 3, "seed": 7, "environment": environment}
    recording = Recording(tmp_path, model_of("heap"), **facts)
    trajectory = mjrec.load_trajectory(str(form(recording)))
    assert trajectory.path == form(recording)
    assert isinstance(trajectory, mjrec.Trajectory)
    assert len(trajectory) == 12
    np.testing.assert_array_equal(trajectory.states, recording.states)
    np.testing.assert_array_equal(trajectory.actions, recording.actions)
    np.testing.assert_array_equal(trajectory.rewards, 0.5 * np.arange(1, 13))
    assert trajectory.terminated.tolist() == [False] * 11 + [True]
    assert not trajectory.truncated.any()
    np.testing.assert_array_equal(
        trajectory.observations,
        np.repeat(np.arange(13, dtype=np.float32), 3).reshape(13, 3),
    )
    assert trajectory.frame_steps.tolist() == [0, 2, 4, 6, 8, 10, 12]
    np.testing.assert_array_equal(
        trajectory.snapshots["geom_xpos"][:, 1, 2], trajectory.frame_steps
    )
    assert trajectory.snapshots["geom_xpos"].shape == (7, 2, 3)
    assert (trajectory.episode_id, trajectory.seed) == (3, 7)
    assert (trajectory.env_id, trajectory.environment) == ("Heap-v0", environment)
    assert trajectory.complete
    assert trajectory.dropped == 0
    assert "Heap-v0, 12 steps" in repr(trajectory)


def test_states_are_told_by_component(tmp_path):
    """By MuJoCo's names; another name is an error that lists them."""
    model = model_of("heap")
    trajectory = mjrec.load_trajectory(Recording(tmp_path, model).path)
    assert trajectory.component("qpos").shape == (13, model.nq)
    assert trajectory.component("warmstart").shape == (13, model.nv)
    np.testing.assert_array_equal(trajectory.component("ctrl")[1:], trajectory.actions)
    assert trajectory.time is not None
    start = 40 * model.opt.timestep
    expected = start + np.arange(13) * SUBSTEPS * model.opt.timestep
    np.testing.assert_allclose(trajectory.time, expected)
    assert {"time", "qpos", "qvel", "act", "ctrl"} <= set(trajectory.components)
    with pytest.raises(UnknownName, match=r"no state component 'qqpos'.*qpos"):
        trajectory.component("qqpos")


def test_the_model_is_that_of_the_step(tmp_path):
    """Step 0 is what the reset set; later changes hold from their steps on.

    A step that is not there is an error that says how many there are.
    """
    model = model_of("heap")
    changes = {
        0: {"geom_size": np.full((4, 3), 0.25), "opt.gravity": [0, 0, -1.5]},
        4: {"geom_rgba": np.full((4, 4), 0.5, np.float32), "camera.distance": 2.0},
        6: {"geom_rgba": np.full((4, 4), 0.75, np.float32)},
    }
    recording = Recording(tmp_path, model, changes=changes)
    for form in (as_is, finished):
        trajectory = mjrec.load_trajectory(form(recording))
        first = trajectory.model()
        np.testing.assert_array_equal(first.geom_size, np.full((4, 3), 0.25))
        assert first.opt.gravity[2] == -1.5
        np.testing.assert_array_equal(first.geom_rgba, model.geom_rgba)
        shades = [trajectory.model(step=k).geom_rgba[0, 0] for k in (3, 4, 5, 6, -1)]
        assert shades == [model.geom_rgba[0, 0], 0.5, 0.5, 0.75, 0.75]
    data = mujoco.MjData(first)
    trajectory.set_state(data, -1)
    assert data.time == trajectory.time[-1]
    for use in (trajectory.model, lambda step: trajectory.set_state(data, step)):
        for step in (13, -14):
            with pytest.raises(InvalidArgument, match="contains 13 states"):
                use(step)


def test_a_recording_without_a_simulation_has_no_model(tmp_path):
    """Its rewards are there all the same."""
    logs, name = new_logs(tmp_path), trajectory_prefix(INFIX, 0)
    span = logs.begin(name, {"model": None}, row_dtype())
    add_row(span, 0)
    add_row(span, 1, reward=2.5, terminated=True)
    trajectory = mjrec.load_trajectory(logs.path_of(name))
    assert trajectory.rewards.tolist() == [2.5]
    assert trajectory.time is None
    assert trajectory.actions is None
    with pytest.raises(UnreadableFile, match="no MuJoCo simulation"):
        trajectory.model()


def test_a_directory_is_answered_with_what_is_in_it(tmp_path):
    """The names that could have been meant."""
    with pytest.raises(InvalidArgument, match="without trajectories"):
        mjrec.load_trajectory(tmp_path)
    name = Recording(tmp_path, model_of("heap")).path.name
    with pytest.raises(InvalidArgument, match=f"Name one of .*: {name}\\."):
        mjrec.load_trajectory(tmp_path)


def test_reading_needs_no_simulator(tmp_path):
    """Arrays are read on a machine without mujoco; a model is not."""
    path = finished(Recording(tmp_path, model_of("heap")))
    code = (
        "import sys; sys.modules.update(mujoco=None, gymnasium=None)\n"
        "import mjrec\n"
        f"t = mjrec.load_trajectory({str(path)!r})\n"
        "print(len(t), t.component('qpos').shape, len(t.snapshots['geom_xpos']))\n"
        "try: t.model()\n"
        "except ModuleNotFoundError as error: print(error.name)\n"
    )
    assert run_python(code).stdout == "12 (13, 15) 7\nmujoco\n"
