# SPDX-License-Identifier: Apache-2.0
"""OpenGL without a screen: choice of the backend, and diagnosis of failures.

This package imports neither mujoco nor OpenGL; tests that need them run in child
processes.
"""

from __future__ import annotations

from .backends import Diagnosis as Diagnosis
from .backends import diagnose as diagnose
from .choice import Probe as Probe
from .devices import render_on_given_gpu as render_on_given_gpu
from .egl import EglDevice as EglDevice
