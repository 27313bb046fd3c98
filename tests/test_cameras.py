# SPDX-License-Identifier: Apache-2.0

import types

import mujoco
import numpy as np
import pytest

from mjrec.errors import InvalidArgument, UnknownName
from mjrec.simulation.cameras import (
    camera_label,
    camera_names,
    raw_model,
    resolve_camera,
    tracking_camera,
)


def model_with(cameras="", inside=""):
    robot = f'<body pos="0 0 1"><freejoint/><geom size=".1"/>{inside}</body>'
    return mujoco.MjModel.from_xml_string(
        '<mujoco><visual><global azimuth="30" elevation="-70"/></visual>'
        f"<worldbody>{cameras}{robot}</worldbody></mujoco>"
    )


FRONT_AND_SIDE = '<camera name="front"/><camera/><camera name="side"/>'


@pytest.mark.parametrize(
    ("camera", "number", "label"),
    [("side", 2, "side"), (0, 0, "front"), (np.int64(1), 1, 1)],
)
def test_camera_is_found_by_name_or_number(camera, number, label):
    """The label is the camera's name or, if it has none, its number."""
    model = model_with(FRONT_AND_SIDE)
    assert camera_names(model) == ["front", "side"]
    for given in (model, types.SimpleNamespace(ptr=model)):
        resolved = resolve_camera(given, camera)
        assert int(resolved.type) == int(mujoco.mjtCamera.mjCAMERA_FIXED)
        assert resolved.fixedcamid == number
    assert camera_label(model, camera) == camera_label(model, resolved) == label
    with pytest.raises(InvalidArgument, match=r"MjModel.*not mujoco.*MjData"):
        raw_model(mujoco.MjData(model))


def test_free_camera_is_the_models_default_or_the_given_object():
    model = model_with()
    expected = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, expected)
    camera = resolve_camera(model, -1)
    assert (camera.azimuth, camera.elevation) == (30, -70)
    assert camera.lookat.tolist() == expected.lookat.tolist()
    assert camera.distance == expected.distance
    assert resolve_camera(model, camera) is camera
    assert camera_label(model, -1) == -1
    # A pose from metadata is also accepted as a camera.
    label = camera_label(model, camera)
    assert camera_label(model, resolve_camera(model, label)) == label
    with pytest.raises(InvalidArgument, match="zoom"):
        resolve_camera(model, {"zoom": 2})
    with pytest.raises(InvalidArgument, match="from 0 to 1 in this model"):
        resolve_camera(model, {"type": 1, "trackbodyid": 9})


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ("frnt", r"front, side\..*-1"),
        # An empty name must not select the unnamed camera, nor True camera 1.
        ("", r"front, side\..*-1"),
        (-2, r"number -2\b.* from -1 .* to 2"),
        (3, r"number 3\b.* from -1 .* to 2"),
        *((other, "must be a name, a number or") for other in (True, 0.0, None)),
    ],
)
def test_error_for_an_unknown_camera_lists_the_valid_ones(camera, message):
    with pytest.raises(InvalidArgument, match=message) as caught:
        resolve_camera(model_with(FRONT_AND_SIDE), camera)
    if isinstance(caught.value, UnknownName):
        assert caught.value.available == ["front", "side"]


PART = '<camera name="trunk" mode="track"/>'
ROBOT = '<camera name="robot" mode="trackcom"/>'
ARM = """
    <body><joint/><geom size=".1"/>
      <body><joint type="slide"/><geom size=".1"/>
        <camera name="hand" mode="track"/>
      </body>
    </body>
"""


@pytest.mark.parametrize(
    ("cameras", "inside", "found"),
    [
        # A fixed camera on a robot moves with the robot but does not track it.
        (FRONT_AND_SIDE, '<camera name="eye"/>', None),
        (FRONT_AND_SIDE, ROBOT + '<camera name="a" mode="trackcom"/>', "robot"),
        # A camera on the whole robot is preferred to one on a part.
        ("", PART, "trunk"),
        ("", PART + ROBOT, "robot"),
        # Tracking a fixed arm's hand, as in dm_control's reacher, gives a close-up.
        (ARM, "", None),
        (ARM, PART, "trunk"),
        (FRONT_AND_SIDE, '<camera mode="trackcom"/>', 3),
    ],
)
def test_tracking_camera_follows_the_robot(cameras, inside, found):
    assert tracking_camera(model_with(cameras, inside)) == found
