# SPDX-License-Identifier: Apache-2.0
"""States in rows, and the memory that they are gathered from."""

import mujoco
import numpy as np
import pytest

from mjrec.formats.trajectory import columns_of
from mjrec.simulation.raw_memory import WORDS
from mjrec.simulation.states import read_state, state_dtype, state_words

# Has every component except plugins.
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


@pytest.mark.parametrize("xml", [FULL.format(equality=""), "<mujoco/>"])
def test_state_words_equal_mujocos_state(xml):
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.mocap_pos[:] = 7
    data.userdata[:] = np.arange(len(data.userdata))
    words = state_words(model, data)
    for step in range(5):
        data.ctrl[:] = 0.1 * step
        data.xfrc_applied[1:] = step
        data.qfrc_applied[:] = -step
        mujoco.mj_step(model, data, nstep=step)
        assert WORDS.take(words).tobytes() == read_state(model, data).tobytes()


def test_components_are_named_after_arrays_of_mjdata():
    equality = '<equality><weld body1="moved" body2="free"/></equality>'
    model = mujoco.MjModel.from_xml_string(FULL.format(equality=equality))
    data = mujoco.MjData(model)
    data.ctrl[:], data.xfrc_applied[:], data.userdata[:] = 0.3, 0.1, [7, 8, 9]
    mujoco.mj_step(model, data, nstep=20)
    row = read_state(model, data)
    parts = {n: row[where] for n, where in columns_of(state_dtype(model)).items()}
    others = {"time": [data.time], "warmstart": data.qacc_warmstart}
    for name, values in parts.items():
        expected = others.get(name, getattr(data, name, None))
        np.testing.assert_array_equal(values, np.ravel(expected), err_msg=name)
    assert {"qpos", "qvel", "act", "ctrl", "eq_active", "mocap_quat"} <= parts.keys()
    assert sum(map(len, parts.values())) == len(row)
    # `eq_active` is a byte in memory and a float in the state.
    assert state_words(model, data) is None
