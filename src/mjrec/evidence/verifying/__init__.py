# SPDX-License-Identifier: Apache-2.0
"""From a packed run, or a monitor directory, to what it proves."""

from __future__ import annotations

from .verifier import VerificationProgress, verify

__all__ = ["VerificationProgress", "verify"]
