# SPDX-License-Identifier: Apache-2.0
"""What of a model and a view has changed: everything that has, and nothing else."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
import pytest

from mjrec.simulation import change_detection as module
from mjrec.simulation.change_detection import Looks
from mjrec.simulation.fields import (
    array_names,
    holder_of,
    member_names,
    read_member,
    struct_names,
)
from mjrec.simulation.view import SceneView

# With a texture, a mesh and a height field.
RICH = """
<mujoco>
  <asset>
    <texture name="t" type="2d" builtin="checker" width="64" height="64"/>
    <material name="a" texture="t"/>
    <hfield name="h" nrow="40" ncol="40" size="1 1 1 1"/>
    {mesh}
  </asset>
  <worldbody>
    <light/>
    <geom type="plane" size="1 1 1" material="a"/>
    <geom type="hfield" hfield="h"/>
    <camera name="c"/>
    <body name="b"><freejoint/><geom size=".1"/><site name="s"/></body>
  </worldbody>
</mujoco>
"""
MESH = '<mesh name="m" builtin="sphere" params="5"/>'
WAITING = {"tex_data", "hfield_data", "mesh_vert", "body_mass"}


@pytest.fixture
def model() -> mujoco.MjModel:
    try:
        return mujoco.MjModel.from_xml_string(RICH.format(mesh=MESH))
    except ValueError:
        # Built-in meshes came with mujoco 3.3.3.
        return mujoco.MjModel.from_xml_string(RICH.format(mesh=""))


def view() -> SceneView:
    return SceneView(
        camera=mujoco.MjvCamera(),
        option=mujoco.MjvOption(),
        max_geom=100,
        fresh=False,
        height=48,
        width=64,
        label=-1,
    )


@pytest.fixture
def looks(model: mujoco.MjModel) -> Looks:
    return following(model)


def following(model: mujoco.MjModel) -> Looks:
    looks = Looks(model)
    looks.follow(view())
    return looks


def change(struct: Any, name: str) -> None:
    """Set a field, or the last number of one, to another value."""
    holder, last = holder_of(struct, name)
    value = getattr(holder, last)
    if isinstance(value, np.ndarray):
        value.reshape(-1).view(np.uint8)[-1] ^= 1
    else:
        setattr(holder, last, value + 1)


def test_nothing_has_changed_at_first(looks: Looks) -> None:
    """A model that nobody touched gives nothing, however one looks."""
    assert looks.changed() is None
    assert looks.changed(anything=True) is None
    assert looks.since_stored() == {}


def test_a_change_of_any_field_is_noticed(model: mujoco.MjModel, looks: Looks) -> None:
    """Every array with elements, every member of `opt`, `vis` and `stat`: by name."""
    arrays = [name for name in array_names() if getattr(model, name).size]
    for name in (*arrays, *struct_names()):
        before = read_member(model, name)
        change(model, name)
        changed = looks.changed(anything=True) or {}
        assert changed.keys() == {name}
        assert changed[name].tobytes() == read_member(model, name).tobytes()
        assert looks.since_stored().keys() == {name}
        holder, last = holder_of(model, name)
        if before.shape:
            getattr(holder, last)[...] = before
        else:
            setattr(holder, last, type(getattr(holder, last))(before.item()))
        assert looks.since_stored() == {}


@pytest.mark.parametrize("which", ["camera", "option"])
def test_every_member_of_a_view_is_watched(model: mujoco.MjModel, which: str) -> None:
    """One change, one name, once."""
    looks, shown = Looks(model), view()
    looks.follow(shown)
    struct = getattr(shown, which)
    for name in member_names(struct):
        change(struct, name)
        changed = looks.changed() or {}
        assert list(changed) == [f"{which}.{name}"]
        assert np.array_equal(*changed.values(), read_member(struct, name))
        assert looks.changed() is None


def test_another_view_is_no_change(model: mujoco.MjModel, looks: Looks) -> None:
    """Nor is what has become of the same one between episodes."""
    other = view()
    other.camera.distance = 7
    looks.follow(other)
    assert looks.changed() is None
    other.camera.distance = 8
    looks.follow(other)
    assert looks.changed() is None


def test_what_is_not_drawn_anew_waits_for_a_reset(
    model: mujoco.MjModel, looks: Looks
) -> None:
    """What has to be uploaded, and physics: found when everything is looked at."""
    names = {name for name in WAITING if getattr(model, name).size}
    for name in names:
        change(model, name)
    assert looks.changed() is None
    assert (looks.changed(anything=True) or {}).keys() == names
    assert looks.changed(anything=True) is None
    assert looks.since_stored().keys() == names


def test_a_change_is_told_once_and_going_back_is_one(
    model: mujoco.MjModel, looks: Looks
) -> None:
    """At captures the last look counts, at resets what is stored."""
    model.geom_rgba[1] = 0.25
    changed = looks.changed() or {}
    changed["geom_rgba"][:] = 9
    assert looks.changed() is None, "a copy was given away"
    model.geom_rgba[1] = (0.5, 0.5, 0.5, 1)
    assert (looks.changed() or {}).keys() == {"geom_rgba"}
    assert looks.since_stored() == {}
    model.geom_rgba[1] = 0.75
    assert looks.since_stored().keys() == {"geom_rgba"}
    assert looks.changed() is None, "what a reset has told is no news"


def test_not_a_number_is_as_good_as_any_value(model: mujoco.MjModel) -> None:
    """A NaN that stays is no change."""
    model.geom_rbound[0] = np.nan
    looks = following(model)
    assert looks.changed() is None
    model.geom_rbound[1] = np.nan
    assert (looks.changed() or {}).keys() == {"geom_rbound"}


def test_the_same_model_in_another_wrapper_is_the_same(
    model: mujoco.MjModel, looks: Looks
) -> None:
    """What counts is the memory, not the Python object."""
    assert looks.is_of(mujoco.MjData(model).model)
    assert not looks.is_of(copy.copy(model))


def test_a_few_comparisons_do(looks: Looks) -> None:
    """The structs, a few groups of arrays, camera and option."""
    assert len(looks.present) < 9


def test_arrays_that_do_not_lie_together_are_watched_one_by_one(
    model: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If a MuJoCo has its arrays here and there it only takes longer."""
    monkeypatch.setattr(module, "_lie_together", lambda *_: False)
    looks = following(model)
    model.site_rgba[0] = 0.125
    model.opt.timestep = 0.5
    assert (looks.changed() or {}).keys() == {"site_rgba", "opt.timestep"}
    assert looks.since_stored().keys() == {"site_rgba", "opt.timestep"}
