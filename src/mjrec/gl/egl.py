# SPDX-License-Identifier: Apache-2.0
"""The devices that the EGL library lists.

This uses only ctypes, so it works even if mujoco and PyOpenGL cannot be imported.
"""

from __future__ import annotations

import ctypes
import uuid
from dataclasses import dataclass
from typing import Any

_EXTENSIONS = 0x3055
_DEVICE = 0x322C
_CUDA_DEVICE = 0x323A
_DRM_DEVICE_FILE = 0x3233
_DRM_RENDER_NODE_FILE = 0x3377
_DEVICE_UUID = 0x335C
_UUID_LENGTH = 16
# This is more than enough: mujoco 3 itself asks for ten.
_MOST_DEVICES = 256


@dataclass(frozen=True)
class EglDevice:
    """One of EGL's devices.

    Attributes:
        index: position in EGL's list, as in `MUJOCO_EGL_DEVICE_ID` for MuJoCo 3 (and
            for MuJoCo 4 if no device has a CUDA number).
        device_file: the device file, such as `/dev/dri/renderD128`; empty if unknown.
        cuda_id: CUDA's number for the device; None if it has none, or if
            `CUDA_VISIBLE_DEVICES` hides the device.
        software: whether the device is the CPU.
        in_use: whether the current context renders on the device.
        uuid: the GPU's UUID, as in `nvidia-smi -L`; empty if unknown.
    """

    index: int
    device_file: str
    cuda_id: int | None
    software: bool
    in_use: bool
    uuid: str = ""


def egl_devices(*, with_cuda: bool = True) -> list[EglDevice]:
    """Return EGL's devices, in the order in which EGL lists them.

    The result is empty if EGL is not installed or cannot list its devices.

    Args:
        with_cuda: whether to query CUDA's numbers. The driver then initializes CUDA,
            so processes that are forked afterwards can no longer use CUDA.
    """
    try:
        address_of = ctypes.CDLL("libEGL.so.1").eglGetProcAddress
    except OSError:
        return []
    address_of.restype = ctypes.c_void_p
    address_of.argtypes = [ctypes.c_char_p]

    def call(name: str, *arguments: Any, result: Any = ctypes.c_uint) -> Any:
        """Call an EGL function and return its result, or None if EGL lacks it."""
        address = address_of(name.encode())
        if not address:
            return None
        return ctypes.CFUNCTYPE(result, *map(type, arguments))(address)(*arguments)

    def attribute(function: str, holder: int, name: int) -> int | None:
        value = ctypes.c_ssize_t()
        key = ctypes.c_int(name)
        found = call(function, ctypes.c_void_p(holder), key, ctypes.pointer(value))
        return value.value if found else None

    def text(device: int, name: int) -> str:
        handle, key = ctypes.c_void_p(device), ctypes.c_int(name)
        found = call("eglQueryDeviceStringEXT", handle, key, result=ctypes.c_char_p)
        return (found or b"").decode(errors="replace")

    def identity(device: int) -> str:
        value = (ctypes.c_char * _UUID_LENGTH)()
        found = call(
            *("eglQueryDeviceBinaryEXT", ctypes.c_void_p(device)),
            *(ctypes.c_int(_DEVICE_UUID), ctypes.c_int(_UUID_LENGTH)),
            *(value, ctypes.pointer(ctypes.c_int())),
        )
        return f"GPU-{uuid.UUID(bytes=value.raw)}" if found else ""

    handles = (ctypes.c_void_p * _MOST_DEVICES)()
    count, most = ctypes.c_int(), ctypes.c_int(_MOST_DEVICES)
    call("eglQueryDevicesEXT", most, handles, ctypes.pointer(count))
    display = call("eglGetCurrentDisplay", result=ctypes.c_void_p)
    in_use = attribute("eglQueryDisplayAttribEXT", display, _DEVICE) if display else 0
    devices = []
    for index, device in enumerate(filter(None, handles[: count.value])):
        has = text(device, _EXTENSIONS).split()
        file, cuda_id = "", None
        if "EGL_EXT_device_drm_render_node" in has:
            file = text(device, _DRM_RENDER_NODE_FILE)
        if not file and "EGL_EXT_device_drm" in has:
            file = text(device, _DRM_DEVICE_FILE)
        if with_cuda and "EGL_NV_device_cuda" in has:
            cuda_id = attribute("eglQueryDeviceAttribEXT", device, _CUDA_DEVICE)
        devices.append(
            EglDevice(
                index=index,
                device_file=file,
                cuda_id=cuda_id,
                software="EGL_MESA_device_software" in has,
                in_use=device == in_use,
                uuid=identity(device) if "EGL_EXT_device_persistent_id" in has else "",
            )
        )
    return devices
