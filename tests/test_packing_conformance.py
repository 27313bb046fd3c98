# SPDX-License-Identifier: Apache-2.0
"""A packed run is an RO-Crate, by the validator of those who specify these."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packed_runs import record_pendulum, unpacked

import mjrec

# 0.13 needs no network but for the context.
PACKAGES = ("roc-validator==0.13.0", "rocrate==0.16.0")


@pytest.fixture(scope="module")
def validator() -> Path:
    """Return the Python of an environment that holds the validator."""
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}"
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    home = cache / "mjrec-tests" / f"roc-validator-0.13.0-{tag}"
    home.parent.mkdir(parents=True, exist_ok=True)
    with home.with_suffix(".lock").open("w") as lock:
        # Several test processes make it once.
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (home / "complete").exists():
            shutil.rmtree(home, ignore_errors=True)
            subprocess.run([sys.executable, "-m", "venv", home], check=True)
            pip = [home / "bin/python", "-m", "pip", "install", "--quiet"]
            subprocess.run([*pip, *PACKAGES], check=True, timeout=280)
            (home / "complete").touch()
    return home / "bin/python"


def issues(validator: Path, crate: Path) -> list[str]:
    """Return what the validator says is wrong with a crate."""
    script = Path(__file__).with_name("crate_validation.py")
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONWARNINGS"}
    done = subprocess.run(
        [validator, script, crate],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
        timeout=240,
    )
    lines = done.stdout.splitlines()
    assert done.returncode == len(lines), done.stderr
    return lines


@pytest.mark.legacy  # an environment of its own, too
@pytest.mark.parametrize("stated", [True, False])
def test_the_validator_takes_the_crate(
    stated: bool, validator: Path, tmp_path: Path
) -> None:
    """All that is required, of our recordings and of gym's; and it can say no."""
    if stated:
        said = {"authors": ["A B <a@b.org>"], "license": "MIT"}
        record_pendulum(directory := tmp_path / "runs", 2, longest=3)
    else:
        said, directory = {}, Path(__file__).parent / "data/gym/0.21.0/two_monitors"
    packed = mjrec.pack(directory, tmp_path / "run.zip", **said)  # type: ignore[arg-type]  # of options
    crate = unpacked(packed, tmp_path / "x") / "data"
    assert issues(validator, crate) == []
    path = crate / "ro-crate-metadata.json"
    content = json.loads(path.read_text())
    for entity in content["@graph"]:
        entity.pop("instrument", None)
    path.write_text(json.dumps(content))
    assert any("instrument" in issue for issue in issues(validator, crate))
