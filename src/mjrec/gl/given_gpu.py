# SPDX-License-Identifier: Apache-2.0
"""The GPU that a worker was given, and rendering on it."""

from __future__ import annotations

import os
from dataclasses import dataclass

from .choice import use_gl

__all__ = [
    "CUDA_VISIBLE_DEVICES",
    "GivenGpu",
    "render_on_given_gpu",
    "visible_gpus",
]

# What Ray, Slurm and our own engines name a worker's GPUs in.
CUDA_VISIBLE_DEVICES = "CUDA_VISIBLE_DEVICES"


@dataclass(frozen=True, kw_only=True)
class GivenGpu:
    """What renders on the GPU that a process was given."""

    backend: str


def render_on_given_gpu(gpu: str | None = None, *, required: bool = False) -> GivenGpu:
    """Let this process, and its children, render on the GPU that it was given."""
    return GivenGpu(backend=use_gl())


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, as `CUDA_VISIBLE_DEVICES` would."""
    named = os.environ.get(CUDA_VISIBLE_DEVICES, "")
    return [name.strip() for name in named.split(",") if name.strip()]
