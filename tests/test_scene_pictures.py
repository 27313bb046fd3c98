# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from mjrec import UnknownName
from mjrec.simulation.scene_pictures import Look, ScenePictures, camera_label

HILLS = """
<mujoco>
  <asset><hfield name="hills" nrow="8" ncol="8" size="1 1 0.5 0.1"/></asset>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="above" pos="0 -2 2" xyaxes="1 0 0 0 0.7 0.7"/>
    <geom type="hfield" hfield="hills" rgba="0.2 0.8 0.3 1"/>
  </worldbody>
</mujoco>
"""


class Simulation:
    """A model and its data, exchanged by `load`."""

    def __init__(self) -> None:
        self.load()

    def load(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(HILLS)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)


@pytest.fixture
def simulation() -> Simulation:
    return Simulation()


@pytest.fixture
def pictures(simulation: Simulation) -> Iterator[ScenePictures]:
    made = ScenePictures(
        lambda: (simulation.model, simulation.data),
        look=lambda: Look(camera="above"),
        camera=None,
        height=48,
        width=64,
    )
    yield made
    made.close()


def test_terrain_made_by_a_reset_is_seen(
    simulation: Simulation, pictures: ScenePictures
) -> None:
    """A height field that changed between episodes is uploaded."""
    flat = pictures.render()
    simulation.model.hfield_data[:] = np.random.default_rng(0).random(64)
    pictures.begin_episode()
    assert np.abs(pictures.render().astype(int) - flat).max() > 20


def test_another_model_is_drawn_by_another_renderer(
    simulation: Simulation, pictures: ScenePictures
) -> None:
    """As composer's environments need, which compile a model for each episode."""
    green = pictures.render()
    simulation.load()
    simulation.model.geom_rgba[0] = (1, 0, 0, 1)
    pictures.begin_episode()
    red = pictures.render()
    assert green[..., 1].mean() > green[..., 0].mean()
    assert red[..., 0].mean() > red[..., 1].mean()


def test_facts_name_camera_and_renderer(pictures: ScenePictures) -> None:
    """What the metadata of a video needs to say."""
    pictures.render()
    facts = pictures.facts()
    assert facts["camera"] == "above"
    assert facts["pictures"] == "scene"
    assert facts["gl_renderer"]


def test_unknown_camera_is_an_error_at_construction(simulation: Simulation) -> None:
    """Before anything is drawn."""
    with pytest.raises(UnknownName, match="above"):
        ScenePictures(
            lambda: (simulation.model, simulation.data),
            look=Look,
            camera="below",
            height=8,
            width=8,
        )


def test_labels_of_cameras(simulation: Simulation) -> None:
    """A name where there is one, else a number, else where a free camera is."""
    free = mujoco.MjvCamera()
    free.distance = 3
    fixed = mujoco.MjvCamera()
    fixed.type = mujoco.mjtCamera.mjCAMERA_FIXED
    fixed.fixedcamid = 0
    assert camera_label(simulation.model, "above") == "above"
    assert camera_label(simulation.model, 0) == "above"
    assert camera_label(simulation.model, -1) == -1
    assert camera_label(simulation.model, fixed) == "above"
    label = camera_label(simulation.model, free)
    assert isinstance(label, dict)
    assert label["distance"] == 3


def test_close_may_be_called_twice(pictures: ScenePictures) -> None:
    """And drawing again makes a new renderer."""
    first = pictures.render()
    pictures.close()
    pictures.close()
    assert (pictures.render() == first).all()
