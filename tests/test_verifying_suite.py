# SPDX-License-Identifier: Apache-2.0
"""Verifying recordings of dm_control's suite that a stranger has made."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjrec
from mjrec.evidence.verification import Verdict

pytestmark = pytest.mark.dm_control
suite = pytest.importorskip("dm_control.suite", reason="dm_control not installed")


def record(directory: Path, domain: str, task: str) -> None:
    env: Any = mjrec.Monitor(
        suite.load(domain, task, task_kwargs={"random": 0}),
        directory,
        env_id=f"dm_control/{domain}-{task}",
        height=32,
        width=48,
        workers=1,
    )
    env.reset()
    for _ in range(3):
        env.step(np.full(env.action_spec().shape, 0.3))
    env.close()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("domain", "task", "has_sources"),
    [("cheetah", "run", True), ("swimmer", "swimmer6", False)],
)
def test_a_strangers_recording_is_drawn_again(
    domain: str,
    task: str,
    has_sources: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From its sources, or because the suite has just made the same model here."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "the stranger's"))
    record(tmp_path / "run", domain, task)
    assert bool([*(tmp_path / "run").glob("*.zip")]) is has_sources
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "the reader's"))
    found = mjrec.verify(mjrec.pack(tmp_path / "run", tmp_path / "run.zip"))
    unproved = {check.reason for check in found.checks if check.verdict != Verdict.PASS}
    # The episode was never over, so that no statistics are of it.
    assert found.failures == ()
    assert not any("model" in reason for reason in unproved), unproved
    drawn = [check for check in found.checks if check.claim.startswith("the pictures")]
    assert [check.verdict for check in drawn] == [Verdict.PASS]
