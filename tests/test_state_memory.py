# SPDX-License-Identifier: Apache-2.0
"""The memory of a simulation holds what `mj_getState` gives."""

from __future__ import annotations

import gymnasium
import mujoco
import numpy as np
import pytest

from mjrec.simulation.integration_state import STATE_SPEC
from mjrec.simulation.state_memory import has_state_memory, state_memory

# Something of every component but plugins'.
FULL = """
<mujoco>
  <size nuserdata="3"/>
  <worldbody>
    <body name="moved" mocap="true"><geom size=".1"/></body>
    <body name="free" pos="0 0 1"><freejoint/><geom size=".1"/></body>
    <body pos="1 0 1"><joint name="x" type="slide"/><geom size=".1"/></body>
  </worldbody>
  <actuator><intvelocity joint="x" actrange="-1 1"/></actuator>
  {equality}
</mujoco>
"""
EQUALITY = '<equality><weld body1="moved" body2="free"/></equality>'


def state_of(model: mujoco.MjModel, data: mujoco.MjData) -> bytes:
    state = np.empty(mujoco.mj_stateSize(model, STATE_SPEC))
    mujoco.mj_getState(model, data, state, STATE_SPEC)
    return state.tobytes()


def check(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Check that the same memory holds the state, step after step."""
    assert has_state_memory(model)
    memory = state_memory(model, data)
    for step in range(5):
        data.ctrl[:] = 0.1 * step
        data.xfrc_applied[1:] = step
        data.qfrc_applied[:] = -step
        mujoco.mj_step(model, data, nstep=step)
        assert b"".join(memory) == state_of(model, data)
    mujoco.mj_resetData(model, data)
    assert b"".join(memory) == state_of(model, data)


def test_it_holds_every_component() -> None:
    """Mocap bodies, user data, activations and forces from outside as well."""
    model = mujoco.MjModel.from_xml_string(FULL.format(equality=""))
    data = mujoco.MjData(model)
    data.mocap_pos[:] = 7
    data.userdata[:] = (1, 2, 3)
    check(model, data)


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Humanoid-v5", "Pusher-v5"])
def test_it_holds_the_state_of_an_environment(env_id: str) -> None:
    """As Gymnasium makes them."""
    env = gymnasium.make(env_id).unwrapped
    check(env.model, env.data)  # type: ignore[attr-defined]


def test_a_component_of_another_type_is_noticed() -> None:
    """Whether an equality is active is a byte here and a number there."""
    assert not has_state_memory(
        mujoco.MjModel.from_xml_string(FULL.format(equality=EQUALITY))
    )


def test_a_model_without_anything_has_a_time() -> None:
    """And that is all of its state."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    check(model, mujoco.MjData(model))
