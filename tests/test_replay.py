# SPDX-License-Identifier: Apache-2.0
"""Each recorded state follows from the state and controls before it."""

import importlib.util

import gymnasium
import mujoco
import numpy as np
import pytest
from parts import parametrize

import mjrec
from mjrec.errors import InvalidArgument
from mjrec.formats.trajectory import columns_of, packed
from mjrec.simulation.states import read_state, set_state, state_dtype

GYMNASIUM = ("HalfCheetah", "Humanoid", "Pusher", "Ant", "Hopper", "HumanoidStandup")
GYMNASIUM += ("Swimmer", "InvertedPendulum", "InvertedDoublePendulum", "Reacher")
GYMNASIUM += ("Walker2d",)
# Two begin far from rest; finger-spin settles in its reset, which only the solver's
# warm start remembers.
SUITE = ("humanoid-run", "cheetah-run", "finger-spin")
STEPS = 8


def check_states_follow(path, substeps):
    """Check that state k and the controls of step k + 1 give state k + 1."""
    trajectory = mjrec.load_trajectory(path)
    model = trajectory.model()
    data = mujoco.MjData(model)
    spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    followed = np.empty((len(trajectory), mujoco.mj_stateSize(model, spec)))
    for k in range(len(trajectory)):
        trajectory.set_state(data, k)
        data.ctrl[:] = trajectory.component("ctrl")[k + 1]
        mujoco.mj_step(model, data, nstep=substeps)
        mujoco.mj_getState(model, data, followed[k], spec)
    assert trajectory.states[1:].tobytes() == followed.tobytes()


@parametrize("name", GYMNASIUM, default=3, part=pytest.mark.environments)
def test_gymnasium_states_follow_bit_for_bit(name, tmp_path):
    env = gymnasium.make(f"{name}-v5")
    env.action_space.seed(0)
    with mjrec.Monitor(env, tmp_path, workers=0) as monitored:
        monitored.reset(seed=0)
        for _ in range(STEPS):
            if any(monitored.step(env.action_space.sample())[2:4]):
                break
        substeps = env.unwrapped.frame_skip
    [path] = tmp_path.glob("*.h5")
    check_states_follow(path, substeps)


def suite_tasks():
    if importlib.util.find_spec("dm_control") is None:
        return []
    from dm_control import suite

    return [f"{domain}-{task}" for domain, task in suite.ALL_TASKS]


@pytest.mark.dm_control
@parametrize("name", suite_tasks(), default=SUITE, part=pytest.mark.environments)
def test_suite_states_follow_bit_for_bit(name, tmp_path):
    """Some tasks change their model at every reset."""
    from dm_control import suite

    env = suite.load(*name.split("-", 1), task_kwargs={"random": 0})
    spec, random = env.action_spec(), np.random.default_rng(0)
    with mjrec.Monitor(env, tmp_path, workers=0, trajectory_callable=True) as monitored:
        for _ in range(2):
            monitored.reset()
            for _ in range(STEPS):
                monitored.step(random.uniform(spec.minimum, spec.maximum))
        substeps = round(env.control_timestep() / env.physics.timestep())
    for path in tmp_path.glob("*.h5"):
        check_states_follow(path, substeps)


# Has every component of MuJoCo 3.3's states but plugins.
EVERYTHING = """
<mujoco>
  <size nuserdata="2"/>
  <worldbody>
    <body name="hand" mocap="true" pos="0 0 1"><geom size=".1"/></body>
    <body name="ball" pos="0 0 2"><freejoint/><geom size=".1"/></body>
    <body><joint name="hinge"/><geom size=".1" pos="0 0 .3"/></body>
  </worldbody>
  <equality><weld body1="hand" body2="ball"/></equality>
  <actuator><general joint="hinge" dyntype="filter" dynprm="1"/></actuator>
</mujoco>
"""


def simulated():
    model = mujoco.MjModel.from_xml_string(EVERYTHING)
    data = mujoco.MjData(model)
    data.ctrl[:], data.xfrc_applied[:], data.userdata[:] = 0.3, 0.1, [7, 8]
    mujoco.mj_step(model, data, nstep=20)
    return model, read_state(model, data)


def test_a_state_is_set_by_the_names_of_its_parts():
    """A MuJoCo with other bits would write the parts in another order."""
    model, row = simulated()
    own = columns_of(state_dtype(model))
    names = list(reversed(own))
    numbers = np.concatenate([row[own[name]] for name in names])
    moved = packed((name, ("<f8", row[own[name]].shape)) for name in names)
    data = mujoco.MjData(model)
    set_state(model, data, columns_of(moved), numbers)
    np.testing.assert_array_equal(read_state(model, data), row)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"act": None}, "act has 0, not 1 as in this model"),
        ({"qpos": slice(0, 9)}, "qpos has 9, not 8 as in this model"),
        ({"aura": slice(0, 1)}, r"aura, which MuJoCo .* lacks"),
    ],
)
def test_a_state_of_another_model_is_refused(change, message):
    """The error names the difference, and nothing is set."""
    model, row = simulated()
    data = mujoco.MjData(model)
    before = read_state(model, data)
    own = columns_of(state_dtype(model))
    parts = {k: v for k, v in {**own, **change}.items() if v is not None}
    with pytest.raises(InvalidArgument, match=message):
        set_state(model, data, parts, np.append(row, 0.0))
    with pytest.raises(
        InvalidArgument, match=r"has \d+ numbers, but this array has the shape \(3,\)"
    ):
        set_state(model, data, own, row[:3])
    np.testing.assert_array_equal(read_state(model, data), before)
