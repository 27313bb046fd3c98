# SPDX-License-Identifier: Apache-2.0
"""Plugins that add to a picture what no array of the simulation holds.

MuJoCo calls a plugin's `visualize` whenever a scene is put together. What it draws may
come from its own memory, and may show only at times (a touch grid draws nothing until
something touches it), so that looking at one scene does not tell.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import Any

import mujoco

# The one plugin that comes with MuJoCo and draws only if told to: with this attribute
# it paints the geoms of its bodies, in the model itself.
_CABLE = "mujoco.elasticity.cable"
_CABLE_PAINTS = "vmax"


class _Plugin(ctypes.Structure):
    """The beginning of `mjpPlugin` (mjplugin.h), the same from mujoco 3.3 to 4.0."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("nattribute", ctypes.c_int),
        ("attributes", ctypes.POINTER(ctypes.c_char_p)),
        ("capabilityflags", ctypes.c_int),
        ("needstage", ctypes.c_int),
        *(
            (name, ctypes.c_void_p)
            for name in (
                *("nstate", "nsensordata", "init", "destroy", "copy", "reset"),
                *("compute", "advance", "visualize"),
            )
        ),
    )


def drawing_plugin(model: mujoco.MjModel) -> str | None:
    """Return the name of a plugin of `model` that draws; None where there is none.

    A plugin that cannot be looked at counts as one that draws.
    """
    for instance in range(model.nplugin):
        plugin = _registered(int(model.plugin[instance]))
        if plugin is None:
            return f"number {instance}, which cannot be looked at,"
        name = (plugin.name or b"").decode(errors="replace")
        if plugin.visualize and not _is_plain_cable(model, instance, plugin):
            return name
    return None


def _is_plain_cable(model: mujoco.MjModel, instance: int, plugin: Any) -> bool:
    if plugin.name != _CABLE.encode():
        return False
    names = [plugin.attributes[i].decode() for i in range(plugin.nattribute)]
    value = _attributes(model, instance, len(names))[names.index(_CABLE_PAINTS)]
    try:
        return not float(value or 0)
    except ValueError:
        return False


def _attributes(model: mujoco.MjModel, instance: int, count: int) -> list[str]:
    """Return the values of an instance's attributes, empty where there are none."""
    text = bytes(model.plugin_attr[model.plugin_attradr[instance] :])
    return [value.decode(errors="replace") for value in text.split(b"\0")[:count]]


@functools.cache
def _library() -> Any:
    # Loaded already; this only finds it again.
    folder = Path(mujoco.__file__).parent
    for path in sorted(folder.glob("libmujoco.*")):
        library = ctypes.CDLL(str(path))
        library.mjp_getPluginAtSlot.restype = ctypes.POINTER(_Plugin)
        library.mjp_getPluginAtSlot.argtypes = [ctypes.c_int]
        return library
    return None


def _registered(slot: int) -> Any:
    """Return the plugin in a slot of MuJoCo's register."""
    try:
        library = _library()
        found = library.mjp_getPluginAtSlot(slot) if library is not None else None
    except (OSError, AttributeError):
        return None
    return found.contents if found else None
