# SPDX-License-Identifier: Apache-2.0
"""A packed run is an RO-Crate, by the validator of those who specify these."""

import json
import os
import subprocess
from pathlib import Path

import pytest
from packed_runs import record_pendulum, unpacked

import mjrec


def issues(crate):
    """Return what the validator says is wrong with a crate."""
    if "MJREC_TEST_CRATE" not in os.environ:
        pytest.skip("no environment with roc-validator: scripts/test --all makes one")
    script = Path(__file__).with_name("crate_validation.py")
    done = subprocess.run(
        [os.environ["MJREC_TEST_CRATE"], script, crate],
        capture_output=True,
        text=True,
        env={k: v for k, v in os.environ.items() if k != "PYTHONWARNINGS"},
        check=False,
        timeout=240,
    )
    lines = done.stdout.splitlines()
    assert done.returncode == len(lines), done.stderr
    return lines


@pytest.mark.crate_validator
@pytest.mark.parametrize("stated", [True, False])
def test_the_validator_takes_the_crate(stated, tmp_path):
    """All that is required, of our recordings and of gym's; and it can say no."""
    said, directory = {}, Path(__file__).parent / "data/gym/0.21.0/two_monitors"
    if stated:
        said = {"authors": ["A B <a@b.org>"], "license": "MIT"}
        record_pendulum(directory := tmp_path / "runs", 2, longest=3)
    packed = mjrec.pack(directory, tmp_path / "run.zip", **said)
    crate = unpacked(packed, tmp_path / "x") / "data"
    assert issues(crate) == []
    path = crate / "ro-crate-metadata.json"
    content = json.loads(path.read_text())
    for entity in content["@graph"]:
        entity.pop("instrument", None)
    path.write_text(json.dumps(content))
    assert any("instrument" in issue for issue in issues(crate))
