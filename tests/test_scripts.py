# SPDX-License-Identifier: Apache-2.0
"""The commands that a new user runs first, as far as no download is needed."""

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

# Stands before a function call: the real file, sourced as demo and test do.
SOURCE = "set -euo pipefail; source scripts/setup; libraries=; "


@pytest.fixture
def checkout(tmp_path):
    """What the commands read of the repository, at a place of its own."""
    for name in ("scripts", ".ci"):
        shutil.copytree(ROOT / name, tmp_path / "checkout" / name)
    shutil.copy(ROOT / "pyproject.toml", tmp_path / "checkout")
    return tmp_path / "checkout"


def bash(checkout, command, **environment):
    kept = {k: v for k, v in os.environ.items() if not k.startswith("MJREC_")}
    return subprocess.run(
        ["bash", "-c", command],
        cwd=checkout,
        env={**kept, **environment},
        capture_output=True,
        text=True,
        timeout=60,
    )


def holds(checkout, condition):
    """Return whether a function of the scripts says yes."""
    answer = bash(checkout, SOURCE + condition)
    assert answer.returncode in (0, 1), answer.stderr
    return answer.returncode == 0


IS_INSTALLED = 'is_installed "$venv" demo -e .'
MUST_BE_MADE_ANEW = 'must_be_made_anew "$venv"'


@pytest.mark.parametrize("command", COMMANDS)
def test_help_installs_nothing(checkout, command):
    """A clone can run the commands; asking what one does changes nothing."""
    answer = bash(checkout, f"{command} --help")
    assert answer.returncode == 0
    assert answer.stdout.startswith("usage: scripts/")
    assert not (checkout / ".venv").exists()


def test_an_installation_is_repeated_only_where_it_must_be(checkout, tmp_path):
    """When pyproject.toml has changed, it was interrupted, or the checkout moved."""
    venv = checkout / ".venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
    assert not holds(checkout, IS_INSTALLED)
    # What a finished installation leaves.
    stamp = '"$(stamp_of "$venv" demo)"'
    assert holds(checkout, f'describe_installation "$venv" -e . >{stamp}')
    assert holds(checkout, IS_INSTALLED)
    assert not holds(checkout, MUST_BE_MADE_ANEW)
    (venv / "mjrec-unfinished").touch()
    assert not holds(checkout, IS_INSTALLED)
    assert holds(checkout, MUST_BE_MADE_ANEW)
    (venv / "mjrec-unfinished").unlink()
    with (checkout / "pyproject.toml").open("a") as project:
        project.write("\n# another\n")
    assert not holds(checkout, IS_INSTALLED)
    # An environment's scripts name the place where it was made.
    assert not holds(checkout, MUST_BE_MADE_ANEW)
    assert holds(checkout.rename(tmp_path / "moved"), MUST_BE_MADE_ANEW)


@pytest.mark.parametrize(
    ("command", "environment", "said"),
    [
        (
            *("scripts/setup", {"MJREC_VENV": "mine"}),
            ["/mine is there, and these scripts did not make it"],
        ),
        (
            *(f"{SOURCE} find_python", {"MJREC_PYTHON": "./old-python"}),
            ["Python 3.11 or 3.12", "./old-python is: Python 3.9.2", "MJREC_PYTHON="],
        ),
        # Where packages may not be installed, one line does it.
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
def test_what_stops_a_command_is_named(checkout, command, environment, said):
    """With what to do; a directory that the scripts did not make stays as it is."""
    (checkout / "mine").mkdir()
    (checkout / "mine" / "thesis.tex").write_text("precious")
    old = checkout / "old-python"
    old.write_text("#!/bin/sh\n[ $1 = --version ] && echo Python 3.9.2\nexit 1\n")
    old.chmod(0o755)
    answer = bash(checkout, command, **environment)
    assert answer.returncode == 1
    for words in said:
        assert words in answer.stderr
    assert [path.name for path in (checkout / "mine").iterdir()] == ["thesis.tex"]


def test_pull_requests_run_the_tests():
    """The workflow runs the scripts that a contributor runs."""
    text = (ROOT / ".github" / "workflows" / "test.yml").read_text()
    [job] = yaml.safe_load(text)["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    assert commands == ["scripts/test", "scripts/docs"]
    assert "pull_request:" in text
