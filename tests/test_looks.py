# SPDX-License-Identifier: Apache-2.0
"""Test that changes to a model or view are noticed, without false alarms."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjrec.simulation.fields import (
    array_names,
    holder_of,
    member_names,
    read_member,
    struct_names,
)
from mjrec.simulation.looks import Looks
from mjrec.simulation.view import SceneView


@pytest.fixture
def model():
    path = Path(__file__).parents[1] / "assets/showcase.xml"
    return mujoco.MjModel.from_xml_path(str(path))


def view():
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    size = {"max_geom": 100, "height": 48, "width": 64}
    return SceneView(camera=camera, option=option, fresh=False, label=-1, **size)


def change(struct, name):
    """Change a field or, if it is an array, its last byte."""
    holder, last = holder_of(struct, name)
    value = getattr(holder, last)
    if isinstance(value, np.ndarray):
        value.reshape(-1).view(np.uint8)[-1] ^= 1
    else:
        setattr(holder, last, value + 1)


def test_change_of_any_field_is_noticed_by_name(model):
    """The fields are all arrays and all members of `opt`, `vis` and `stat`."""
    looks = Looks(model)
    looks.follow(view())
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
def test_change_of_any_view_member_is_noticed_once(model, which):
    looks, watched = Looks(model), view()
    looks.follow(watched)
    struct = getattr(watched, which)
    for name in member_names(struct):
        change(struct, name)
        changed = looks.changed() or {}
        assert list(changed) == [f"{which}.{name}"]
        assert np.array_equal(*changed.values(), read_member(struct, name))
        assert looks.changed() is None
