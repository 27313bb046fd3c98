# SPDX-License-Identifier: Apache-2.0
"""The states of a simulation, as a recorder asks for them.

That frames which are drawn from them are those of the simulation, with cameras that
follow and infinite planes, is seen in `test_same_pixels`.
"""

import types

import mujoco
import numpy as np
import pytest

from mjrec.errors import PicturesDiffer
from mjrec.simulation.capture import Capture
from mjrec.simulation.view import SceneView

BALL = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <geom type="plane" size="2 2 .1"/>
    <body name="ball" pos="0 0 .5"><joint name="x" type="slide"/>
      <joint name="turn" type="hinge"/><geom size=".1"/><site name="s"/></body>
  </worldbody>
  <actuator><motor joint="x"/></actuator>
</mujoco>
"""


@pytest.fixture
def simulation(tmp_path):
    """What an environment has: model, data, camera and visual options."""
    made = types.SimpleNamespace(camera=mujoco.MjvCamera(), option=mujoco.MjvOption())
    compile_model(made)
    mujoco.mjv_defaultFreeCamera(made.model, made.camera)
    return made


@pytest.fixture
def states(simulation, tmp_path):
    """What takes its states down."""
    states = Capture(
        lambda: (simulation.model, simulation.data), view=lambda: view_of(simulation)
    )
    states.open(tmp_path)
    yield states
    states.finish()
    states.close()


def compile_model(simulation, radius=".1"):
    text = BALL.replace('size=".1"', f'size="{radius}"')
    simulation.model = mujoco.MjModel.from_xml_string(text)
    simulation.data = mujoco.MjData(simulation.model)
    mujoco.mj_step(simulation.model, simulation.data)


def view_of(simulation):
    camera, option = simulation.camera, simulation.option
    size = {"max_geom": 100, "height": 48, "width": 64}
    return SceneView(camera=camera, option=option, fresh=False, label=-1, **size)


def show(simulation, flag, shown=True):
    index = int(mujoco.mjtVisFlag.__members__[f"mjVIS_{flag}"])
    simulation.option.flags[index] = shown


def words_of(start):
    return np.zeros(start.snapshot.itemsize // 8, np.uint64)


def test_a_model_that_consists_of_other_things_is_stored_anew(simulation, states):
    """In mid-episode that is an error, where it is drawn, because it cannot be set."""
    first = states.begin_episode()
    simulation.model.geom_type[1] = int(mujoco.mjtGeom.mjGEOM_BOX)
    second = states.begin_episode()
    assert second.model != first.model
    assert second.model_fields == {}
    words = words_of(second)
    simulation.model.dof_Madr[0] += 1
    assert states.capture_snapshot(words) is None
    simulation.model.geom_type[1] = int(mujoco.mjtGeom.mjGEOM_SPHERE)
    with pytest.raises(PicturesDiffer, match="geom_type of the model changed"):
        states.capture_snapshot(words)


def test_a_recompiled_model_is_another_one(simulation, states):
    """As in composer environments, at every reset; in mid-episode it is an error."""
    first = states.begin_episode()
    compile_model(simulation, radius=".2")
    second = states.begin_episode()
    assert second.model != first.model
    words = words_of(second)
    assert states.capture_snapshot(words) is None
    compile_model(simulation)
    with pytest.raises(PicturesDiffer, match="switched to another model"):
        states.capture_snapshot(words)
    with pytest.raises(PicturesDiffer, match="switched to another model"):
        states.capture_state(np.empty(8))
    assert states.begin_episode().model == first.model


@pytest.mark.parametrize(
    "flag", ["CONTACTPOINT", "CONTACTFORCE", "CONTACTSPLIT", "ISLAND"]
)
def test_what_only_constraints_tell_is_refused(simulation, states, flag):
    """States are still recorded, and what changes in the model still told."""
    if flag == "ISLAND" and hasattr(mujoco.mjtEnableBit, "mjENBL_ISLAND"):
        simulation.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ISLAND)
    show(simulation, flag)
    start = states.begin_episode()
    assert f"mjVIS_{flag} of the visual options" in start.refusal
    assert (start.scene, start.snapshot) == (None, None)
    assert start.state
    assert states.changed_fields() is None
    simulation.model.geom_rgba[0] = 0.5
    assert states.changed_fields().keys() == {"geom_rgba"}
    with pytest.raises(PicturesDiffer, match=flag):
        states.capture_snapshot(np.zeros(0, np.uint64))
    show(simulation, flag, False)
    assert states.begin_episode().refusal is None


def test_an_option_that_snapshots_cannot_follow_is_an_error(simulation, states):
    """Turned on in mid-episode it is too late for another row."""
    words = words_of(states.begin_episode())
    show(simulation, "INERTIA")
    with pytest.raises(PicturesDiffer, match="xipos"):
        states.capture_snapshot(words)
    start = states.begin_episode()
    assert start.refusal is None
    assert states.capture_snapshot(words_of(start)) is None
    simulation.option.frame = int(mujoco.mjtFrame.mjFRAME_CONTACT)
    with pytest.raises(PicturesDiffer, match="mjFRAME_CONTACT"):
        states.capture_snapshot(words_of(start))


def test_a_field_that_is_forgotten_is_refused(states, monkeypatch):
    """The first frame is compared, whatever the reason for a difference is."""
    monkeypatch.setattr("mjrec.simulation.captured_arrays.ALWAYS", ("geom_xmat",))
    assert "drawn from its snapshot differs" in states.begin_episode().refusal
