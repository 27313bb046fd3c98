# SPDX-License-Identifier: Apache-2.0
"""Monitors, which translate calls to an environment into calls to the recorder.

Each framework has its own module here, which is imported only when one of its
environments is monitored.
"""

from __future__ import annotations

from .monitor import Monitor as Monitor
