# SPDX-License-Identifier: Apache-2.0
"""The process that checks: its limits, its death, and what is left of it."""

from __future__ import annotations

import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from packed_runs import edit_trajectory, the
from parts import parametrize
from processes import children

import mjrec
from mjrec.evidence.verification import Check, Level, Verdict
from mjrec.evidence.verifying.level_process import checks_of
from mjrec.evidence.verifying.task import Task
from mjrec.formats.locks import Lock
from mjrec.sandbox import LIMITS


@pytest.fixture(scope="module")
def recordings(pendulums: Callable[..., Path]) -> Path:
    """One episode with a video."""
    return pendulums(1)


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where temporary folders are made."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def checked(
    recordings: Path,
    place: Path,
    meddle: Callable[[int], object] = lambda _: None,
    *,
    patience_s: float = 60.0,
    **limits: int,
) -> list[Check]:
    """Check, and call `meddle` with the process's number after the first check."""
    before = children()
    checks = checks_of(
        Task(recordings=recordings),
        bag=None,
        place=place,
        told=lambda *_: None,
        limits={**LIMITS, **limits},
        patience_s=patience_s,
    )
    first = next(checks)
    [child] = children() - before
    meddle(child)
    found = [first, *checks]
    assert children() == before
    return found


def ends_with(checks: list[Check], reason: str) -> None:
    """Check that one failure says why, and that the rest is not checkable."""
    [failure] = [check for check in checks if check.verdict is Verdict.FAIL]
    assert reason in failure.reason
    later = checks[checks.index(failure) + 1 :]
    assert {check.verdict for check in later} <= {Verdict.NOT_CHECKABLE}
    assert {check.level for check in checks} == set(Level)


def test_death_of_the_process_is_a_failed_check(
    recordings: Path, tmp_path: Path
) -> None:
    """It is no error: what was found before is there."""
    checks = checked(recordings, tmp_path, lambda child: os.kill(child, signal.SIGKILL))
    ends_with(checks, "SIGKILL")


def test_process_that_hangs_is_ended(recordings: Path, tmp_path: Path) -> None:
    """After it was silent for so long."""
    checks = checked(
        recordings,
        tmp_path,
        lambda child: os.kill(child, signal.SIGSTOP),
        patience_s=2.0,
    )
    ends_with(checks, "nothing was heard of it for 2 seconds")


def test_memory_of_the_process_is_limited(recordings: Path, tmp_path: Path) -> None:
    """The checks end where it is not enough, and this process goes on."""
    checks = checked(recordings, tmp_path, RLIMIT_DATA=120 << 20)
    ends_with(checks, "ended")


def test_process_has_its_limits_and_no_trust(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the user trusts otherwise is not what a stranger has packed."""
    monkeypatch.setenv("MJREC_TRUST_MODELS", "1")
    seen: dict[str, str] = {}

    def look(child: int) -> None:
        for name in ("limits", "environ"):
            seen[name] = Path(f"/proc/{child}/{name}").read_text()
        os.kill(child, signal.SIGKILL)

    checked(recordings, tmp_path, look)
    assert "MJREC_TRUST_MODELS" not in seen["environ"]
    assert f"TMPDIR={tmp_path}" in seen["environ"]
    limits = dict(line.split("  ", 1) for line in seen["limits"].splitlines())
    assert limits["Max data size"].split()[0] == str(LIMITS["RLIMIT_DATA"])
    assert limits["Max core file size"].split()[0] == "0"


@pytest.mark.usefixtures("default_signals")
def test_interruption_leaves_nothing(recordings: Path, temporary: Path) -> None:
    """Ctrl-C: no process, no temporary folder."""
    before = children()

    def interrupt(_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        mjrec.verify(recordings, level="stats", on_progress=interrupt)
    assert children() == before
    assert list(temporary.iterdir()) == []


@pytest.mark.thorough
def test_nothing_is_left_after_a_verification(
    recordings: Path, temporary: Path
) -> None:
    """What was unpacked is removed."""
    archive = mjrec.pack(recordings, temporary.parent / "run.zip")
    before = children()
    mjrec.verify(archive, level="stats")
    assert children() == before
    assert list(temporary.iterdir()) == []


@pytest.mark.thorough
def test_folders_that_killed_verifications_left_are_removed(
    recordings: Path, temporary: Path
) -> None:
    """Not those of the living, nor those that may be anything else."""
    names = ("killed", "living", "unknown")
    killed, living, unknown = (temporary / f"mjrec-verify-{name}" for name in names)
    for folder in (killed, living, unknown):
        (folder / "unpacked").mkdir(parents=True)
    (killed / "lock").touch()
    lock = Lock(living / "lock", "")
    for folder in (killed, living):
        os.utime(folder / "lock", (0, 0))
    mjrec.verify(recordings, level="files")
    assert set(temporary.iterdir()) == {living, unknown}
    lock.release()


def test_process_ends_with_its_parent(recordings: Path, tmp_path: Path) -> None:
    """However that one dies."""
    program = tmp_path / "program.py"
    program.write_text(
        "import os, sys, mjrec\n"
        "def told(progress):\n"
        "    [child] = open(f'/proc/self/task/{os.getpid()}/children').read().split()\n"
        "    print(child, flush=True)\n"
        "    sys.stdin.read()\n"
        f"mjrec.verify({str(recordings)!r}, on_progress=told)\n"
    )
    with subprocess.Popen(
        [sys.executable, str(program)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    ) as parent:
        assert parent.stdout is not None
        child = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
    ended, _, _ = select.select([child], [], [], 30)
    os.close(child)
    assert ended


@parametrize(
    "environment",
    [
        {"id": "Evil-v0", "entry_point": "subprocess:check_output"},
        {"id": "subprocess:check_output"},
        {"id": "evil_of_mjrec_tests:Evil-v0"},
        {"id": "InvertedPendulum-v5", "entry_point": "evil_of_mjrec_tests:Evil"},
        {"id": "InvertedPendulum-v5", "kwargs": {"xml_file": "EVIL"}},
    ],
    ids=lambda environment: str(sorted(environment.items()))[:60],
)
def test_code_that_an_archive_names_is_not_run(
    environment: dict[str, object],
    recordings: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Neither as an entry point nor as the module of an id."""
    marker = tmp_path / "marker"
    modules = tmp_path / "modules"
    modules.mkdir()
    (modules / "evil_of_mjrec_tests.py").write_text(f"open({str(marker)!r}, 'w')\n")
    monkeypatch.setenv("PYTHONPATH", str(modules))
    monkeypatch.syspath_prepend(modules)
    folder = Path(shutil.copytree(recordings, tmp_path / "recordings"))
    recorded = {
        "framework": "gymnasium",
        "kwargs": {"args": ["touch", str(marker)]},
        "wrappers": [],
        "max_episode_steps": 8,
    }
    said = json.loads(json.dumps(environment).replace("EVIL", str(marker)))
    path = the(folder, "*episode000000.h5")
    edit_trajectory(path, environment={**recorded, **said})
    verification = mjrec.verify(folder, level="physics")
    assert not marker.exists()
    # The process came to its end.
    assert not any("come to an end" in check.claim for check in verification.checks)


@pytest.mark.thorough
def test_model_that_includes_files_from_outside_is_not_compiled(
    recordings: Path, tmp_path: Path
) -> None:
    """Neither by an absolute path nor by a relative one."""
    folder = Path(shutil.copytree(recordings, tmp_path / "recordings"))
    secret = tmp_path / "secret.xml"
    secret.write_text("<mujoco><option timestep='0.5'/></mujoco>")
    model = the(folder, "openaigym.model.*.zip")
    with zipfile.ZipFile(model) as file:
        contents = {name: file.read(name) for name in file.namelist()}
    with zipfile.ZipFile(model, "w") as file:
        for name, content in contents.items():
            if name.endswith(".xml"):
                include = f'<include file="{secret}"/></mujoco>'.encode()
                content = content.replace(b"</mujoco>", include)
            file.writestr(name, content)
    the(folder, "*.mjb.gz").unlink()
    # Of one that is known, the model is the registry's.
    edit_trajectory(
        the(folder, "*episode000000.h5"),
        environment={"framework": "gymnasium", "id": "Mine-v0", "kwargs": {}},
        env_id="Mine-v0",
    )
    verification = mjrec.verify(folder, level="physics")
    of_physics = [
        check
        for check in verification.checks
        if check.level is Level.PHYSICS and "the name" not in check.claim
    ]
    assert {check.verdict for check in of_physics} == {Verdict.NOT_CHECKABLE}
    assert not any("come to an end" in check.claim for check in verification.checks)
