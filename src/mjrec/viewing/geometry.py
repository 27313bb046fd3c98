# SPDX-License-Identifier: Apache-2.0
"""A scene of meshes: MuJoCo's geoms, sites, skins and flexes, with their colors.

mjviser creates the meshes of primitives, height fields and sites. This module adds the
rest: normals and texture coordinates of meshes, cube textures, planes of the model's
size, and the colors that MuJoCo's visualizer would mix.
"""

from __future__ import annotations

import contextlib
import io
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import MissingDependency
from .motion import Motion, Shape, Stage

try:
    import trimesh
    import viser
    from mjviser.conversions import create_primitive_mesh, create_site_mesh
    from PIL import Image
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial
except ModuleNotFoundError as error:
    raise MissingDependency(
        error.name or "viser",
        purpose="A 3D replay",
        install='pip install "mjrec[replay]"',
    ) from error

_GEOM, _SITE = int(mujoco.mjtObj.mjOBJ_GEOM), int(mujoco.mjtObj.mjOBJ_SITE)
_PLANE, _MESH = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_MESH)
_FIELD, _FLEX = int(mujoco.mjtGeom.mjGEOM_HFIELD), int(mujoco.mjtGeom.mjGEOM_FLEX)
_TEXTURE_2D = int(mujoco.mjtTexture.mjTEXTURE_2D)
_COLOUR_ROLES = (
    mujoco.mjtTextureRole.mjTEXROLE_RGB,
    mujoco.mjtTextureRole.mjTEXROLE_RGBA,
)
# Half size of an infinite plane, in units of the model's extent.
_HORIZON = 30.0
_SHARP = 0.6  # radians between faces that make an edge
_GAMMA = 2.2
_AMBIENT = 0.8
# Directions and intensities of lights without shadows, beside viser's own from above.
_SIDE_LIGHTS = (((1.0, -0.7, 0.5), 1.2), ((-0.7, 1.0, 0.4), 0.6))
_TRANSPARENT = 0.999

# For each side of a cube texture, in OpenGL's order: the axis that points at it, and
# the axes of s and t, each with its sign.
_SIDES = (
    ((0, 1), (2, -1), (1, -1)),
    ((0, -1), (2, 1), (1, -1)),
    ((1, 1), (0, 1), (2, 1)),
    ((1, -1), (0, 1), (2, -1)),
    ((2, 1), (0, 1), (1, -1)),
    ((2, -1), (0, -1), (1, -1)),
)


def scene_page(stage: Stage, motion: Motion) -> str:
    """Return an HTML page with all shapes on a stage, in the motion's first state."""
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
    scene.add_light_ambient("/light", intensity=_AMBIENT)
    for number, (position, intensity) in enumerate(_SIDE_LIGHTS):
        scene.add_light_directional(
            f"/light/{number}", position=position, intensity=intensity
        )
    scene.set_background_image(sky(model))
    for shape in stage.soft:
        mesh = soft_mesh(model, shape)
        # Without MuJoCo's normals, the mesh's own shadow would appear on it as stripes.
        scene.add_mesh_trimesh(shape.name, mesh, receive_shadow=False)
    for shape in (*stage.shapes, *stage.passing.values()):
        pose = motion.poses[shape.name][0]
        scene.add_mesh_trimesh(
            shape.name,
            mesh_of(model, shape),
            position=pose[:3],
            wxyz=pose[3:],
            cast_shadow=shape.object_type == _GEOM
            and shape.geom_type != _PLANE
            and shape.rgba[3] > _TRANSPARENT,
        )


def mesh_of(model: mujoco.MjModel, shape: Shape) -> trimesh.Trimesh:
    """Return a shape's mesh in its own frame, with its color or texture.

    Args:
        model: the model that the shape belongs to.
        shape: the shape. If it is neither a geom nor a site, the result is a unit mesh
            for the page to scale: an icosphere of radius 1, a box of half size 1, or a
            cylinder of radius 1 and half length 1.
    """
    if shape.object_type == _SITE:
        return _finished(_smoothed(create_site_mesh(model, shape.object_id)), shape)
    if shape.object_type != _GEOM:
        return _finished(_unit_mesh(shape.geom_type), shape)
    geom = shape.object_id
    texture = _texture_of(model, int(model.geom_matid[geom]))
    if shape.geom_type == _PLANE:
        return _plane(model, shape, texture)
    if shape.geom_type == _MESH:
        mesh, uv = _asset_mesh(model, int(model.geom_dataid[geom]))
    else:
        mesh, uv = create_primitive_mesh(model, geom), None
        if shape.geom_type != _FIELD:
            mesh = _smoothed(mesh)
    if texture is None:
        return _finished(mesh, shape)
    if int(model.tex_type[texture]) != _TEXTURE_2D:
        # A texture whose sides are all equal contains only one.
        sides = int(model.tex_height[texture]) // int(model.tex_width[texture])
        mesh, uv = _on_cube(mesh, sides)
    elif uv is None:
        mesh, uv = _repeated(model, shape, mesh)
    return _finished(mesh, shape, uv, _image(model, texture))


def soft_mesh(model: mujoco.MjModel, shape: Shape) -> trimesh.Trimesh:
    """Return the mesh of a skin in its resting pose, or of a flex.

    Each state moves its vertices.
    """
    index = shape.object_id
    if shape.geom_type == _FLEX:
        mesh = _finished(_flex_mesh(model, index), shape)
        # Cloth is visible from both sides.
        mesh.visual.material.doubleSided = bool(model.flex_dim[index] == 2)
        return mesh
    vertices = _part(model.skin_vert, model.skin_vertadr, model.skin_vertnum, index)
    faces = _part(model.skin_face, model.skin_faceadr, model.skin_facenum, index)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    first = int(model.skin_texcoordadr[index])
    texture = _texture_of(model, int(model.skin_matid[index]))
    if texture is None or first < 0:
        return _finished(mesh, shape)
    uv = model.skin_texcoord[first : first + len(vertices)]
    return _finished(mesh, shape, uv, _image(model, texture))


def linear(rgba: Any) -> list[float]:
    """Return a color for the page, whose lighting is linear, unlike MuJoCo's."""
    red, green, blue, alpha = (float(channel) for channel in rgba)
    return [*(max(0.0, c) ** _GAMMA for c in (red, green, blue)), alpha]


def sky(model: mujoco.MjModel) -> NDArray[np.uint8]:
    """Return the model's sky as a narrow image, top to bottom; black without a sky."""
    kinds = model.tex_type.tolist()
    if int(mujoco.mjtTexture.mjTEXTURE_SKYBOX) not in kinds:
        return np.zeros((2, 2, 3), np.uint8)
    texture = kinds.index(int(mujoco.mjtTexture.mjTEXTURE_SKYBOX))
    pixels = np.asarray(_image(model, texture))
    width = pixels.shape[1]
    # The second-to-last side is a vertical one.
    side = pixels[-2 * width : -width] if len(pixels) == 6 * width else pixels
    column = side.mean(axis=1, keepdims=True).astype(np.uint8)
    return np.repeat(column, 2, axis=1)


def _finished(
    mesh: trimesh.Trimesh,
    shape: Shape,
    uv: NDArray[Any] | None = None,
    image: Image.Image | None = None,
) -> trimesh.Trimesh:
    """Return a mesh with its color, and its texture if there is one."""
    rgba, texture = shape.rgba, None
    if image is not None:
        # glTF's texture origin is at the top of the image, and trimesh's at the bottom.
        texture = image.transpose(Image.Transpose.FLIP_TOP_BOTTOM)
    material = PBRMaterial(
        baseColorFactor=linear(rgba),
        baseColorTexture=texture,
        metallicFactor=0.0,
        roughnessFactor=1.0,
        alphaMode="BLEND" if rgba[3] < 1 else "OPAQUE",
    )
    mesh.visual = TextureVisuals(uv=uv, material=material)
    # trimesh exports normals only if they are known. Without them, the page would show
    # every triangle flat.
    mesh.vertex_normals = mesh.vertex_normals
    return mesh


def _texture_of(model: mujoco.MjModel, material: int) -> int | None:
    if material < 0:
        return None
    ids = (int(model.mat_texid[material, int(role)]) for role in _COLOUR_ROLES)
    return next((texture for texture in ids if texture >= 0), None)


def _image(model: mujoco.MjModel, texture: int) -> Image.Image:
    height, width = int(model.tex_height[texture]), int(model.tex_width[texture])
    channels, first = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    data = model.tex_data[first : first + height * width * channels]
    pixels = data.reshape(height, width, channels)
    return Image.fromarray(np.ascontiguousarray(pixels.squeeze())).convert("RGB")


def _part(
    array: NDArray[Any], first: NDArray[Any], count: NDArray[Any], index: int
) -> NDArray[Any]:
    return array[first[index] : first[index] + count[index]]


def _asset_mesh(
    model: mujoco.MjModel, mesh: int
) -> tuple[trimesh.Trimesh, NDArray[Any] | None]:
    """Return a mesh, and its texture coordinates if it has any.

    Vertices are split by normal and texture coordinate, because the page computes its
    own normals and would otherwise smooth sharp edges.
    """
    vertices = _part(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum, mesh)
    parts = [model.mesh_face, model.mesh_facenormal]
    has_uv = model.mesh_texcoordnum[mesh] > 0
    if has_uv:
        parts.append(model.mesh_facetexcoord)
    faces = [_part(p, model.mesh_faceadr, model.mesh_facenum, mesh) for p in parts]
    corners = np.stack(faces, axis=-1).reshape(-1, len(parts))
    unique, inverse = np.unique(corners, axis=0, return_inverse=True)
    made = trimesh.Trimesh(
        vertices[unique[:, 0]], inverse.reshape(-1, 3), process=False
    )
    if not has_uv:
        return made, None
    args = (model.mesh_texcoord, model.mesh_texcoordadr, model.mesh_texcoordnum, mesh)
    return made, _part(*args)[unique[:, 2]]


def _flex_mesh(model: mujoco.MjModel, flex: int) -> trimesh.Trimesh:
    """Return the triangles of a 2D flex, or of a 3D flex's shell."""
    # `flex_vert` is zero if each vertex has a body. A mesh whose vertices equal its
    # normals would share their memory in the page, which then loses the vertices.
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_flex(model, data)
    places = data.flexvert_xpos
    vertices = _part(places, model.flex_vertadr, model.flex_vertnum, flex)
    if model.flex_dim[flex] == 2:
        lists = (model.flex_elem, model.flex_elemdataadr, 3 * model.flex_elemnum)
    else:
        lists = (model.flex_shell, model.flex_shelldataadr, 3 * model.flex_shellnum)
    faces = _part(*lists, flex).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, process=False)


def _plane(model: mujoco.MjModel, shape: Shape, texture: int | None) -> trimesh.Trimesh:
    """Return a plane of the model's size; an infinite one extends to the horizon."""
    size = model.geom_size[shape.object_id][:2]
    is_infinite = size <= 0
    half = np.where(is_infinite, _HORIZON * max(1.0, model.stat.extent), size)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    vertices = np.column_stack([corners * half, np.zeros(4)])
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], process=False)
    if texture is None or int(model.tex_type[texture]) != _TEXTURE_2D:
        return _finished(mesh, shape)
    material = int(model.geom_matid[shape.object_id])
    repeat = model.mat_texrepeat[material].astype(float)
    # Half of the texture spans half of the plane, or one unit of length. It starts at
    # the upper left corner, or at the middle of an infinite plane.
    per_length = is_infinite | bool(model.mat_texuniform[material])
    length = np.where(per_length, 1.0, half)
    begin = np.where(is_infinite, 0.0, half * [-1, 1])
    uv = 0.5 * repeat * (vertices[:, :2] - begin) * [1, -1] / length
    return _finished(mesh, shape, uv, _image(model, texture))


def _smoothed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh with smooth round parts and sharp edges."""
    made: trimesh.Trimesh = trimesh.graph.smooth_shade(
        mesh, angle=_SHARP, facet_minarea=None
    )
    return made


def _repeated(
    model: mujoco.MjModel, shape: Shape, mesh: trimesh.Trimesh
) -> tuple[trimesh.Trimesh, NDArray[np.float64]]:
    """Return a mesh split for a repeated 2D texture, and its texture coordinates.

    Each side of a primitive shows the texture. On a height field, or a mesh without
    texture coordinates, the texture is projected along z.
    """
    material = int(model.geom_matid[shape.object_id])
    half = np.maximum(mesh.extents[:2] / 2, 1e-9)
    repeat = model.mat_texrepeat[material].astype(float)
    if model.mat_texuniform[material]:
        repeat *= half
    if shape.geom_type in (_MESH, _FIELD):
        flat = np.asarray(mesh.vertices[:, :2], float)
        return mesh, 0.5 * repeat * flat * [1, -1] / half - 0.5
    mesh, uv = _on_cube(mesh, 1)
    return mesh, uv * repeat


def _on_cube(
    mesh: trimesh.Trimesh, sides: int
) -> tuple[trimesh.Trimesh, NDArray[np.float64]]:
    """Return a mesh split for a cube texture, and its texture coordinates.

    Args:
        mesh: the mesh.
        sides: number of the texture's sides, stacked vertically in one image: six, or
            one that is used six times.
    """
    extents = np.maximum(mesh.extents / 2, 1e-9)
    directions = mesh.vertices / extents
    middles = directions[mesh.faces].mean(axis=1)
    axis = np.abs(middles).argmax(axis=1)
    side = 2 * axis + (middles[np.arange(len(axis)), axis] < 0)
    corners = np.column_stack([mesh.faces.ravel(), np.repeat(side, 3)])
    unique, inverse = np.unique(corners, axis=0, return_inverse=True)
    uv = np.empty((len(unique), 2))
    for number, ((major, _), *across) in enumerate(_SIDES):
        here = unique[:, 1] == number
        at = directions[unique[here, 0]]
        depth = np.maximum(np.abs(at[:, major]), 1e-9)
        s, t = (np.clip((at[:, i] * sign / depth + 1) / 2, 0, 1) for i, sign in across)
        uv[here] = np.column_stack([s, (number % sides + t) / sides])
    made = trimesh.Trimesh(
        mesh.vertices[unique[:, 0]], inverse.reshape(-1, 3), process=False
    )
    return made, uv


def _unit_mesh(geom_type: int) -> trimesh.Trimesh:
    round_types = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID)
    if geom_type in [int(kind) for kind in round_types]:
        return trimesh.creation.icosphere(subdivisions=2)
    if geom_type == int(mujoco.mjtGeom.mjGEOM_BOX):
        return _smoothed(trimesh.creation.box((2, 2, 2)))
    return _smoothed(trimesh.creation.cylinder(radius=1, height=2, sections=12))
