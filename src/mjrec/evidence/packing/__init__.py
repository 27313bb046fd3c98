# SPDX-License-Identifier: Apache-2.0
"""From a monitor directory to one file that says what it is."""

from __future__ import annotations

from .archive import pack

__all__ = ["pack"]
