# SPDX-License-Identifier: Apache-2.0
"""OpenGL without a screen: which backend to use, and what is wrong with the others.

Nothing here imports mujoco or OpenGL; what must is tried in child processes.
"""

from __future__ import annotations

from .backends import BACKENDS
from .choice import Choice, choose, use_gl
from .diagnosis import Diagnosis, diagnose
from .probing import EglDevice, Probe, probe

__all__ = [
    "BACKENDS",
    "Choice",
    "Diagnosis",
    "EglDevice",
    "Probe",
    "choose",
    "diagnose",
    "probe",
    "use_gl",
]
