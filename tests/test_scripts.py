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
    shutil.copytree(ROOT / "scripts", tmp_path / "scripts")
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


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


def make_environment(checkout):
    subprocess.run(
        [sys.executable, "-m", "venv", "--without-pip", checkout / ".venv"], check=True
    )


def write_stamp(checkout):
    """Leave what a finished installation leaves."""
    stamp = '"$(stamp_of "$venv" demo)"'
    wrote = bash(checkout, SOURCE + f'describe_installation "$venv" -e . >{stamp}')
    assert wrote.returncode == 0, wrote.stderr


def is_installed(checkout):
    answer = bash(checkout, SOURCE + 'is_installed "$venv" demo -e .')
    assert answer.returncode in (0, 1), answer.stderr
    return answer.returncode == 0


@pytest.mark.parametrize("command", COMMANDS)
def test_help_installs_nothing(checkout, command):
    """A clone can run the commands; asking what one does changes nothing."""
    shutil.copytree(ROOT / ".ci", checkout / ".ci")
    answer = bash(checkout, f"{command} --help")
    assert answer.returncode == 0
    assert answer.stdout.startswith("usage: scripts/")
    assert not (checkout / ".venv").exists()


def must_be_made_anew(checkout):
    return bash(checkout, SOURCE + 'must_be_made_anew "$venv"').returncode == 0


def test_an_installation_is_repeated_only_where_it_must_be(checkout):
    """When pyproject.toml has changed, or it was interrupted."""
    make_environment(checkout)
    assert not is_installed(checkout)
    write_stamp(checkout)
    assert is_installed(checkout)
    assert not must_be_made_anew(checkout)
    (checkout / ".venv" / "mjrec-unfinished").touch()
    assert not is_installed(checkout)
    assert must_be_made_anew(checkout)
    (checkout / ".venv" / "mjrec-unfinished").unlink()
    with (checkout / "pyproject.toml").open("a") as project:
        project.write("\n# another\n")
    assert not is_installed(checkout)


def test_moved_checkout_is_made_anew(checkout, tmp_path):
    """An environment's scripts name the place where it was made."""
    make_environment(checkout)
    write_stamp(checkout)
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in ("scripts", "pyproject.toml", ".venv"):
        shutil.move(checkout / name, moved)
    assert must_be_made_anew(moved)


def test_directory_of_somebody_else_stays(checkout):
    """A directory that the scripts did not make is neither emptied nor changed."""
    mine = checkout / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("precious")
    answer = bash(checkout, "scripts/setup", MJREC_VENV="mine")
    assert answer.returncode == 1
    assert f"{mine} is there, and these scripts did not make it" in answer.stderr
    assert [path.name for path in mine.iterdir()] == ["thesis.tex"]


def test_python_that_does_not_fit_is_named(checkout):
    """The error says what was looked for, what is there and what to do."""
    old = checkout / "old-python"
    old.write_text("#!/bin/sh\n[ $1 = --version ] && echo Python 3.9.2\nexit 1\n")
    old.chmod(0o755)
    answer = bash(checkout, SOURCE + "find_python", MJREC_PYTHON=str(old))
    assert answer.returncode == 1
    assert "Python 3.11 or 3.12" in answer.stderr
    assert f"{old} is: Python 3.9.2" in answer.stderr
    assert "MJREC_PYTHON=" in answer.stderr


def test_missing_libraries_are_named_with_the_line_to_run(checkout):
    """Where packages may not be installed, one line does it."""
    no_root = "may_install() { false; }; in_package_lists() { false; }; "
    answer = bash(checkout, SOURCE + no_root + "install_required $(missing_egl)")
    assert answer.returncode == 1
    assert "apt-get install -y --no-install-recommends libegl1 " in answer.stderr


def test_failed_step_is_named(checkout):
    """A stop names the step, the command and its exit status."""
    answer = bash(checkout, SOURCE + 'step "counting" false --quick')
    assert answer.returncode == 1
    assert "stopped at: counting" in answer.stderr
    assert "exit status 1 of: false --quick" in answer.stderr


def test_pull_requests_run_the_tests() -> None:
    """The workflow runs the scripts that a contributor runs."""
    text = (ROOT / ".github" / "workflows" / "test.yml").read_text()
    workflow = yaml.safe_load(text)
    [job] = workflow["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    assert commands == ["scripts/test", "scripts/docs"]
    assert "pull_request:" in text
