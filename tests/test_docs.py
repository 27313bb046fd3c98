# SPDX-License-Identifier: Apache-2.0
"""The documentation's pages agree with the program, and its site builds."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import mjrec
from mjrec.commands import COMMANDS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SETUP = (ROOT / "scripts" / "setup").read_text()


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    """Return the hook that generates pages."""
    pytest.importorskip("mkdocs", reason="the documentation's tools are not here")
    spec = importlib.util.spec_from_file_location(
        "docs_pages", ROOT / "scripts" / "docs_pages.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# Takes more than five seconds: every page, and every docstring behind the names.
def test_site_builds_without_a_warning(pages: ModuleType, tmp_path: Path) -> None:
    """No dead link or anchor, no page outside the navigation, no broken docstring."""
    done = subprocess.run(
        [
            *(sys.executable, "-m", "mkdocs", "build", "--strict"),
            *("--site-dir", str(tmp_path / "site")),
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.returncode == 0, done.stderr
    commands = (tmp_path / "site" / "reference" / "commands" / "index.html").read_text()
    assert all(f"mjrec {name}" in commands for name in COMMANDS)


def test_every_public_name_has_its_place(pages: ModuleType) -> None:
    """Each name of the package is in one group of the reference; errors have theirs."""
    listed = [name for names in pages.GROUPS.values() for name in names.split()]
    errors = set(mjrec.errors.KINDS)
    of_extras = {"DmEnvMonitor", "Replay", "write_replay"}
    assert sorted(listed) == sorted({*mjrec.__all__, *of_extras} - errors)


def test_every_known_message_of_opengl_is_explained(pages: ModuleType) -> None:
    """Each has a cause and a fix on the page."""
    text = pages.gl_page()
    for _, message in pages.GL_MESSAGES:
        assert f"`{message}`" in text


def test_pages_stay_short() -> None:
    """README and pages have at most 12,000 words, as `wc -w` counts; some less."""
    pages = [ROOT / "README.md", *DOCS.rglob("*.md")]
    words = {path: len(path.read_text().split()) for path in pages}
    assert sum(words.values()) <= 12_000
    assert words[DOCS / "decisions.md"] <= 1_500
    assert len((ROOT / "CHANGELOG.md").read_text().split()) <= 900


def test_system_packages_are_those_that_setup_installs() -> None:
    """The apt line of the headless page names what scripts/setup looks for."""
    text = (DOCS / "howto" / "headless.md").read_text()
    [line] = [x for x in text.splitlines() if x.startswith("apt-get install -y libegl")]
    packages = [word for word in line.split() if word.startswith("lib")]
    assert packages
    assert all(package in SETUP for package in packages)


@pytest.mark.thorough
@pytest.mark.dm_control
def test_dm_control_page_runs(tmp_path: Path) -> None:
    """Its program runs as it stands, and leaves a video of a named environment."""
    pytest.importorskip("dm_control", reason="dm_control is not installed here")
    text = (DOCS / "howto" / "dm-control.md").read_text()
    [code] = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, timeout=280)
    results = mjrec.load_results(tmp_path / "recordings" / "cheetah")
    assert results is not None
    assert len(results["videos"]) == 1
    assert results["env_info"]["env_id"] == "dm_control/cheetah-run"
