# SPDX-License-Identifier: Apache-2.0
"""Every block of the README, and every example, runs."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from parts import parametrize

ROOT = Path(__file__).parent.parent
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def blocks(language):
    return [text for kind, text in BLOCKS if kind == language]


def shell_lines():
    lines = [
        line.partition("#")[0].strip() for b in blocks("sh") for line in b.split("\n")
    ]
    return sorted({line for line in lines if line})


def run(*command, cwd):
    """Run a command that finds `mjrec` where this Python has it."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        command,
        cwd=cwd,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def needs_extras(text):
    if "dm_control" in text:
        pytest.importorskip("dm_control", reason="dm_control is not installed here")


@pytest.fixture
def checkout(tmp_path):
    """A directory in which the README's relative paths mean something."""
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    return tmp_path


PYTHON = dict(zip(("gymnasium", "dm_control", "again"), blocks("python"), strict=True))


# Takes more than five seconds: the README's own size, 480x480, drawn in software.
@parametrize("name", PYTHON)
def test_python_block_runs(name, checkout):
    """As it stands, after what it goes on from, and it leaves a video."""
    code = PYTHON[name]
    needs_extras(code)
    if name == "again":
        code = PYTHON["gymnasium"] + code
    run(sys.executable, "-c", code, cwd=checkout)
    assert list(checkout.glob("recordings/*/*.mp4"))
    assert name != "again" or list(checkout.glob("recordings/again/*.mp4"))


def needed_by(line):
    """Return the lines that make what a line is about, in order."""
    command, subject = (*line.split(), "")[1:3]
    made_by = dict.fromkeys(("list", "render", "recover", "pack", "report"), "--out")
    option = {**made_by, "verify": "-o"}.get(command)
    if option is None:
        return []
    [maker] = [x for x in shell_lines() if f"{option} {subject} " in x]
    return [*needed_by(maker), maker]


@pytest.mark.thorough
@pytest.mark.parametrize("line", [x for x in shell_lines() if x.startswith("mjrec")])
def test_command_runs(line, checkout):
    """As it stands, with the recordings that the ones before it made."""
    needed = needed_by(line)
    for each in (*needed, line):
        needs_extras(each)
    for earlier in needed:
        run(sys.executable, "-m", *shlex.split(earlier), cwd=checkout)
    out = run(sys.executable, "-m", *shlex.split(line), cwd=checkout)
    assert out.strip()


def test_system_packages_are_those_that_setup_installs():
    """The README's apt line names what scripts/setup looks for."""
    [line] = [x for x in shell_lines() if x.startswith("apt-get")]
    packages = [word for word in line.split() if word.startswith("lib")]
    setup = (ROOT / "scripts" / "setup").read_text()
    assert packages
    for package in packages:
        assert package in setup


def test_tree_is_what_a_recording_leaves(checkout):
    """Name by name, but for the process id."""
    [tree] = blocks("text")
    run(
        *(sys.executable, "-m", "mjrec", "record", "HalfCheetah-v5"),
        *("--out", "recordings/random", "--max-steps", "2", "--size", "32x32"),
        cwd=checkout,
    )
    made = {
        re.sub(
            r"model\.[0-9a-f]{16}",
            "model.9f86d081884c7d65",
            re.sub(r"\.0\.\d+\.", ".0.4711.", path.name),
        )
        for path in (checkout / "recordings" / "random").iterdir()
    }
    assert made == set(re.findall(r"openaigym\.\S+", tree))


def test_links_lead_somewhere():
    """Pictures and pages of the README are there."""
    targets = re.findall(r"\]\((?!https?:)([^)#]+)", (ROOT / "README.md").read_text())
    assert targets
    for target in targets:
        assert (ROOT / target).exists(), target


@pytest.mark.thorough
@pytest.mark.dm_control
def test_scripts_demo_runs(tmp_path):
    """The first command: twenty episodes, six videos, two tables."""
    assert "scripts/demo" in shell_lines()
    out = run(str(ROOT / "scripts" / "demo"), str(tmp_path / "demo"), cwd=ROOT)
    assert len(list((tmp_path / "demo").glob("*/*.mp4"))) == 6
    assert out.count("truncated") == 20


@pytest.mark.parametrize(
    "example",
    [
        pytest.param(
            path,
            marks=pytest.mark.stable_baselines3
            if path.stem == "stable_baselines3_training"
            else pytest.mark.thorough,
        )
        for path in EXAMPLES
    ],
    ids=[path.stem for path in EXAMPLES],
)
def test_example_runs(example, tmp_path):
    """By itself, in an empty directory, and is listed on the examples' page."""
    needs_extras(example.read_text())
    copied = shutil.copy(example, tmp_path)
    run(sys.executable, copied, cwd=tmp_path)
    assert list((tmp_path / "recordings").iterdir())
    assert example.name in (ROOT / "examples" / "README.md").read_text()


@pytest.mark.thorough
def test_command_line_example_runs(tmp_path):
    """It keeps as many videos as it says, and lists its episodes."""
    script = ROOT / "examples" / "command_line" / "evaluate.sh"
    out = run(str(script), str(tmp_path / "out"), cwd=tmp_path)
    assert len(list((tmp_path / "out").glob("*.mp4"))) == 2
    assert out.count("truncated") == 6
    assert "command_line/" in (ROOT / "examples" / "README.md").read_text()


@pytest.mark.thorough
@pytest.mark.dm_control
def test_workflow_records_and_uploads(tmp_path):
    """Its own commands leave what it uploads; the rest is what setup installs too."""
    workflow = yaml.safe_load((ROOT / "examples" / "ci" / "record.yml").read_text())
    [job] = workflow["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    for command in [text for text in commands if text.startswith("mjrec")]:
        run("sh", "-ec", command, cwd=tmp_path)
    [upload] = [s for s in job["steps"] if "upload-artifact" in s.get("uses", "")]
    uploaded = tmp_path / upload["with"]["path"]
    assert len(list(uploaded.rglob("*.mp4"))) == 1
    # What it installs is what the project has.
    setup = (ROOT / "scripts" / "setup").read_text()
    [packages] = [text.split() for text in commands if "apt-get" in text]
    assert all(name in setup for name in packages if name.startswith("lib"))
    [extras] = [text for text in commands if text.startswith("pip")]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for extra in re.findall(r"mjrec\[([^]]+)\]", extras)[0].split(","):
        assert extra in project["optional-dependencies"]
