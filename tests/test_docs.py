# SPDX-License-Identifier: Apache-2.0
"""Test that the documentation and the examples agree with the program."""

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import mjrec
import test_engines
from mjrec.commands import COMMANDS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
README = (ROOT / "README.md").read_text()
TUTORIAL = (DOCS / "tutorial.md").read_text()
SETUP = (ROOT / "scripts" / "setup").read_text()


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def run(*command, cwd):
    """Run a command that finds `mjrec` next to this Python."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    env = {**os.environ, "PATH": path}
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    return done.stdout


def needs_extras(text):
    if "dm_control" in text:
        pytest.importorskip("dm_control", reason="dm_control is not installed here")


def test_texts_stay_within_their_word_limits():
    words = {path: len(path.read_text().split()) for path in DOCS.rglob("*.md")}
    assert sum(words.values()) + len(README.split()) <= 12_000
    assert words[DOCS / "decisions.md"] <= 1_500
    assert len((ROOT / "CHANGELOG.md").read_text().split()) <= 900
    assert len(README.split()) <= 450
    assert README.count("![") == 1


# Takes more than five seconds: it renders 480x480 frames in software.
def test_readme_program_leaves_the_files_that_readme_shows(tmp_path):
    [code], [tree] = blocks(README, "python"), blocks(README, "text")
    run(sys.executable, "-c", code, cwd=tmp_path)
    there = (tmp_path / "recordings" / "halfcheetah").iterdir()
    shown = set(re.findall(r"openaigym\.\S+", tree))
    assert len(shown) == 4
    assert shown <= {re.sub(r"\.0\.\d+\.", ".0.4711.", path.name) for path in there}


@pytest.mark.thorough
@pytest.mark.parametrize(
    "line", re.findall(r"^mjrec [^#\n]*", "".join(blocks(README, "sh")), re.MULTILINE)
)
def test_readme_command_runs_and_names_its_videos(line, tmp_path):
    needs_extras(line)
    out = run(sys.executable, "-m", *shlex.split(line), cwd=tmp_path)
    assert ".mp4" in out


@pytest.mark.thorough
@pytest.mark.dm_control
def test_demo_makes_twenty_episodes_and_six_videos(tmp_path):
    assert "\nscripts/demo " in README
    out = run(str(ROOT / "scripts" / "demo"), str(tmp_path / "demo"), cwd=ROOT)
    assert len(list((tmp_path / "demo").glob("*/*.mp4"))) == 6
    assert out.count("truncated") == 20


def test_links_of_the_readme_exist():
    targets = re.findall(r"\]\((?!https?:)([^)#]+)", README)
    assert targets
    assert [target for target in targets if not (ROOT / target).exists()] == []


def tutorial_commands():
    for block in blocks(TUTORIAL, "console"):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, _, output = part.partition("\n")
            yield command, output


def normalized(text):
    """Return the lines without the values that differ between machines."""
    text = re.sub(r"\.0\.\d+\.video", ".0.4711.video", text)
    text = re.sub(r"-?\d+\.\d+(e-\d+)?", "#", text)
    text = re.sub(r"sha256 [0-9a-f]{64}", "sha256 #", text)
    text = re.sub(r"\d+ kB \(\d+ bytes\)", "# kB", text)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    return [line for line in lines if line]


# Takes minutes: it records, renders, evaluates twice, packs and verifies.
@pytest.mark.thorough
@pytest.mark.timeout(1500)
def test_tutorial_shows_what_its_commands_print(tmp_path):
    program = r'```python title="(\S+)"\n(.*?)```'
    for name, text in re.findall(program, TUTORIAL, re.DOTALL):
        (tmp_path / name).write_text(text)
    for command, output in tutorial_commands():
        printed = run("bash", "-c", command, cwd=tmp_path)
        found = normalized(printed.replace(str(tmp_path), "/home/ada"))
        # In the tutorial, `...` stands for any number of lines.
        shown = "".join(
            r"(?:.*\n)*" if line == "..." else re.escape(line) + "\n"
            for line in normalized(output)
        )
        text = "".join(f"{line}\n" for line in found)
        assert re.fullmatch(shown, text), f"{command}\n{printed}"
    assert (tmp_path / "run.zip").is_file()


# Takes more than five seconds: it reads every page and public docstring.
def test_site_builds_without_warnings(tmp_path):
    pytest.importorskip("mkdocs", reason="the documentation's tools are not here")
    build = (sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir")
    run(*build, str(tmp_path / "site"), cwd=ROOT)
    commands = (tmp_path / "site" / "reference" / "commands" / "index.html").read_text()
    assert all(f"mjrec {name}" in commands for name in COMMANDS)


def test_generated_pages_list_all_names_and_opengl_messages():
    pytest.importorskip("mkdocs", reason="the documentation's tools are not here")
    pages = runpy.run_path(str(ROOT / "scripts" / "docs_pages.py"))
    listed = [name for names in pages["GROUPS"].values() for name in names.split()]
    errors = set(mjrec.errors.KINDS)
    of_extras = {"DmEnvMonitor", "Replay", "write_replay"}
    assert sorted(listed) == sorted({*mjrec.__all__, *of_extras} - errors)
    text = pages["gl_page"]()
    assert all(f"`{message}`" in text for _, message in pages["GL_MESSAGES"])


def test_headless_page_lists_packages_of_setup():
    text = (DOCS / "howto" / "headless.md").read_text()
    [line] = [x for x in text.splitlines() if x.startswith("apt-get install -y libegl")]
    packages = [word for word in line.split() if word.startswith("lib")]
    assert packages
    assert all(package in SETUP for package in packages)


def test_clusters_page_lists_tested_guarantees_in_order():
    tested = []
    for name, test in vars(test_engines).items():
        for mark in getattr(test, "pytestmark", ()):
            if name.startswith("test_") and mark.args[:1] == ("engine",):
                cases = [getattr(each, "values", [each])[0] for each in mark.args[1]]
                tested.append(set(cases))
    text = (DOCS / "howto" / "clusters.md").read_text()
    lines = text[text.index("|guarantee|") :].partition("\n\n")[0].splitlines()
    [_, *names], _, *rows = (line.strip("|").split("|") for line in lines)
    engines = [name.lower().split()[0] for name in names]
    listed = [
        {e for e, at in zip(engines, row, strict=True) if at == "✓"} for _, *row in rows
    ]
    assert listed == tested


@pytest.mark.thorough
@pytest.mark.dm_control
def test_program_of_the_dm_control_page_runs(tmp_path):
    needs_extras("dm_control")
    [code] = blocks((DOCS / "howto" / "dm-control.md").read_text(), "python")
    run(sys.executable, "-c", code, cwd=tmp_path)
    results = mjrec.load_results(tmp_path / "recordings" / "cheetah")
    assert len(results["videos"]) == 1
    assert results["env_info"]["env_id"] == "dm_control/cheetah-run"


def example_case(path):
    is_training = path.stem == "stable_baselines3_training"
    marker = "stable_baselines3" if is_training else "thorough"
    return pytest.param(path, id=path.stem, marks=getattr(pytest.mark, marker))


@pytest.mark.parametrize("example", [*map(example_case, EXAMPLES)])
def test_example_runs_alone_and_is_listed(example, tmp_path):
    needs_extras(example.read_text())
    run(sys.executable, shutil.copy(example, tmp_path), cwd=tmp_path)
    assert list((tmp_path / "recordings").iterdir())
    assert example.name in (ROOT / "examples" / "README.md").read_text()


@pytest.mark.thorough
def test_shell_example_runs_and_is_listed(tmp_path):
    script = ROOT / "examples" / "command_line" / "evaluate.sh"
    out = run(str(script), str(tmp_path / "out"), cwd=tmp_path)
    assert len(list((tmp_path / "out").glob("*.mp4"))) == 2
    assert out.count("truncated") == 6
    assert "command_line/" in (ROOT / "examples" / "README.md").read_text()


@pytest.mark.thorough
@pytest.mark.dm_control
def test_workflow_records_what_it_uploads(tmp_path):
    """The packages and extras that the workflow installs exist."""
    workflow = yaml.safe_load((ROOT / "examples" / "ci" / "record.yml").read_text())
    [job] = workflow["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    for command in commands:
        if command.startswith("mjrec"):
            run("sh", "-ec", command, cwd=tmp_path)
    [upload] = [s for s in job["steps"] if "upload-artifact" in s.get("uses", "")]
    assert len(list((tmp_path / upload["with"]["path"]).rglob("*.mp4"))) == 1
    [packages] = [text.split() for text in commands if "apt-get" in text]
    assert all(name in SETUP for name in packages if name.startswith("lib"))
    [extras] = [text for text in commands if text.startswith("pip")]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for extra in re.findall(r"mjrec\[([^]]+)\]", extras)[0].split(","):
        assert extra in project["optional-dependencies"]
