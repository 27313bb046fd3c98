# SPDX-License-Identifier: Apache-2.0
"""OpenGL without a screen: which backend to use, and what is wrong with the others.

Nothing here imports mujoco or OpenGL; what must is tried in child processes.
"""

from __future__ import annotations

from .backends import BACKENDS
from .choice import Choice, backend_for_children, choose, use_gl
from .diagnosis import Diagnosis, diagnose
from .egl_device import EglDevice
from .given_gpu import GivenGpu, render_on_given_gpu, visible_gpus
from .probing import Probe, probe

__all__ = [
    "BACKENDS",
    "Choice",
    "Diagnosis",
    "EglDevice",
    "GivenGpu",
    "Probe",
    "backend_for_children",
    "choose",
    "diagnose",
    "probe",
    "render_on_given_gpu",
    "use_gl",
    "visible_gpus",
]
