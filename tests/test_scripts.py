# SPDX-License-Identifier: Apache-2.0
"""Test those parts of the scripts that need no download."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
COMMANDS = [f"scripts/{name}" for name in ("setup", "demo", "test", "docs", "build")]
COMMANDS += [".ci/run"]

SOURCE = "set -euo pipefail; source scripts/setup; libraries=; "


@pytest.fixture
def checkout(tmp_path):
    for name in ("scripts", ".ci"):
        shutil.copytree(ROOT / name, tmp_path / "checkout" / name)
    shutil.copy(ROOT / "pyproject.toml", tmp_path / "checkout")
    return tmp_path / "checkout"


def bash(checkout, command, **environment):
    kept = {k: v for k, v in os.environ.items() if not k.startswith("MJREC_")}
    options = {"cwd": checkout, "env": {**kept, **environment}, "timeout": 60}
    command = ["bash", "-c", command]
    return subprocess.run(command, capture_output=True, text=True, **options)


def succeeds(checkout, condition):
    """Return whether a shell function succeeds."""
    answer = bash(checkout, SOURCE + condition)
    assert answer.returncode in (0, 1), answer.stderr
    return answer.returncode == 0


IS_INSTALLED = 'is_installed "$venv" demo -e .'
MUST_BE_MADE_ANEW = 'must_be_made_anew "$venv"'


@pytest.mark.parametrize("command", COMMANDS)
def test_help_installs_nothing(checkout, command):
    answer = bash(checkout, f"{command} --help")
    assert answer.returncode == 0
    assert answer.stdout.startswith("usage: scripts/")
    assert not (checkout / ".venv").exists()


def test_installation_is_repeated_only_if_necessary(checkout, tmp_path):
    """Reasons are a changed pyproject.toml, an interruption or a moved checkout."""
    venv = checkout / ".venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
    assert not succeeds(checkout, IS_INSTALLED)
    # A finished installation leaves this stamp.
    stamp = '"$(stamp_of "$venv" demo)"'
    assert succeeds(checkout, f'describe_installation "$venv" -e . >{stamp}')
    assert succeeds(checkout, IS_INSTALLED)
    assert not succeeds(checkout, MUST_BE_MADE_ANEW)
    (venv / "mjrec-unfinished").touch()
    assert not succeeds(checkout, IS_INSTALLED)
    assert succeeds(checkout, MUST_BE_MADE_ANEW)
    (venv / "mjrec-unfinished").unlink()
    with (checkout / "pyproject.toml").open("a") as project:
        project.write("\n# another\n")
    assert not succeeds(checkout, IS_INSTALLED)
    # Scripts in a virtual environment contain its path, so it cannot be moved.
    assert not succeeds(checkout, MUST_BE_MADE_ANEW)
    assert succeeds(checkout.rename(tmp_path / "moved"), MUST_BE_MADE_ANEW)


@pytest.mark.parametrize(
    ("command", "environment", "errors"),
    [
        (
            *("scripts/setup", {"MJREC_VENV": "mine"}),
            ["/mine is there, and these scripts did not make it"],
        ),
        (
            *(f"{SOURCE} find_python", {"MJREC_PYTHON": "./old-python"}),
            ["Python 3.11 or 3.12", "./old-python is: Python 3.9.2", "MJREC_PYTHON="],
        ),
        # Without permission to install, the error shows the command to run.
        (
            f"{SOURCE} may_install() {{ false; }}; in_package_lists() {{ false; }}; "
            "install_required $(missing_egl)",
            *({}, ["apt-get install -y --no-install-recommends libegl1 "]),
        ),
        (
            *(f'{SOURCE} step "counting" false --quick', {}),
            ["stopped at: counting", "exit status 1 of: false --quick"],
        ),
    ],
    ids=["foreign directory", "old Python", "no libraries", "failed step"],
)
def test_errors_name_reason_and_remedy(checkout, command, environment, errors):
    """Scripts do not change a directory that they did not create."""
    (checkout / "mine").mkdir()
    (checkout / "mine" / "thesis.tex").write_text("precious")
    old = checkout / "old-python"
    old.write_text("#!/bin/sh\n[ $1 = --version ] && echo Python 3.9.2\nexit 1\n")
    old.chmod(0o755)
    answer = bash(checkout, command, **environment)
    assert answer.returncode == 1
    for words in errors:
        assert words in answer.stderr
    assert [path.name for path in (checkout / "mine").iterdir()] == ["thesis.tex"]


def test_workflow_runs_the_scripts_on_pull_requests():
    text = (ROOT / ".github" / "workflows" / "test.yml").read_text()
    [job] = yaml.safe_load(text)["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    assert commands == ["scripts/test", "scripts/docs"]
    assert "pull_request:" in text
