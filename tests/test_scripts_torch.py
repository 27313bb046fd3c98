# SPDX-License-Identifier: Apache-2.0
"""scripts/setup installs no CUDA that nobody asked for; pip's part is played here."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# The Python of an environment: its pip tells what it would install, and otherwise
# writes down what it was told to install.
PYTHON = """#!/bin/sh
case "$*" in
  *"import torch"*) exit 1 ;;
  *--dry-run*) {answer} ;;
  *) echo "$*" >> "$(dirname "$0")/installed" ;;
esac
"""
CUDA = """echo '{"url": "https://a/torch.whl"}, {"url": "https://a/nvidia_nccl.whl"}'"""
CPU = """echo '{"url": "https://a/torch.whl", "description": "nvidia too"}'"""
NOTHING = "exit 1"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """What the script reads of the repository."""
    shutil.copytree(ROOT / "scripts", tmp_path / "scripts")
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def ensure(checkout: Path, answer: str) -> list[str]:
    """Return what was installed."""
    python = checkout / "venv" / "bin" / "python"
    python.parent.mkdir(parents=True, exist_ok=True)
    python.write_text(PYTHON.format(answer=answer))
    python.chmod(0o755)
    code = f"set -euo pipefail; source scripts/setup; {ENSURE}"
    kept = {k: v for k, v in os.environ.items() if not k.startswith("MJREC_")}
    subprocess.run(["bash", "-c", code], cwd=checkout, env=kept, check=True, timeout=60)
    installed = python.with_name("installed")
    return installed.read_text().splitlines() if installed.exists() else []


ENSURE = 'ensure_stable_baselines3 "$PWD/venv"; lack_of_stable_baselines3 venv >lack'


def test_build_without_cuda_is_installed(checkout: Path) -> None:
    """Once, and not again."""
    for _ in range(2):
        torch, group = ensure(checkout, CPU)
        assert torch.endswith("install torch==2.13.0")
        assert group.endswith("install --group stable-baselines3")
    assert (checkout / "lack").read_text() == ""


@pytest.mark.parametrize("answer", [CUDA, NOTHING])
def test_nothing_is_installed_rather_than_cuda(answer: str, checkout: Path) -> None:
    """It is said why, and a second start does not look again."""
    assert ensure(checkout, answer) == []
    lack = (checkout / "lack").read_text()
    assert "no torch==2.13.0 without CUDA is to be had here" in lack
    assert ensure(checkout, CPU) == []
    # What it asks for is enough.
    (checkout / "venv" / "mjrec-stable-baselines3").unlink()
    assert len(ensure(checkout, CPU)) == 2
