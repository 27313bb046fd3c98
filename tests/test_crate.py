# SPDX-License-Identifier: Apache-2.0
"""Test that the official validator accepts packed runs as RO-Crates."""

import json
import os
import subprocess
from pathlib import Path

import pytest
from packed_runs import record_pendulum, unpacked

import mjrec


def issues(crate):
    """Return the validator's messages about a crate."""
    if "MJREC_TEST_CRATE" not in os.environ:
        pytest.skip("no environment with roc-validator: scripts/test --all makes one")
    script = Path(__file__).with_name("crate_validation.py")
    done = subprocess.run(
        [os.environ["MJREC_TEST_CRATE"], script, crate],
        capture_output=True,
        text=True,
        env={k: v for k, v in os.environ.items() if k != "PYTHONWARNINGS"},
        timeout=240,
    )
    lines = done.stdout.splitlines()
    assert done.returncode == len(lines), done.stderr
    return lines


@pytest.mark.crate_validator
@pytest.mark.parametrize("stated", [True, False])
def test_validator_accepts_crates_and_rejects_incomplete_ones(stated, tmp_path):
    statements, directory = {}, Path(__file__).parent / "data/gym/0.21.0/two_monitors"
    if stated:
        statements = {"authors": ["A B <a@b.org>"], "license": "MIT"}
        record_pendulum(directory := tmp_path / "runs", 2, longest=3)
    packed = mjrec.pack(directory, tmp_path / "run.zip", **statements)
    crate = unpacked(packed, tmp_path / "x") / "data"
    assert issues(crate) == []
    path = crate / "ro-crate-metadata.json"
    content = json.loads(path.read_text())
    for entity in content["@graph"]:
        entity.pop("instrument", None)
    path.write_text(json.dumps(content))
    assert any("instrument" in issue for issue in issues(crate))
