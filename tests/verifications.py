# SPDX-License-Identifier: Apache-2.0
"""Findings, excuses and results of verifications."""

from pathlib import Path

from mjrec.evidence.findings import (
    Excuse,
    ExcuseKind,
    Finding,
    Level,
    Outcome,
    Topic,
    Verification,
)

HOSTILE = (
    "</li><script>alert(1)</script><img src=x onerror=alert(1)>\u202e\x00'\"{{7*7}}"
)


def finding(outcome=Outcome.RECREATED, **changes):
    """Return a finding about physics."""
    usual = {"topic": Topic.PHYSICS, "item": "a.h5", "count": 12, "unit": "step"}
    return Finding(**{**usual, "outcome": outcome, **changes})


def excuse(**changes):
    """Return the excuse that another GPU rendered."""
    usual = {"kind": ExcuseKind.HARDWARE, "name": "gl", "costs": "frames are alike"}
    usual |= {"claimed": "NVIDIA H100", "here": "llvmpipe"}
    return Excuse(**{**usual, **changes})


def verification(*findings, **changes):
    """Return the result of verifying `run.zip`."""
    usual = {"path": Path("somewhere/run.zip"), "level": Level.PIXELS}
    return Verification(**{**usual, "findings": findings, **changes})
