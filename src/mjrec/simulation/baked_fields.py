# SPDX-License-Identifier: Apache-2.0
"""The fields of a model that an `MjrContext` keeps a copy of.

Most of a model is read anew for every picture. What is here was copied to the graphics
card, or compiled into a display list, when the context was made, and a later change
does not show until it is uploaded or the context is made anew.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import mujoco
import numpy as np

_HFIELD = ("hfield_data", "hfield_size")
_TEXTURE = ("tex_data",)
_MESH = (
    "mesh_vert",
    "mesh_normal",
    "mesh_texcoord",
    "mesh_face",
    "mesh_facenormal",
    "mesh_facetexcoord",
    "mesh_graph",
)
# Not uploadable one by one. Absent from some versions of mujoco: tex_colorspace.
_WHOLE = (
    "mat_texid",
    "skin_face",
    "skin_texcoord",
    "tex_type",
    "tex_width",
    "tex_height",
    "tex_nchannel",
    "tex_colorspace",
)
_VISUAL = {
    "map": ("fogstart", "fogend", "haze", "shadowclip", "shadowscale"),
    "rgba": ("fog", "haze"),
    "quality": ("shadowsize", "offsamples", "numslices", "numstacks", "numquads"),
    "global_": ("linewidth",),
}


@dataclass(frozen=True, kw_only=True)
class BakedFields:
    """Digests of what a context keeps, by what brings it up to date.

    Attributes:
        hfields: `mjr_uploadHField`.
        textures: `mjr_uploadTexture`.
        meshes: `mjr_uploadMesh`.
        whole: a new context.
    """

    hfields: bytes
    textures: bytes
    meshes: bytes
    whole: bytes

    @classmethod
    def of(cls, model: mujoco.MjModel) -> BakedFields:
        """Return the digests of `model` as it is now."""
        return cls(
            hfields=_digest(_arrays(model, _HFIELD)),
            textures=_digest(_arrays(model, _TEXTURE)),
            meshes=_digest(_arrays(model, _MESH)),
            whole=_digest(_needing_new_context(model)),
        )

    def changed_since(self, earlier: BakedFields) -> set[str]:
        """Return the names of the attributes that differ."""
        names = (field.name for field in fields(self))
        return {name for name in names if getattr(self, name) != getattr(earlier, name)}


def is_kept_by_context(name: str) -> bool:
    """Tell whether a context may keep a field of this name.

    Args:
        name: of an array of `MjModel` (`tex_data`), or of a member of its structs
            (`vis.map.haze`).
    """
    struct, _, member = name.partition(".")
    if struct == "vis":
        group, _, last = member.partition(".")
        return last in _VISUAL.get(group, ())
    arrays = (*_HFIELD, *_TEXTURE, *_MESH, *_WHOLE)
    # Of planes only, which its name does not tell.
    return name in (*arrays, "geom_type", "geom_size")


def _needing_new_context(model: mujoco.MjModel) -> Iterable[Any]:
    yield from _arrays(model, _WHOLE)
    # Each plane has a display list; other geoms are scaled as they are drawn.
    is_plane = model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
    yield is_plane
    yield model.geom_size[is_plane]
    for group, names in _VISUAL.items():
        for name in names:
            yield getattr(getattr(model.vis, group), name)


def _arrays(model: mujoco.MjModel, names: Iterable[str]) -> Iterable[Any]:
    return (getattr(model, name) for name in names if hasattr(model, name))


def _digest(values: Iterable[Any]) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for value in values:
        digest.update(np.ascontiguousarray(value).data)
    return digest.digest()
