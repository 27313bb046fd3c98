# SPDX-License-Identifier: Apache-2.0
"""What is known of an MJCF file's environment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import pytest

from mjrec.environments.gymnasium_scenes import gymnasium_scenes
from mjrec.environments.mjcf_environments import MjcfEnvironment
from mjrec.errors import UnknownName

MODEL = """
<mujoco>
  <worldbody>
    <camera name="front" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>
    <camera name="top" pos="0 0 2"/>
    <body><joint type="hinge"/><geom size=".1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "hinge.xml"
    path.write_text(MODEL)
    return path


class Overlay(gymnasium.Wrapper[Any, Any, Any, Any]):
    def render(self) -> Any:
        return super().render()


def test_pictures_follow_from_states(model: Path) -> None:
    """Wrapped or not; what overrides is named."""
    env = MjcfEnvironment(model)
    scenes = gymnasium_scenes(gymnasium.wrappers.TimeLimit(env, 3))
    assert scenes.obstacle is None
    assert scenes.environment == {
        "framework": "mjcf",
        "id": "mjcf/hinge",
        "kwargs": {},
        "wrappers": [],
        "max_episode_steps": 3,
    }
    assert "Overlay overrides render()" in str(gymnasium_scenes(Overlay(env)).obstacle)

    class Draws(MjcfEnvironment):
        def render(self) -> Any:
            return super().render()

    assert "Draws overrides render()" in str(gymnasium_scenes(Draws(model)).obstacle)


@pytest.mark.parametrize(
    ("asked", "shown"),
    [({}, ("top", 32, 40)), ({"camera": 0, "width": 8}, ("front", 32, 8))],
)
def test_begins_with_the_file_and_the_camera(
    asked: dict[str, int], shown: tuple[str, int, int], model: Path, tmp_path: Path
) -> None:
    """The environment's camera and size, or those asked for."""
    env = MjcfEnvironment(model, camera="top", height=32, width=40)
    env.reset()
    states = gymnasium_scenes(env, **asked).states
    assert states is not None
    states.open(tmp_path)
    start = states.begin_episode()
    states.finish()
    states.close()
    assert start.refusal is None
    assert start.scene is not None
    assert tuple(start.scene[name] for name in ("label", "height", "width")) == shown
    assert start.scene["max_geom"] == 10000
    assert start.model["xml"]


def test_camera_is_checked(model: Path) -> None:
    """At once."""
    with pytest.raises(UnknownName, match="front"):
        gymnasium_scenes(MjcfEnvironment(model), camera="forward")
