# SPDX-License-Identifier: Apache-2.0
"""Rendering on the GPU that a worker was assigned.

Schedulers assign GPUs with `CUDA_VISIBLE_DEVICES`, which EGL ignores: by default, all
workers on a machine render on the same GPU, the first one. The EGL device of the
assigned GPU cannot be computed, because three numbering schemes are involved. The
scheduler gives a CUDA number or a UUID. EGL has its own order. `MUJOCO_EGL_DEVICE_ID`
is an index into EGL's devices in mujoco 3, but (if possible) into CUDA's in mujoco 4.
So a child process that sees only the assigned GPU asks the driver which EGL device has
a CUDA number. A second child then renders, and its driver reports the device it used.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from ..errors import GLError, InvalidArgument
from .backends import backend_in_environment, rendering_is_off
from .choice import Probe, conflict_with, probe, set_backend
from .egl import EglDevice

_LOG = logging.getLogger(__name__)

CUDA_VISIBLE_DEVICES = "CUDA_VISIBLE_DEVICES"
_CHOSEN = "MUJOCO_EGL_DEVICE_ID"
_UUIDS = ("GPU-", "MIG-")
_DOCTOR = "`mjrec doctor` shows EGL's devices; `nvidia-smi -L` shows the GPUs."


def render_on_given_gpu(
    gpu: str | None = None, *, required: bool = False
) -> EglDevice | None:
    """Make this process and its children render on the GPU that they were assigned.

    Sets `MUJOCO_EGL_DEVICE_ID` to the EGL device of that GPU, and `MUJOCO_GL` to `egl`
    unless that variable turns rendering off. If the GPU cannot be used, nothing is set
    and one warning gives the reason. This takes a second or two, in child processes.
    Call it before anything imports mujoco, dm_control or OpenGL.

    Args:
        gpu: one entry in the form of `CUDA_VISIBLE_DEVICES`: a number ("3"), or the
            UUID of a GPU ("GPU-1a2b...") or of a GPU partition ("MIG-..."). None means
            that variable's first entry or, if it is not set, CUDA's first GPU.
        required: whether to raise an error if the GPU cannot be used.

    Returns:
        The EGL device, or None if the GPU cannot be used.

    Raises:
        InvalidArgument: `gpu` is not exactly one entry.
        UnknownName: `MUJOCO_GL` names an unknown backend.
        GLError: mujoco, dm_control or PyOpenGL was imported with another backend or has
            already rendered; or the GPU is required but cannot be used.
    """
    entry = _entry(gpu)
    _refuse_latecomers()
    try:
        device, number = _found(entry, os.environ)
    except GLError as error:
        if required:
            raise
        _LOG.warning("%s", error)
        return None
    os.environ[_CHOSEN] = str(number)
    if not rendering_is_off(os.environ):
        set_backend("egl")
    _LOG.info("Rendering on GPU %s: EGL's %s.", entry, _shown(device))
    return device


def visible_gpus(
    environ: Mapping[str, str] | None = None, *, devices: Path = Path("/dev")
) -> list[str]:
    """Return this machine's NVIDIA GPUs that can be assigned to workers.

    Each is returned as an entry for a worker's `CUDA_VISIBLE_DEVICES`. The entries are
    this process's own or, if the variable is not set, CUDA's numbers for the GPUs whose
    device files this process may open. A container or a job sees only its own device
    files, and CUDA numbers them from 0.

    Args:
        environ: the environment variables; if None, this process's.
        devices: the directory of device files.
    """
    entries = _entries(os.environ if environ is None else environ)
    if entries is not None:
        return entries
    files = [file for file in devices.glob("nvidia[0-9]*") if _can_be_opened(file)]
    return [str(number) for number in range(len(files))]


def device_of_gpu(devices: Sequence[EglDevice], gpu: str) -> EglDevice | None:
    """Return the EGL device of a GPU, or None if it is unknown.

    Args:
        devices: EGL's devices in a process in which CUDA sees only that GPU. So the
            right device is the only one with a CUDA number, whatever the number is.
        gpu: an entry of `CUDA_VISIBLE_DEVICES`. CUDA accepts a prefix of a UUID.
    """
    named = [
        device
        for device in devices
        if gpu.startswith("GPU-") and device.uuid.lower().startswith(gpu.lower())
    ]
    numbered = [device for device in devices if device.cuda_id is not None]
    for candidates in (named, numbered):
        if len(candidates) == 1:
            return candidates[0]
    return None


def _entry(gpu: str | None) -> str:
    if gpu is None:
        entries = _entries(os.environ)
        if entries is None:
            return "0"
        return entries[0] if entries else ""
    entry = str(gpu).strip()
    if entry.isdecimal() or (entry.startswith(_UUIDS) and "," not in entry):
        return entry
    raise InvalidArgument(
        f"gpu must be a single entry in the form of {CUDA_VISIBLE_DEVICES} (a number, "
        f"or a UUID that starts with GPU- or MIG-), not {gpu!r}."
    )


def _entries(environ: Mapping[str, str]) -> list[str] | None:
    """Return the entries of `CUDA_VISIBLE_DEVICES`, or None if it is not set."""
    text = environ.get(CUDA_VISIBLE_DEVICES)
    if text is None:
        return None
    entries = []
    for entry in (part.strip() for part in text.split(",")):
        # CUDA ignores everything after an invalid entry.
        if not (entry.isdecimal() or entry.startswith(_UUIDS)):
            break
        entries.append(entry)
    return entries


def _can_be_opened(file: Path) -> bool:
    # A cgroup's restriction takes effect only when the file is opened.
    try:
        os.close(os.open(file, os.O_RDWR | os.O_CLOEXEC))
    except OSError:
        return False
    return True


def _refuse_latecomers() -> None:
    """Raise GLError if it is too late for this process to choose a device."""
    conflict = conflict_with("egl")
    if conflict and not rendering_is_off(os.environ):
        raise GLError(f"{conflict.cause} {conflict.fix}")
    # mujoco reads `MUJOCO_EGL_DEVICE_ID` when it creates its first context, and
    # dm_control reads it on import.
    mujoco_draws = getattr(sys.modules.get("mujoco.egl"), "EGL_DISPLAY", None)
    dm_control = "dm_control._render.pyopengl.egl_renderer" in sys.modules
    if mujoco_draws is not None or dm_control:
        raise GLError(
            "This process has already rendered with EGL and can no longer switch to "
            "another GPU. Call render_on_given_gpu before anything imports dm_control "
            "or renders with mujoco."
        )


def _found(gpu: str, environ: Mapping[str, str]) -> tuple[EglDevice, int]:
    """Return a GPU's EGL device and the `MUJOCO_EGL_DEVICE_ID` that selects it.

    Raises:
        GLError: the GPU cannot be used for rendering.
    """
    if not gpu:
        raise GLError(
            "This process was not assigned a GPU for rendering: CUDA_VISIBLE_DEVICES "
            "is empty. Request one from your scheduler."
        )
    asked = f"GPU {gpu} was assigned for rendering"
    backend = None if rendering_is_off(environ) else backend_in_environment(environ)
    if backend not in (None, "egl"):
        raise GLError(
            f"{asked}, but MUJOCO_GL={backend} cannot choose a GPU: unset MUJOCO_GL, "
            "or set it to egl."
        )
    device, alone = _device(gpu, environ)
    if device is None:
        raise GLError(f"{asked}, but {_lack_of_device(alone)}")
    tried = alone
    for number, tried in _tries(device, gpu, alone, environ):
        for used in tried.devices:
            is_it = used.in_use and used.index == device.index
            if is_it and tried.renders and not tried.software:
                return used, number
    why = f"it does not work. {tried.cause} {tried.fix}".strip()
    if tried.renders:
        why = "mujoco uses a different device, whatever MUJOCO_EGL_DEVICE_ID is."
    raise GLError(f"{asked}, which is EGL's {_shown(device)}, but {why} {_DOCTOR}")


def _device(gpu: str, environ: Mapping[str, str]) -> tuple[EglDevice | None, Probe]:
    """Return the EGL device of a GPU, and a probe that sees only that GPU."""
    alone = probe("egl", environ={**environ, CUDA_VISIBLE_DEVICES: gpu, _CHOSEN: "0"})
    device = device_of_gpu(alone.devices, gpu)
    hardware = [device for device in alone.devices if not device.software]
    if device is not None or len(hardware) != 1:
        return device, alone
    if gpu.startswith("GPU-") and hardware[0].uuid:
        return None, alone
    # A single GPU may be the right one even without a CUDA number: it may be from
    # another vendor, or its driver may lack the CUDA part.
    everything = {k: v for k, v in environ.items() if k != CUDA_VISIBLE_DEVICES}
    seen = probe("egl", environ={**everything, _CHOSEN: "0"})
    is_known_to_cuda = any(device.cuda_id is not None for device in seen.devices)
    return None if is_known_to_cuda else hardware[0], alone


def _tries(
    device: EglDevice, gpu: str, alone: Probe, environ: Mapping[str, str]
) -> Iterator[tuple[int, Probe]]:
    """Yield mujoco's possible numbers for a device, starting with the most likely.

    Each number comes with its probe. For mujoco 3, the number is the index in EGL's
    list. For mujoco 4, it is an index into `CUDA_VISIBLE_DEVICES`, the CUDA device
    number, or an index into mujoco's own list.
    """
    if environ.get(CUDA_VISIBLE_DEVICES) == gpu:
        yield 0, alone
    for number in dict.fromkeys([device.index, *range(len(alone.devices))]):
        yield number, probe("egl", environ={**environ, _CHOSEN: str(number)})


def _lack_of_device(alone: Probe) -> str:
    """Return the reason why none of EGL's devices is the assigned GPU."""
    hardware = [device for device in alone.devices if not device.software]
    if not alone.devices:
        return f"EGL has no device. {alone.cause} {alone.fix}".strip()
    if not hardware:
        on = f" ({alone.gl_renderer})" if alone.gl_renderer else ""
        way = alone.warning() or (
            "EGL finds no GPU here: /dev contains no device file of a GPU."
        )
        return f"EGL has only the CPU{on}. {way}"
    return (
        f"none of EGL's {len(hardware)} GPUs is that GPU: "
        f"{'; '.join(map(_shown, hardware))}. Partitions of a GPU (MIG) usually do not "
        f"support graphics, and GPUs hidden from CUDA cannot be found. {_DOCTOR}"
    )


def _shown(device: EglDevice) -> str:
    cuda = "" if device.cuda_id is None else f"CUDA device {device.cuda_id}"
    known = ", ".join(filter(None, [device.uuid, device.device_file, cuda]))
    return f"device {device.index}" + (f" ({known})" if known else "")
