# SPDX-License-Identifier: Apache-2.0
"""Fields of a model, read and set by their names."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
import pytest

from mjrec.errors import InvalidArgument
from mjrec.simulation.fields import (
    apply_fields,
    array_names,
    read_fields,
    struct_names,
)

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
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def test_what_was_read_can_be_set_in_another_model(model: mujoco.MjModel) -> None:
    """Arrays and members of structs go from one model to its copy."""
    other = copy.copy(model)
    model.site_pos[0] = (1, 2, 3)
    model.tex_data[:] = 7
    model.geom_matid[0] = 1
    model.opt.gravity[:] = 0
    model.opt.timestep = 0.125
    model.opt.disableflags = 3
    model.vis.headlight.ambient[:] = 0.25
    model.vis.global_.fovy = 60
    model.stat.extent = 5
    names = ["site_pos", "tex_data", "geom_matid", "opt.gravity", "opt.timestep"]
    names += ["opt.disableflags", "vis.headlight.ambient", "vis.global_.fovy"]
    names += ["stat.extent"]
    fields = read_fields(model, names)
    model.site_pos[0] = 9
    apply_fields(other, fields)
    assert other.site_pos.tolist() == [[1, 2, 3]]
    assert other.vis.global_.fovy == 60
    after = read_fields(other, names)
    for name in names:
        assert np.array_equal(after[name], fields[name]), name


def test_a_single_number_is_an_array_without_dimensions(model: mujoco.MjModel) -> None:
    """So that a recording holds arrays only."""
    fields = read_fields(model, ["opt.timestep", "vis.global_.offwidth"])
    assert {value.shape for value in fields.values()} == {()}
    apply_fields(model, {"vis.global_.offwidth": np.array(123.0)})
    assert model.vis.global_.offwidth == 123


def test_fields_of_the_view_go_to_camera_and_option(model: mujoco.MjModel) -> None:
    """And are left out where there is no view to set them in."""
    fields = {
        "camera.lookat": np.array([1.0, 2, 3]),
        "camera.type": np.array(1),
        "option.flags": np.zeros_like(mujoco.MjvOption().flags),
        "option.label": np.array(2),
    }
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    apply_fields(model, fields)
    apply_fields(model, fields, camera=camera, option=option)
    assert camera.lookat.tolist() == [1, 2, 3]
    assert camera.type == 1
    assert option.label == 2
    assert not option.flags.any()


def test_all_fields_have_names(model: mujoco.MjModel) -> None:
    """The names come from the bindings, whichever version it is."""
    assert {"geom_rgba", "tex_data", "hfield_data", "body_mass"} <= {*array_names()}
    members = {"opt.gravity", "opt.timestep", "vis.rgba.haze", "stat.center"}
    assert members <= {*struct_names()}
    assert len(read_fields(model, [*array_names(), *struct_names()])) > 450


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("site_colour", np.zeros(4), "has no model field 'site_colour'"),
        ("__class__", np.zeros(1), "has no model field"),
        ("opt.__class__", np.zeros(1), "has no model field"),
        ("vis.rgba.bv", np.zeros(4), "has no model field"),
        ("site_pos", np.zeros((2, 3)), r"shape \(1, 3\) here"),
        ("opt.timestep", np.zeros(2), r"shape \(\) here"),
        ("site_pos", np.array([["a", "b", "c"]]), "belongs to another model"),
        ("geom_dataid", np.array([7]), "what the model consists of"),
        ("body_geomadr", np.array([7]), "what the model consists of"),
        ("geom_type", np.array([7]), "what the model consists of"),
        ("geom_matid", np.array([2]), "indices from -1 to 1"),
        ("geom_matid", np.array([-2]), "indices from -1 to 1"),
        ("geom_matid", np.array([np.nan]), "whole numbers"),
        ("vis.quality.shadowsize", np.array(np.nan), "whole numbers"),
        ("vis.quality.shadowsize", np.array(2**40), "cannot be 1099511627776"),
    ],
)
def test_what_cannot_be_set_is_refused(
    model: mujoco.MjModel, name: str, value: Any, words: str
) -> None:
    """A file may name anything: MuJoCo would read foreign memory at a wrong index."""
    with pytest.raises(InvalidArgument, match=words):
        apply_fields(model, {name: value})
