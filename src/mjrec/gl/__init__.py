# SPDX-License-Identifier: Apache-2.0
"""OpenGL without a screen: choice of the backend, and diagnosis of failures.

This package imports neither mujoco nor OpenGL; tests that need them run in child
processes.
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
