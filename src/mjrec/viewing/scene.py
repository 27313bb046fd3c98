# SPDX-License-Identifier: Apache-2.0
"""A model as a viser scene, exported to an HTML page."""

from __future__ import annotations

import contextlib
import io

import mujoco
import viser

from .geometry import mesh_of, sky, soft_mesh
from .motion import Motion, Shape, Stage

_LIGHT = 1.6
_TRANSPARENT = 0.999


def scene_page(stage: Stage, motion: Motion) -> str:
    """Return an HTML page with all shapes of a stage, in the motion's first state."""
    # viser prints a report about its server, which nothing ever connects to.
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            _fill(server.scene, stage, motion)
            return server.get_scene_serializer().as_html()
        finally:
            server.stop()


def _fill(scene: viser.SceneApi, stage: Stage, motion: Motion) -> None:
    model = stage.model
    scene.configure_environment_map(None)
    scene.add_light_ambient("/light", intensity=_LIGHT)
    scene.set_background_image(sky(model))
    for shape in stage.soft:
        mesh = soft_mesh(model, shape)
        # Without MuJoCo's normals, its own shadow would show as stripes on it.
        scene.add_mesh_trimesh(shape.name, mesh, receive_shadow=False)
    for shape in (*stage.shapes, *stage.passing.values()):
        pose = motion.poses[shape.name][0]
        scene.add_mesh_trimesh(
            shape.name,
            mesh_of(model, shape),
            position=pose[:3],
            wxyz=pose[3:],
            cast_shadow=_casts_shadow(shape),
        )


def _casts_shadow(shape: Shape) -> bool:
    is_plane = shape.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
    is_geom = shape.object_type == int(mujoco.mjtObj.mjOBJ_GEOM)
    return is_geom and not is_plane and shape.rgba[3] > _TRANSPARENT
