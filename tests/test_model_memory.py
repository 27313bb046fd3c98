# SPDX-License-Identifier: Apache-2.0
"""What of a model has changed: everything that has, and nothing that has not."""

from __future__ import annotations

import copy
import ctypes

import mujoco
import numpy as np
import pytest

from mjrec.simulation import model_memory, scene_view
from mjrec.simulation.model_fields import array_names, struct_names
from mjrec.simulation.model_memory import ModelMemory
from mjrec.simulation.struct_memory import Memory, Place, array_address, find_places

# With a texture, a mesh and a height field that are long enough to be heavy.
RICH = """
<mujoco>
  <asset>
    <texture name="t" type="2d" builtin="checker" width="64" height="64"/>
    <material name="a" texture="t"/>
    <hfield name="h" nrow="40" ncol="40" size="1 1 1 1"/>
    <mesh name="m" builtin="sphere" params="5"/>
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


@pytest.fixture
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(_in_this_version(RICH))


def _in_this_version(xml: str) -> str:
    # Built-in meshes came with mujoco 3.3.3.
    try:
        mujoco.MjModel.from_xml_string(xml)
    except ValueError:
        return xml.replace('<mesh name="m" builtin="sphere" params="5"/>', "")
    return xml


def test_nothing_has_changed_at_first(model: mujoco.MjModel) -> None:
    """A model that nobody touched gives nothing, however one looks."""
    memory = ModelMemory(model)
    assert memory.changed() is None
    assert memory.anything_changed() is None
    assert memory.changed_from_stored() == {}


def test_a_change_in_any_array_is_noticed(model: mujoco.MjModel) -> None:
    """Every single array with elements counts, physical ones as well."""
    memory = ModelMemory(model)
    for name in array_names():
        array = getattr(model, name)
        if array.size:
            before = array.copy()
            array.reshape(-1).view(np.uint8)[-1] ^= 1
            assert (memory.anything_changed() or {}).keys() == {name}
            assert memory.changed_from_stored().keys() == {name}
            array[...] = before
            assert (memory.anything_changed() or {}).keys() <= {name}
            assert memory.changed_from_stored() == {}


def test_a_change_in_any_member_of_a_struct_is_noticed(model: mujoco.MjModel) -> None:
    """`opt`, `vis` and `stat` count like arrays, numbers in them like vectors."""
    memory = ModelMemory(model)
    for name in struct_names():
        *parts, last = name.split(".")
        holder = model
        for part in parts:
            holder = getattr(holder, part)
        value = getattr(holder, last)
        if isinstance(value, np.ndarray):
            value[-1] += 0.5
        else:
            setattr(holder, last, value + 1)
        changed = memory.changed()
        assert changed is not None
        assert list(changed) == [name]
        assert np.array_equal(changed[name], getattr(holder, last))


def test_only_long_arrays_that_have_to_be_uploaded_wait_for_a_reset(
    model: mujoco.MjModel,
) -> None:
    """Textures and height fields are found when everything is looked at, then only."""
    memory = ModelMemory(model)
    model.tex_data[7] ^= 1
    model.hfield_data[7] = 0.5
    assert memory.changed() is None
    assert (memory.anything_changed() or {}).keys() == {"tex_data", "hfield_data"}
    assert memory.anything_changed() is None
    assert memory.changed_from_stored().keys() == {"tex_data", "hfield_data"}


def test_what_no_picture_shows_is_looked_at_on_resets(model: mujoco.MjModel) -> None:
    """And when somebody says that something has changed."""
    memory = ModelMemory(model)
    model.body_mass[1] = 7
    assert memory.changed() is None
    assert (memory.anything_changed() or {}).keys() == {"body_mass"}
    model.body_mass[1] = 8
    assert memory.changed_from_stored().keys() == {"body_mass"}


def test_a_change_is_told_once_and_going_back_is_one(model: mujoco.MjModel) -> None:
    """At captures the last look counts, at resets what is stored."""
    memory = ModelMemory(model)
    model.geom_rgba[1] = 0.25
    changed = memory.changed()
    assert changed is not None
    changed["geom_rgba"][:] = 9
    assert memory.changed() is None, "a copy was given away"
    model.geom_rgba[1] = (0.5, 0.5, 0.5, 1)
    assert (memory.changed() or {}).keys() == {"geom_rgba"}
    assert memory.changed_from_stored() == {}
    model.geom_rgba[1] = 0.75
    assert memory.changed_from_stored().keys() == {"geom_rgba"}
    assert memory.changed() is None, "what a reset has told is no news"


def test_not_a_number_is_as_good_as_any_value(model: mujoco.MjModel) -> None:
    """A NaN that stays is no change."""
    model.geom_rbound[0] = np.nan
    memory = ModelMemory(model)
    assert memory.changed() is None
    model.geom_rbound[1] = np.nan
    assert (memory.changed() or {}).keys() == {"geom_rbound"}


def test_padding_is_never_reported(model: mujoco.MjModel) -> None:
    """Bytes between the arrays belong to nobody."""
    arrays = [getattr(model, name) for name in array_names()]
    used = np.zeros(model.nbuffer, bool)
    start = min(array_address(array) for array in arrays if array.size)
    for array in arrays:
        if array.size:
            first = array_address(array) - start
            used[first : first + array.nbytes] = True
    memory = ModelMemory(model)
    last = int(np.flatnonzero(used)[-1])
    gaps = np.flatnonzero(~used[:last])
    # Names and paths of files are there as well, which nobody can change.
    assert len(gaps)
    for offset in gaps.tolist():
        byte = ctypes.c_ubyte.from_address(start + offset)
        byte.value ^= 255
        assert memory.changed() is None
        assert memory.changed_from_stored() == {}
        byte.value ^= 255


def test_the_same_model_in_another_wrapper_is_the_same(model: mujoco.MjModel) -> None:
    """What counts is the memory, not the Python object."""
    memory = ModelMemory(model)
    assert memory.is_of(mujoco.MjData(model).model)
    assert not memory.is_of(copy.copy(model))


def test_a_model_without_anything_can_be_remembered() -> None:
    """The smallest model has arrays of one body and no more."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    memory = ModelMemory(model)
    model.body_mass[0] = 1
    assert (memory.anything_changed() or {}).keys() == {"body_mass"}


@pytest.mark.parametrize("fallback", ["arrays", "structs"])
def test_changes_are_found_where_memory_is_laid_out_otherwise(
    model: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch, fallback: str
) -> None:
    """If a MuJoCo has its arrays here and there it only takes longer."""
    if fallback == "arrays":
        monkeypatch.setattr(model_memory, "_lie_together", lambda *_: False)
    else:
        monkeypatch.setattr(model_memory, "_struct_places", lambda: None)
    memory = ModelMemory(model)
    model.site_rgba[0] = 0.125
    model.opt.timestep = 0.5
    model.vis.headlight.ambient[:] = 0.75
    names = {"site_rgba", "opt.timestep", "vis.headlight.ambient"}
    assert (memory.changed() or {}).keys() == names
    assert memory.changed() is None
    assert memory.changed_from_stored().keys() == names


def test_the_quick_way_holds_in_this_version(model: mujoco.MjModel) -> None:
    """Without it each capture would take many times as long."""
    assert model_memory._struct_places() is not None
    for kind in (mujoco.MjvCamera, mujoco.MjvOption):
        assert scene_view._places(kind) is not None
    # All light arrays, cut by three heavy ones at most, and the structs.
    assert len(ModelMemory(model)._light) < 12


def test_a_member_that_is_not_where_it_is_looked_for_is_not_found() -> None:
    """Then no place is believed, and the members are read one by one."""
    camera = mujoco.MjvCamera()
    start = array_address(camera.lookat)
    names = ["lookat", "distance", "type"]
    assert find_places(camera, names, start=start, stop=start + 56) is None
    assert find_places(camera, names[:2], start=start, stop=start + 56) is not None


def test_a_difference_behind_the_last_place_belongs_to_nobody() -> None:
    """Only what lies inside a place has its name."""
    values = np.zeros(16, np.uint8)
    places = [Place("a", 2, 4), Place("b", 8, 12)]
    memory = Memory(array_address(values), places)
    saved = memory.copy()
    values[[0, 5, 7]] = 1
    assert memory.differing(saved) == []
    values[[3, 8]] = 1
    assert memory.differing(saved) == ["a", "b"]
