# SPDX-License-Identifier: Apache-2.0
"""Test fields of models and facts of views, as they are named in files."""

import mujoco
import numpy as np
import pytest

from mjrec.errors import InvalidArgument
from mjrec.simulation.fields import apply_fields
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


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("site_color", np.zeros(4), "has no model field 'site_color'"),
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
        ("option.label", np.array(1 << 30), "must be between 0 and"),
    ],
)
def test_invalid_fields_are_rejected(name, value, words):
    """With an invalid index, MuJoCo would read memory out of bounds."""
    model = mujoco.MjModel.from_xml_string(XML)
    with pytest.raises(InvalidArgument, match=words):
        apply_fields(model, {name: value}, option=mujoco.MjvOption())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("camera", None), ("camera", {"type": 0}), ("camera.type", None)),
        *(("camera.lookat", [0, 1]), ("camera.lookat", ["a", "b", "c"])),
        *(("max_geom", 0), ("max_geom", 1 << 40), ("height", "48")),
        *(("option.flags", [True]), ("option.label", -1)),
        *(("option.frame", 0.5), ("option.frame", 1 << 30)),
        *(("label", ["side"]), ("label", "x" * 10_000)),
    ],
)
def test_invalid_facts_of_a_view_are_rejected_by_name(name, value):
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    more = {"max_geom": 1000, "fresh": True, "height": 48, "width": 64}
    facts = SceneView(camera=camera, option=option, label="side", **more).facts()
    *struct, member = name.split(".")
    (facts[struct[0]] if struct else facts)[member] = value
    with pytest.raises(InvalidArgument, match=name):
        view_from_facts(facts)
