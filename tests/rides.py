# SPDX-License-Identifier: Apache-2.0
"""Record a short episode that is hard to rerender.

The camera rides over an infinite plane, which MuJoCo centers on the camera of the
previous frame, while terrain, a texture and a color change.
"""

from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from trajectories_by_hand import add_row, new_logs

from mjrec.formats.trajectory import ModelChange, row_dtype
from mjrec.simulation.cameras import resolve_camera
from mjrec.simulation.captured_arrays import snapshot_dtype
from mjrec.simulation.fields import read_fields
from mjrec.simulation.model_store import ModelStore
from mjrec.simulation.renderer import SceneRenderer
from mjrec.simulation.snapshot import SnapshotSource
from mjrec.simulation.view import SceneView

HEIGHT, WIDTH = 48, 64
FRAMES = 9

PLAIN = """
<mujoco>
  <visual><quality shadowsize="256"/><map zfar="50"/></visual>
  <asset>
    <texture name="checks" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1"
      width="32" height="32"/>
    <material name="cloth" texture="checks" texrepeat="1.7 1.7"/>
    <hfield name="hills" nrow="8" ncol="8" size=".4 .4 .3 .1"/>
  </asset>
  <worldbody>
    <light directional="true" dir="0 .3 -1"/>
    <camera name="side" pos="4 -5 3" xyaxes="1 0 0 0 .6 .8"/>
    <geom type="plane" size="0 0 1" material="cloth"/>
    <body pos="0 0 .5"><joint type="slide" axis="1 .3 0"/>
      <geom name="ball" size=".2" rgba="1 1 0 1"/>
      <geom type="hfield" hfield="hills" pos=".6 .3 .05"/>
      <camera name="rider" pos="0 -2 1" xyaxes="1 0 0 0 .4 .9"/></body>
  </worldbody>
</mujoco>
"""


class Ride(NamedTuple):
    path: Path
    frames: list


def start(xml=PLAIN):
    model = mujoco.MjModel.from_xml_string(xml)
    return model, mujoco.MjData(model)


def move(model, data, number):
    """Move to the position for a frame, in uneven steps."""
    data.qpos[0] = 3.1 * number + 2 * (number % 3)
    mujoco.mj_forward(model, data)


def change(model, number):
    """Change the model before a frame, and return the changed fields."""
    if number == 3:
        model.hfield_data[20:40] = 1
        return ["hfield_data"]
    if number == 5:
        model.tex_data[: model.tex_data.size // 2] = 200
        return ["tex_data"]
    if number > 5:
        model.geom("ball").rgba = (0, 1, number / 10, 1)
        return ["geom_rgba"]
    return []


def record(directory, *, camera="rider", fresh=False, count=FRAMES, facts=None):
    """Record a ride as a log, and return the log and its frames."""
    model, data = start()
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_INERTIA] = True
    shown = resolve_camera(model, camera)
    size = {"height": HEIGHT, "width": WIDTH, "max_geom": 1000, "fresh": fresh}
    view = SceneView(camera=shown, option=option, label="rider", **size)
    kind = snapshot_dtype(model, data, option)
    store = ModelStore(directory)
    facts = {
        "episode_id": 0,
        "infix": "0.1",
        "model": store.add(model),
        "scene": view.facts(),
        "video": {"quality": "full"},
        "rate": "20",
        "stride": 2,
        **(facts or {}),
    }
    store.finish()
    source = SnapshotSource(model, data, kind)
    logs = new_logs(directory, "0.1")
    name = "openaigym.trajectory.0.1.episode000000"
    span = logs.begin(name, facts, row_dtype(snapshot=kind))
    snapshot = np.empty(kind.itemsize // 8, np.uint64)
    frames = []
    with SceneRenderer(model, camera=shown, scene_option=option, **size) as renderer:
        for number in range(count):
            names = change(model, number)
            move(model, data, number)
            # Each frame covers two steps.
            for step in sorted({max(2 * number - 1, 0), 2 * number}):
                add_row(span, step)
            if names:
                fields = read_fields(model, names)
                span.log.add_change(ModelChange(step=2 * number, fields=fields))
            source.take(snapshot)
            add_row(span, 2 * number, snapshot=snapshot, is_step=False)
            renderer.model_changed()
            frames.append(renderer.render(data))
    logs.close()
    return Ride(logs.path_of(name), frames)
