# SPDX-License-Identifier: Apache-2.0
"""How a scene is shown, as facts and back."""

from __future__ import annotations

import json
from typing import Any

import mujoco
import pytest

from mjrec.errors import InvalidArgument
from mjrec.simulation.view import SceneView, view_from_facts


@pytest.fixture
def view() -> SceneView:
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.lookat[:] = (0.1, 1 / 3, -7)
    camera.distance = 2.3
    camera.fixedcamid = 4
    option.flags[int(mujoco.mjtVisFlag.mjVIS_RANGEFINDER)] = False
    option.sitegroup[4] = True
    option.label = 3
    return SceneView(
        camera=camera,
        option=option,
        max_geom=1000,
        fresh=True,
        height=48,
        width=64,
        label="side",
    )


def test_facts_are_json_and_come_back_as_the_same_view(view: SceneView) -> None:
    """To the last bit, and with every member there is."""
    facts = json.loads(json.dumps(view.facts()))
    again = view_from_facts(facts)
    assert again.camera.lookat.tobytes() == view.camera.lookat.tobytes()
    assert again.option.flags.tolist() == view.option.flags.tolist()
    assert again.option.sitegroup.tolist() == view.option.sitegroup.tolist()
    assert (again.max_geom, again.fresh, again.label) == (1000, True, "side")
    assert (again.height, again.width) == (48, 64)
    assert again.facts() == facts
    assert facts["previous_cameras"] is None
    assert {"flags", "label", "frame", "bvh_depth"} <= facts["option"].keys()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("camera", None),
        ("camera", {"type": 0}),
        ("option", "all"),
        ("max_geom", 0),
        ("max_geom", True),
        ("max_geom", 1 << 40),
        ("height", 1 << 40),
        ("height", "48"),
        ("width", None),
        ("lookat of a camera", [0, 1]),
        ("lookat of a camera", ["a", "b", "c"]),
        ("type of a camera", None),
        ("flags of a option", [True]),
        ("label of a option", [1]),
        ("label of a option", 1 << 30),
        ("label of a option", -1),
        ("frame of a option", 0.5),
        ("frame of a option", 1 << 30),
    ],
)
def test_facts_that_cannot_be_are_refused_by_name(
    view: SceneView, name: str, value: Any
) -> None:
    """They may come from a file."""
    facts = view.facts()
    member, _, struct = name.partition(" of a ")
    (facts[struct] if struct else facts)[member] = value
    with pytest.raises(InvalidArgument, match=name):
        view_from_facts(facts)
