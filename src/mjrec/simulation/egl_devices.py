# SPDX-License-Identifier: Apache-2.0
"""EGL's devices, as EGL tells of them."""

from __future__ import annotations

import ctypes
import uuid
from collections.abc import Callable
from typing import Any

from ..gl.probing import EglDevice

_EXTENSIONS = 0x3055
_DEVICE = 0x322C
_CUDA_DEVICE = 0x323A
_DRM_DEVICE_FILE = 0x3233
_DRM_RENDER_NODE_FILE = 0x3377
_DEVICE_UUID = 0x335C
_UUID_LENGTH = 16
# mujoco 3 itself asks for ten.
_MOST_DEVICES = 256


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
        self._library = ctypes.CDLL("libEGL.so.1")
        get = self._library.eglGetProcAddress
        get.restype, get.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
        number = ctypes.POINTER(ctypes.c_int)
        value = ctypes.POINTER(ctypes.c_ssize_t)
        device, key = ctypes.c_void_p, ctypes.c_int
        self._query_devices = self._function(
            "eglQueryDevicesEXT", ctypes.c_int, ctypes.POINTER(device), number
        )
        self._query_string = self._function(
            "eglQueryDeviceStringEXT", device, key, result=ctypes.c_char_p
        )
        self._query_attribute = self._function(
            "eglQueryDeviceAttribEXT", device, key, value
        )
        self._query_binary = self._function(
            *("eglQueryDeviceBinaryEXT", device, key, ctypes.c_int),
            *(ctypes.c_void_p, number),
        )
        self._current_display = self._function(
            "eglGetCurrentDisplay", result=ctypes.c_void_p
        )
        self._query_display = self._function(
            "eglQueryDisplayAttribEXT", ctypes.c_void_p, key, value
        )

    def devices(self) -> list[int]:
        """Return EGL's handles of its devices."""
        found = (ctypes.c_void_p * _MOST_DEVICES)()
        count = ctypes.c_int()
        if not self._query_devices or not self._query_devices(
            _MOST_DEVICES, found, ctypes.byref(count)
        ):
            return []
        return [handle for handle in found[: count.value] if handle is not None]

    def device_in_use(self) -> int | None:
        """Return the device of the context current on this thread, if EGL can tell."""
        if not self._current_display or not self._query_display:
            return None
        display = self._current_display()
        value = ctypes.c_ssize_t()
        if display is None:
            return None
        found = self._query_display(display, _DEVICE, ctypes.byref(value))
        return value.value if found else None

    def about(
        self, index: int, device: int, *, in_use: bool, with_cuda: bool
    ) -> EglDevice:
        """Return what EGL tells of a device."""
        extensions = self._string(device, _EXTENSIONS).split()
        file = ""
        if "EGL_EXT_device_drm_render_node" in extensions:
            file = self._string(device, _DRM_RENDER_NODE_FILE)
        if not file and "EGL_EXT_device_drm" in extensions:
            file = self._string(device, _DRM_DEVICE_FILE)
        has_number = with_cuda and "EGL_NV_device_cuda" in extensions
        has_uuid = "EGL_EXT_device_persistent_id" in extensions
        return EglDevice(
            index=index,
            device_file=file,
            cuda_id=self._cuda_id(device) if has_number else None,
            software="EGL_MESA_device_software" in extensions,
            in_use=in_use,
            uuid=self._uuid(device) if has_uuid else "",
        )

    def _string(self, device: int, name: int) -> str:
        if not self._query_string:
            return ""
        return (self._query_string(device, name) or b"").decode(errors="replace")

    def _cuda_id(self, device: int) -> int | None:
        value = ctypes.c_ssize_t()
        if not self._query_attribute or not self._query_attribute(
            device, _CUDA_DEVICE, ctypes.byref(value)
        ):
            return None
        return value.value

    def _uuid(self, device: int) -> str:
        value = ctypes.create_string_buffer(_UUID_LENGTH)
        size = ctypes.c_int()
        if not self._query_binary or not self._query_binary(
            device, _DEVICE_UUID, _UUID_LENGTH, value, ctypes.byref(size)
        ):
            return ""
        return f"GPU-{uuid.UUID(bytes=value.raw)}"

    def _function(
        self, name: str, *arguments: Any, result: Any = ctypes.c_uint
    ) -> Callable[..., Any] | None:
        address = self._library.eglGetProcAddress(name.encode())
        return ctypes.CFUNCTYPE(result, *arguments)(address) if address else None
