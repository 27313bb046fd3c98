# SPDX-License-Identifier: Apache-2.0
"""OpenGL without a screen: which backend to use, and what is wrong with the others.

Nothing here imports mujoco or OpenGL; what must is tried in child processes.
"""

from __future__ import annotations

from .backends import BACKENDS as BACKENDS
from .choice import backend_for_children as backend_for_children
from .choice import choose as choose
from .choice import use_gl as use_gl
from .devices import render_on_given_gpu as render_on_given_gpu
from .devices import visible_gpus as visible_gpus
from .diagnosis import Diagnosis as Diagnosis
from .diagnosis import diagnose as diagnose
from .egl import EglDevice as EglDevice
from .probing import Probe as Probe
from .probing import probe as probe
