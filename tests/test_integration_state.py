# SPDX-License-Identifier: Apache-2.0
"""States are taken apart by name and put together again, whatever the bits' numbers."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import numpy as np
import pytest

from mjrec.errors import InvalidArgument
from mjrec.formats.trajectory import StateComponent
from mjrec.simulation.integration_state import STATE_SPEC, set_state, state_components

# One with every component that MuJoCo 3.3 knows, but plugins.
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


@pytest.fixture
def model() -> Any:
    return mujoco.MjModel.from_xml_string(EVERYTHING)


def simulated(model: Any) -> Any:
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.3
    data.xfrc_applied[:] = 0.1
    data.userdata[:] = [7, 8]
    data.mocap_pos[:] = [0, 1, 1]
    for _ in range(20):
        mujoco.mj_step(model, data)
    return data


def state(model: Any, data: Any) -> Any:
    row = np.empty(mujoco.mj_stateSize(model, STATE_SPEC))
    mujoco.mj_getState(model, data, row, STATE_SPEC)
    return row


def test_components_are_where_mujoco_puts_them(model: Any) -> None:
    """The arrays of `MjData` are found in its vector by name."""
    data = simulated(model)
    row = state(model, data)
    parts = {
        c.name: row[c.offset : c.offset + c.length] for c in state_components(model)
    }
    others = {"time": [data.time], "warmstart": data.qacc_warmstart}
    for name, values in parts.items():
        expected = others.get(name, getattr(data, name, None))
        np.testing.assert_array_equal(values, np.ravel(expected), err_msg=name)
    assert {"qpos", "qvel", "act", "ctrl", "eq_active", "mocap_quat"} <= parts.keys()
    assert sum(map(len, parts.values())) == len(row)


def test_what_a_model_has_none_of_is_left_out() -> None:
    """No activations, no motion capture: no component."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    # The forces on the world are part of every state.
    assert state_components(model) == (
        StateComponent("time", 0, 1),
        StateComponent("xfrc_applied", 1, 6),
    )


def test_a_state_comes_back(model: Any) -> None:
    """Every number of it."""
    row = state(model, simulated(model))
    data = mujoco.MjData(model)
    set_state(model, data, state_components(model), row)
    np.testing.assert_array_equal(state(model, data), row)


def test_the_order_of_a_recording_counts(model: Any) -> None:
    """As another MuJoCo, with other bits, would have written it."""
    row = state(model, simulated(model))
    moved: list[StateComponent] = []
    numbers: list[Any] = []
    for part in reversed(state_components(model)):
        moved.append(dataclasses.replace(part, offset=sum(map(len, numbers))))
        numbers.append(row[part.offset : part.offset + part.length])
    data = mujoco.MjData(model)
    set_state(model, data, moved, np.concatenate(numbers))
    np.testing.assert_array_equal(state(model, data), row)


def _without(name: str, parts: tuple[StateComponent, ...]) -> list[StateComponent]:
    return [part for part in parts if part.name != name]


def _longer(name: str, parts: tuple[StateComponent, ...]) -> list[StateComponent]:
    return [
        dataclasses.replace(part, length=part.length + (part.name == name))
        for part in parts
    ]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: _without("act", c), "act: 0, and this model has 1"),
        (lambda c: _longer("qpos", c), "qpos: 9, and this model has 8"),
        (
            lambda c: [*c, StateComponent("aura", 0, 1)],
            "aura, which MuJoCo .* not know",
        ),
        (lambda c: [*c, c[0]], "some twice"),
    ],
)
def test_a_state_of_another_model_is_refused_whole(
    model: Any, change: Any, said: str
) -> None:
    """The message names what differs, and nothing is set."""
    row = np.append(state(model, simulated(model)), 0.0)
    data = mujoco.MjData(model)
    before = state(model, data)
    with pytest.raises(InvalidArgument, match=said):
        set_state(model, data, change(state_components(model)), row)
    np.testing.assert_array_equal(state(model, data), before)


def test_a_short_row_is_refused(model: Any) -> None:
    """MuJoCo itself would only say so of some of its parts."""
    row = state(model, simulated(model))
    with pytest.raises(InvalidArgument, match=r"is \d+ numbers, got .* \(3,\)"):
        set_state(model, mujoco.MjData(model), state_components(model), row[:3])
