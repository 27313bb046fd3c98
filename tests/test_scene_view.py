# SPDX-License-Identifier: Apache-2.0
"""How a scene is shown, as facts and back, and what somebody changes of it."""

from __future__ import annotations

import json
from typing import Any

import mujoco
import numpy as np
import pytest

from mjrec.errors import InvalidArgument
from mjrec.simulation import scene_view
from mjrec.simulation.scene_view import SceneView, ViewMemory, scene_view_from_facts


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
    again = scene_view_from_facts(facts)
    assert again.camera.lookat.tobytes() == view.camera.lookat.tobytes()
    assert again.option.flags.tolist() == view.option.flags.tolist()
    assert again.option.sitegroup.tolist() == view.option.sitegroup.tolist()
    assert (again.max_geom, again.fresh, again.label) == (1000, True, "side")
    assert (again.height, again.width) == (48, 64)
    assert again.facts() == facts
    assert facts["previous_cameras"] is None
    assert {"flags", "label", "frame", "bvh_depth"} <= facts["option"].keys()


@pytest.mark.parametrize(
    "change",
    [
        {"camera": None},
        {"camera": {"type": 0}},
        {"option": "all"},
        {"max_geom": 0},
        {"max_geom": True},
        {"max_geom": 1 << 40},
        {"height": 1 << 40},
        {"height": "48"},
        {"width": None},
    ],
)
def test_facts_that_cannot_be_are_refused(view: SceneView, change: Any) -> None:
    """They may come from a file."""
    with pytest.raises(InvalidArgument):
        scene_view_from_facts({**view.facts(), **change})


@pytest.mark.parametrize(
    ("struct", "name", "value"),
    [
        ("camera", "lookat", [0, 1]),
        ("camera", "lookat", ["a", "b", "c"]),
        ("camera", "type", None),
        ("option", "flags", [True]),
        ("option", "label", [1]),
        ("option", "label", 1 << 30),
        ("option", "label", -1),
        ("option", "frame", 0.5),
        ("option", "frame", 1 << 30),
    ],
)
def test_members_that_cannot_be_are_refused(
    view: SceneView, struct: str, name: str, value: Any
) -> None:
    """The message names the member."""
    facts = view.facts()
    facts[struct][name] = value
    with pytest.raises(InvalidArgument, match=f"{name} of a {struct}"):
        scene_view_from_facts(facts)


def _change_everything(struct: Any, name: str) -> Any:
    value = getattr(struct, name)
    if isinstance(value, np.ndarray):
        value[-1] = value[-1] + 1
    else:
        setattr(struct, name, value + 1)
    return getattr(struct, name)


@pytest.mark.parametrize("quick", [True, False])
@pytest.mark.parametrize("which", ["camera", "option"])
def test_every_member_is_watched(
    view: SceneView, which: str, quick: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One change, one name, once; also where memory has to be read by attributes."""
    if not quick:
        monkeypatch.setattr(scene_view, "_places", lambda kind: None)
    memory = ViewMemory(view)
    assert memory.changed() is None
    for name in view.facts()[which]:
        value = _change_everything(getattr(view, which), name)
        changed = memory.changed()
        assert changed is not None
        assert list(changed) == [f"{which}.{name}"]
        assert np.array_equal(changed[f"{which}.{name}"], value)
        assert memory.changed() is None
