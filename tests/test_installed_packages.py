# SPDX-License-Identifier: Apache-2.0
"""Which packages a manifest names, and by what it tells builds of them apart."""

from __future__ import annotations

import hashlib
import importlib.metadata
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from mjrec.installed_packages import installed_packages

RECORD = """\
gripper/__init__.py,sha256=abc,12
gripper/__pycache__/__init__.cpython-311.pyc,,
"gripper/with,comma.py",sha256=def,3
gripper-1.5.dist-info/RECORD,,
gripper-1.5.dist-info/INSTALLER,sha256=ghi,4
gripper-1.5.dist-info/METADATA,sha256=jkl,5
../../bin/gripper,sha256=mno,6
"""
OF_THE_WHEEL = """\
"gripper/with,comma.py",sha256=def,3
gripper-1.5.dist-info/METADATA,sha256=jkl,5
gripper/__init__.py,sha256=abc,12"""


def install(directory: Path, version: str, record: str | None = None) -> None:
    """Put what an installer leaves of a package called Gripper into a directory."""
    info = directory / f"gripper-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Name: Gripper\nVersion: {version}\n")
    if record is not None:
        (info / "RECORD").write_text(record)


@pytest.fixture(params=["child", "no child", "child that fails", "child that prints"])
def _way(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Whoever reads the packages: another process, or this one where none can."""
    programs = {
        "no child": None,
        "child that fails": "#!/bin/sh\necho '{}'\nexit 3\n",
        "child that prints": "#!/bin/sh\necho Welcome.\n",
    }
    if request.param in programs:
        program, text = tmp_path / "python", programs[request.param]
        if text is not None:
            program.write_text(text)
            program.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(program))


every_way = pytest.mark.usefixtures("_way")


@every_way
def test_packages_are_those_that_python_itself_names() -> None:
    """All of them, in the order of their names, each with its version."""
    found = installed_packages()
    expected = {
        each.metadata["Name"]: importlib.metadata.version(each.metadata["Name"])
        for each in importlib.metadata.distributions()
    }
    assert {name: facts["version"] for name, facts in found.items()} == expected
    assert list(found) == sorted(found, key=str.lower)
    assert {"mjrec", "numpy", "mujoco"} <= found.keys()


@every_way
def test_hashes_are_of_what_a_wheel_consists_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the order of its lines, and whatever its installer adds to them."""
    install(tmp_path, "1.5", RECORD)
    monkeypatch.syspath_prepend(tmp_path)
    expected = hashlib.sha256(OF_THE_WHEEL.encode()).hexdigest()
    assert installed_packages()["Gripper"] == {
        "version": "1.5",
        "record_sha256": expected,
    }


@every_way
def test_a_package_without_a_list_of_its_files_has_no_hash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As those of a distribution's packager; it is named all the same."""
    install(tmp_path, "2.0")
    monkeypatch.syspath_prepend(tmp_path)
    assert installed_packages()["Gripper"] == {
        "version": "2.0",
        "record_sha256": None,
    }


@every_way
@pytest.mark.parametrize(
    "add",
    [lambda place: sys.path.append(place), lambda place: sys.path.insert(0, place)],
)
def test_the_first_on_the_path_counts(
    add: Callable[[str], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is the one that is imported here, wherever on `sys.path` the two are."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    for version in ("1.0", "3.0", "2.0"):
        install(tmp_path / version, version)
        add(str(tmp_path / version))
    imported = importlib.metadata.version("gripper")
    assert imported in ("1.0", "2.0")
    assert installed_packages()["Gripper"]["version"] == imported


@every_way
def test_the_working_directory_counts_where_it_is_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python puts it on the path as an empty name."""
    install(tmp_path / "work", "1.0")
    monkeypatch.chdir(tmp_path / "work")
    assert "Gripper" not in installed_packages()
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    assert installed_packages()["Gripper"]["version"] == "1.0"


@every_way
def test_what_is_no_text_on_the_path_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Python's own import does: a `Path` there finds nothing."""
    install(tmp_path, "1.0")
    before = installed_packages()
    monkeypatch.setattr(sys, "path", [tmp_path, None, *sys.path])
    assert installed_packages() == before


@every_way
def test_names_in_other_scripts_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of directories on the path, in whatever locale the child runs."""
    monkeypatch.setenv("LC_ALL", "C")
    monkeypatch.setenv("PYTHONUTF8", "0")
    place = tmp_path / "Größe 重み: 1"
    install(place, "1.0")
    monkeypatch.syspath_prepend(place)
    assert installed_packages()["Gripper"]["version"] == "1.0"
