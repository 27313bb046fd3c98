# SPDX-License-Identifier: Apache-2.0
"""What is known of one of EGL's devices."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EglDevice:
    """One of EGL's devices.

    Attributes:
        index: its place in EGL's list, which is what `MUJOCO_EGL_DEVICE_ID` means to
            mujoco 3 (and to mujoco 4 where no device has a CUDA number).
        device_file: for example `/dev/dri/renderD128`; empty where EGL does not tell.
        cuda_id: CUDA's number of the same device; None where it has none, or where
            `CUDA_VISIBLE_DEVICES` hides it.
        software: whether it is the CPU.
        in_use: whether the current context draws on it.
        uuid: of the GPU, as `nvidia-smi -L` shows it; empty where EGL does not tell.
    """

    index: int
    device_file: str
    cuda_id: int | None
    software: bool
    in_use: bool
    uuid: str = ""
