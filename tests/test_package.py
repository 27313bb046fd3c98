# SPDX-License-Identifier: Apache-2.0
"""Test the packages' content and metadata, and the wheel without a checkout."""

import email
import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import mjrec

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src"


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """Build as `scripts/build` does: the sdist, and from it the wheel."""
    pytest.importorskip("build", reason="the tools for packages are missing")
    folder = tmp_path_factory.mktemp("packages")
    command = [sys.executable, "-m", "build", "--no-isolation"]
    command += ["--outdir", str(folder), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True, timeout=280)
    return folder


@pytest.fixture(scope="module")
def wheel(packages):
    """Return the wheel's files."""
    [path] = packages.glob("*.whl")
    with zipfile.ZipFile(path) as packed:
        return {name: packed.read(name) for name in packed.namelist()}


def test_sdist_contains_what_testing_needs_but_no_environment(packages):
    [path] = packages.glob("*.tar.gz")
    with tarfile.open(path) as packed:
        names = {name.partition("/")[2] for name in packed.getnames()}
    needed = ("src/mjrec/py.typed", "tests/conftest.py", "scripts/test", "README.md")
    assert names.issuperset(needed)
    assert not [name for name in names if name.startswith((".venv", ".git/"))]


def test_wheel_contains_exactly_the_package(wheel):
    package = {
        str(path.relative_to(SOURCE))
        for path in (SOURCE / "mjrec").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert any(name.endswith(".html.jinja") for name in package)
    assert {name for name in wheel if ".dist-info/" not in name} == package
    assert any(name.endswith("licenses/LICENSE") for name in wheel)


def test_metadata_has_license_version_and_typing(wheel):
    [name] = [n for n in wheel if n.endswith("dist-info/METADATA")]
    about = email.message_from_bytes(wheel[name])
    assert about["Name"] == "mjrec"
    assert about["Version"] == mjrec.__version__
    assert about["License-Expression"] == "Apache-2.0"
    assert about["Description-Content-Type"] == "text/markdown"
    assert "Typing :: Typed" in about.get_all("Classifier", [])
    assert f"version: {mjrec.__version__}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.wheel
def test_wheel_alone_records_renders_evaluates_and_reports(tmp_path):
    """The environment contains only the wheel and its dependencies."""
    python = os.environ.get("MJREC_TEST_WHEEL")
    if python is None:
        pytest.fail("scripts/test --all names an environment with the wheel.")

    def run(*arguments):
        options = {"capture_output": True, "text": True, "timeout": 280}
        done = subprocess.run([python, *arguments], cwd=tmp_path, **options)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    where = Path(run("-c", "import mjrec; print(mjrec.__file__)").strip())
    assert not where.is_relative_to(ROOT / "src")
    small = ("--max-steps", "3", "--size", "32x32")
    run("-m", "mjrec", "record", "InvertedPendulum-v5", "--out", "a", *small)
    run("-m", "mjrec", "render", "a", "--episode", "0", "--size", "48x48")
    assert len(list((tmp_path / "a").glob("*.mp4"))) == 2
    few = ("--policy", "random", "--episodes", "2", "--num-seeds", "1", *small)
    run("-m", "mjrec", "evaluate", "InvertedPendulum-v5", "--out", "b", *few)
    run("-m", "mjrec", "report", "a", "b", "-o", "page")
    assert (tmp_path / "page" / "index.html").is_file()
