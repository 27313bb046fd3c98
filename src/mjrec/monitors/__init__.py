# SPDX-License-Identifier: Apache-2.0
"""Monitors: thin translations of an environment's calls into the recorder's.

Each framework has a file of its own here, and is imported only when one of its
environments is monitored.
"""

from __future__ import annotations

from .monitor import Monitor as Monitor
