# SPDX-License-Identifier: Apache-2.0
"""Fields of a model and of a view, read and set by their names."""

import copy
import json

import mujoco
import numpy as np
import pytest

from mjrec.errors import InvalidArgument
from mjrec.simulation.fields import apply_fields, array_names, read_fields, struct_names
from mjrec.simulation.view import SceneView, view_from_facts

XML = """
<mujoco>
  <asset>
    <texture name="t" type="2d" builtin="flat" width="4" height="4"/>
    <material name="a" texture="t"/><material name="b"/>
  </asset>
  <worldbody><light/><geom size="1" material="a"/><site name="s"/></worldbody>
</mujoco>
"""


@pytest.fixture
def model():
    return mujoco.MjModel.from_xml_string(XML)


def test_what_was_read_can_be_set_in_another_model(model):
    """Arrays and members of structs; a single number is an array of no dimension."""
    assert len(read_fields(model, [*array_names(), *struct_names()])) > 450
    other = copy.copy(model)
    model.site_pos[0] = (1, 2, 3)
    model.tex_data[:] = 7
    model.geom_matid[0] = 1
    model.opt.gravity[:] = 0
    model.opt.timestep = 0.125
    model.vis.headlight.ambient[:] = 0.25
    model.vis.global_.fovy = 60
    names = ["site_pos", "tex_data", "geom_matid", "opt.gravity", "opt.timestep"]
    names += ["vis.headlight.ambient", "vis.global_.fovy"]
    fields = read_fields(model, names)
    assert fields["opt.timestep"].shape == ()
    model.site_pos[0] = 9
    apply_fields(other, fields)
    assert other.site_pos.tolist() == [[1, 2, 3]]
    after = read_fields(other, names)
    for name in names:
        assert np.array_equal(after[name], fields[name]), name


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("site_colour", np.zeros(4), "has no model field 'site_colour'"),
        ("opt.__class__", np.zeros(1), "has no model field"),
        ("site_pos", np.zeros((2, 3)), r"shape \(1, 3\) here"),
        ("opt.timestep", np.zeros(2), r"shape \(\) here"),
        ("site_pos", np.array([["a", "b", "c"]]), "belongs to another model"),
        ("geom_dataid", np.array([7]), "part of the model's structure"),
        ("geom_type", np.array([7]), "part of the model's structure"),
        ("geom_matid", np.array([2]), "indices from -1 to 1"),
        ("geom_matid", np.array([-2]), "indices from -1 to 1"),
        ("geom_matid", np.array([np.nan]), "whole numbers"),
        ("vis.quality.shadowsize", np.array(np.nan), "whole numbers"),
        ("vis.quality.shadowsize", np.array(2**40), "cannot be 1099511627776"),
        ("option.label", np.array(1 << 30), "must be from 0 to"),
    ],
)
def test_what_cannot_be_set_is_refused(model, name, value, words):
    """A file may name anything: MuJoCo would read foreign memory at a wrong index."""
    with pytest.raises(InvalidArgument, match=words):
        apply_fields(model, {name: value}, option=mujoco.MjvOption())


@pytest.fixture
def view():
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.lookat[:] = (0.1, 1 / 3, -7)
    camera.fixedcamid = 4
    option.flags[int(mujoco.mjtVisFlag.mjVIS_RANGEFINDER)] = False
    option.label = 3
    more = {"max_geom": 1000, "fresh": True, "height": 48, "width": 64}
    return SceneView(camera=camera, option=option, label="side", **more)


def test_facts_are_json_and_come_back_as_the_same_view(view):
    """To the last bit, and with every member there is."""
    facts = json.loads(json.dumps(view.facts()))
    again = view_from_facts(facts)
    assert again.camera.lookat.tobytes() == view.camera.lookat.tobytes()
    assert again.option.flags.tolist() == view.option.flags.tolist()
    assert again.facts() == facts
    assert {"flags", "label", "frame", "bvh_depth"} <= facts["option"].keys()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("camera", None),
        ("camera", {"type": 0}),
        ("max_geom", 0),
        ("max_geom", 1 << 40),
        ("height", "48"),
        ("camera.lookat", [0, 1]),
        ("camera.lookat", ["a", "b", "c"]),
        ("camera.type", None),
        ("option.flags", [True]),
        ("option.label", -1),
        ("option.frame", 0.5),
        ("option.frame", 1 << 30),
    ],
)
def test_facts_that_cannot_be_are_refused_by_name(view, name, value):
    """They may come from a file."""
    facts = view.facts()
    *struct, member = name.split(".")
    (facts[struct[0]] if struct else facts)[member] = value
    with pytest.raises(InvalidArgument, match=name):
        view_from_facts(facts)
