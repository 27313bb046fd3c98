# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from mjrec.errors import InvalidArgument, UnknownName
from mjrec.simulation.cameras import (
    camera_label,
    camera_names,
    raw_data,
    raw_model,
    resolve_camera,
    tracking_camera,
)


class Wrapper:
    """Like dm_control's wrappers of models and data."""

    def __init__(self, ptr: object) -> None:
        self.ptr = ptr


def model_with(cameras: str = "", inside: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f"""
        <mujoco>
          <visual><global azimuth="30" elevation="-70"/></visual>
          <worldbody>
            {cameras}
            <body name="robot" pos="0 0 1"><freejoint/><geom size=".1"/>{inside}</body>
          </worldbody>
        </mujoco>
        """
    )


FRONT_AND_SIDE = '<camera name="front"/><camera/><camera name="side"/>'


def test_names_are_in_the_models_order_without_the_nameless() -> None:
    """A camera without a name can be given by number only."""
    assert camera_names(model_with(FRONT_AND_SIDE)) == ["front", "side"]


def test_a_name_is_that_camera() -> None:
    """The third camera of the model is the second one with a name."""
    camera = resolve_camera(model_with(FRONT_AND_SIDE), "side")

    assert int(camera.type) == int(mujoco.mjtCamera.mjCAMERA_FIXED)
    assert camera.fixedcamid == 2


@pytest.mark.parametrize("number", [0, 2, np.int64(1)])
def test_a_number_is_that_camera(number: int) -> None:
    """NumPy's integers are numbers too."""
    camera = resolve_camera(model_with(FRONT_AND_SIDE), number)

    assert int(camera.type) == int(mujoco.mjtCamera.mjCAMERA_FIXED)
    assert camera.fixedcamid == number


def test_minus_one_is_the_free_camera_where_the_model_puts_it() -> None:
    """It is what `mjv_defaultFreeCamera` says."""
    model = model_with()
    expected = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, expected)

    camera = resolve_camera(model, -1)

    assert int(camera.type) == int(mujoco.mjtCamera.mjCAMERA_FREE)
    assert (camera.azimuth, camera.elevation) == (30, -70)
    assert camera.lookat.tolist() == expected.lookat.tolist()
    assert camera.distance == expected.distance


def test_an_mjv_camera_is_given_back() -> None:
    """The same object, so that its owner may move it."""
    camera = mujoco.MjvCamera()

    assert resolve_camera(model_with(), camera) is camera


@pytest.mark.parametrize("name", ["frnt", ""])
def test_an_unknown_name_lists_the_names_there_are(name: str) -> None:
    """An empty name is not the nameless camera."""
    with pytest.raises(UnknownName, match=r"front, side\..*-1") as caught:
        resolve_camera(model_with(FRONT_AND_SIDE), name)

    assert (caught.value.kind, caught.value.name) == ("camera", name)
    assert caught.value.available == ["front", "side"]


@pytest.mark.parametrize("number", [-2, 3])
def test_a_number_out_of_range_names_the_range(number: int) -> None:
    """-1 is the free camera, 2 the last of three."""
    with pytest.raises(InvalidArgument, match=rf"number {number}\b.* from -1 .* to 2"):
        resolve_camera(model_with(FRONT_AND_SIDE), number)


@pytest.mark.parametrize("camera", [True, 0.0, None, ["front"]])
def test_anything_else_is_no_camera(camera: Any) -> None:
    """True is not camera 1."""
    with pytest.raises(InvalidArgument, match="A camera is a name, a number or"):
        resolve_camera(model_with(FRONT_AND_SIDE), camera)


def test_wrappers_are_opened() -> None:
    """dm_control's objects hold MuJoCo's as `.ptr`."""
    model = model_with(FRONT_AND_SIDE)
    data = mujoco.MjData(model)

    assert raw_model(Wrapper(model)) is model
    assert raw_model(model) is model
    assert raw_data(Wrapper(data)) is data
    assert raw_data(data) is data
    assert camera_names(Wrapper(model)) == ["front", "side"]
    assert resolve_camera(Wrapper(model), "side").fixedcamid == 2
    assert tracking_camera(Wrapper(model)) is None


def test_what_is_no_model_is_named() -> None:
    """Data where a model belongs is an error, not a crash."""
    data = mujoco.MjData(model_with())

    with pytest.raises(InvalidArgument, match=r"MjModel.*got mujoco.*MjData"):
        raw_model(data)
    with pytest.raises(InvalidArgument, match=r"MjData.*got .*Wrapper"):
        raw_data(Wrapper(3))


def test_no_camera_follows_anything() -> None:
    """A fixed camera on a robot moves with it but does not follow it."""
    assert tracking_camera(model_with(FRONT_AND_SIDE, '<camera name="eye"/>')) is None


def test_the_first_camera_that_follows_is_chosen() -> None:
    """In the model's order, after those that do not follow."""
    inside = '<camera name="b" mode="trackcom"/><camera name="a" mode="trackcom"/>'

    assert tracking_camera(model_with(FRONT_AND_SIDE, inside)) == "b"


def test_following_the_robot_comes_before_following_a_part() -> None:
    """`trackcom` before `track`, which is all that some models have."""
    part = '<camera name="trunk" mode="track"/>'

    assert tracking_camera(model_with("", part)) == "trunk"
    robot = '<camera name="robot" mode="trackcom"/>'
    assert tracking_camera(model_with("", part + robot)) == "robot"


def test_a_camera_on_the_hand_of_a_fixed_arm_follows_no_robot() -> None:
    """It would show a close-up; dm_control's reacher and manipulator have one."""
    arm = """
        <body><joint/><geom size=".1"/>
          <body><joint type="slide"/><geom size=".1"/>
            <camera name="hand" mode="track"/>
          </body>
        </body>
    """

    assert tracking_camera(model_with(arm)) is None
    robot = '<camera name="robot" mode="track"/>'
    assert tracking_camera(model_with(arm, robot)) == "robot"


def test_a_nameless_camera_that_follows_is_a_number() -> None:
    """The number can be resolved again."""
    model = model_with(FRONT_AND_SIDE, '<camera mode="trackcom"/>')

    assert tracking_camera(model) == 3
    assert resolve_camera(model, 3).fixedcamid == 3


def test_labels_of_cameras() -> None:
    """A name where there is one, else a number, else where a free camera is."""
    model = model_with('<camera name="above"/>')
    free = mujoco.MjvCamera()
    free.distance = 3
    fixed = mujoco.MjvCamera()
    fixed.type = mujoco.mjtCamera.mjCAMERA_FIXED
    fixed.fixedcamid = 0
    assert camera_label(model, "above") == "above"
    assert camera_label(model, 0) == "above"
    assert camera_label(model, -1) == -1
    assert camera_label(model, fixed) == "above"
    label = camera_label(model, free)
    assert isinstance(label, dict)
    assert label["distance"] == 3
