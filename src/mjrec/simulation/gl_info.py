# SPDX-License-Identifier: Apache-2.0
"""Which OpenGL draws, on which of EGL's devices, in whose context.

Needs no mujoco: whether that can be imported is part of what `gl_probe` tries.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import sys
import uuid
from collections.abc import Iterator
from typing import Any

from ..gl.probing import EglDevice

_NAMES = ("GL_VENDOR", "GL_RENDERER", "GL_VERSION")
_MAX_RENDERBUFFER_SIZE = 0x84E8

# Of EGL.
_EXTENSIONS = 0x3055
_DEVICE = 0x322C
_CUDA_DEVICE = 0x323A
_DRM_DEVICE_FILE = 0x3233
_DRM_RENDER_NODE_FILE = 0x3377
_DEVICE_UUID = 0x335C
_UUID_LENGTH = 16
# mujoco 3 itself asks for ten.
_MOST_DEVICES = 256


def raw_opengl() -> Any:
    """Return PyOpenGL's functions of OpenGL 1.0, for use on a thread with a context.

    Not `OpenGL.GL`, which takes longer to import than a picture to draw.
    """
    # It chooses its platform when it is imported, and mujoco sets which one when it
    # imports its context class: not before there is a context.
    return importlib.import_module("OpenGL.raw.GL.VERSION.GL_1_0")


def current_gl_strings() -> dict[str, str]:
    """Return vendor, renderer and version of the context current on this thread.

    The keys are `gl_vendor`, `gl_renderer` and `gl_version`; empty where no context
    is current, or none was made through PyOpenGL.
    """
    # Whoever drew has imported it already, and nobody else may do it here.
    if "OpenGL.platform" not in sys.modules:
        return {}
    gl = raw_opengl()
    strings = {}
    for name in _NAMES:
        try:
            pointer = gl.glGetString(getattr(gl, name))
        except sys.modules["OpenGL.error"].Error:
            return {}
        value = ctypes.cast(pointer, ctypes.c_char_p).value
        if value is None:
            return {}
        strings[name.lower()] = value.decode(errors="replace")
    return strings


def largest_picture() -> int:
    """Return the longest side that the driver of this thread's context can draw."""
    limit = ctypes.c_int()
    raw_opengl().glGetIntegerv(_MAX_RENDERBUFFER_SIZE, limit)
    return limit.value


def current_gl_facts() -> dict[str, Any]:
    """Return what metadata says of who draws on this thread.

    These are the strings and, where EGL tells on which of its devices it draws,
    `gl_device`: its `index` in EGL's list and, of a GPU whose driver says them, its
    `file` and its `uuid`. CUDA's number is not asked for, because that would begin
    CUDA in a process that may be somebody else's and forked later.
    """
    facts: dict[str, Any] = current_gl_strings()
    if facts and _is_egl():
        for device in egl_devices(with_cuda=False):
            if device.in_use:
                known = {"file": device.device_file, "uuid": device.uuid}
                said = {name: value for name, value in known.items() if value}
                facts["gl_device"] = {"index": device.index, **said}
    return facts


def _is_egl() -> bool:
    platform = getattr(sys.modules["OpenGL.platform"], "PLATFORM", None)
    return type(platform).__name__ == "EGLPlatform"


@contextlib.contextmanager
def current_context_kept() -> Iterator[None]:
    """Make the context that is current before the block current again after it.

    With EGL. The other backends cannot make a context current that somebody else
    made; with them the block's context stays current.
    """
    # Whoever made a context has loaded it.
    egl = sys.modules.get("OpenGL.EGL")
    before = None if egl is None else egl.eglGetCurrentContext()
    if egl is None or not before:
        yield
        return
    display = egl.eglGetCurrentDisplay()
    surfaces = [egl.eglGetCurrentSurface(kind) for kind in (egl.EGL_DRAW, egl.EGL_READ)]
    try:
        yield
    finally:
        if _address(egl.eglGetCurrentContext()) != _address(before):
            # The block may have freed it.
            with contextlib.suppress(sys.modules["OpenGL.error"].Error):
                egl.eglMakeCurrent(display, *surfaces, before)


def _address(context: Any) -> int | None:
    # No context is a null pointer, which has no address.
    return int(context.address) if context else None


def egl_devices(*, with_cuda: bool = True) -> list[EglDevice]:
    """Return what EGL tells about its devices, in the order of its list.

    Empty where it does not tell, or is not there.

    Args:
        with_cuda: ask for CUDA's numbers. The driver begins CUDA for that, which a
            process that is forked afterwards cannot use any more.
    """
    try:
        egl = _Egl()
    except OSError:
        return []
    in_use = egl.device_in_use()
    return [
        egl.about(index, device, in_use=device == in_use, with_cuda=with_cuda)
        for index, device in enumerate(egl.devices())
    ]


class _Egl:
    """The few functions of EGL that are needed, each of which may be missing.

    Raises:
        OSError: the library cannot be loaded.
    """

    def __init__(self) -> None:
        self._address_of = ctypes.CDLL("libEGL.so.1").eglGetProcAddress
        self._address_of.restype = ctypes.c_void_p
        self._address_of.argtypes = [ctypes.c_char_p]

    def devices(self) -> list[int]:
        """Return EGL's handles of its devices."""
        found = (ctypes.c_void_p * _MOST_DEVICES)()
        count = ctypes.c_int()
        most = ctypes.c_int(_MOST_DEVICES)
        self._call("eglQueryDevicesEXT", most, found, ctypes.pointer(count))
        return [handle for handle in found[: count.value] if handle is not None]

    def device_in_use(self) -> int | None:
        """Return the device of the context current on this thread, if EGL can tell."""
        display = self._call("eglGetCurrentDisplay", result=ctypes.c_void_p)
        if not display:
            return None
        return self._attribute("eglQueryDisplayAttribEXT", display, _DEVICE)

    def about(
        self, index: int, device: int, *, in_use: bool, with_cuda: bool
    ) -> EglDevice:
        """Return what EGL tells of a device."""
        extensions = self._string(device, _EXTENSIONS).split()
        file, cuda_id, identity = "", None, ""
        if "EGL_EXT_device_drm_render_node" in extensions:
            file = self._string(device, _DRM_RENDER_NODE_FILE)
        if not file and "EGL_EXT_device_drm" in extensions:
            file = self._string(device, _DRM_DEVICE_FILE)
        if with_cuda and "EGL_NV_device_cuda" in extensions:
            name = "eglQueryDeviceAttribEXT"
            cuda_id = self._attribute(name, device, _CUDA_DEVICE)
        if "EGL_EXT_device_persistent_id" in extensions:
            identity = self._uuid(device)
        return EglDevice(
            index=index,
            device_file=file,
            cuda_id=cuda_id,
            software="EGL_MESA_device_software" in extensions,
            in_use=in_use,
            uuid=identity,
        )

    def _string(self, device: int, name: int) -> str:
        handle, key = ctypes.c_void_p(device), ctypes.c_int(name)
        found = self._call(
            "eglQueryDeviceStringEXT", handle, key, result=ctypes.c_char_p
        )
        return (found or b"").decode(errors="replace")

    def _attribute(self, function: str, holder: int, name: int) -> int | None:
        value = ctypes.c_ssize_t()
        handle, key = ctypes.c_void_p(holder), ctypes.c_int(name)
        found = self._call(function, handle, key, ctypes.pointer(value))
        return value.value if found else None

    def _uuid(self, device: int) -> str:
        value = (ctypes.c_char * _UUID_LENGTH)()
        found = self._call(
            *("eglQueryDeviceBinaryEXT", ctypes.c_void_p(device)),
            *(ctypes.c_int(_DEVICE_UUID), ctypes.c_int(_UUID_LENGTH)),
            *(value, ctypes.pointer(ctypes.c_int())),
        )
        return f"GPU-{uuid.UUID(bytes=value.raw)}" if found else ""

    def _call(self, name: str, *arguments: Any, result: Any = ctypes.c_uint) -> Any:
        """Return what a function returns; None where there is no such function."""
        address = self._address_of(name.encode())
        if not address:
            return None
        return ctypes.CFUNCTYPE(result, *map(type, arguments))(address)(*arguments)
