# SPDX-License-Identifier: Apache-2.0
"""Verify untrusted archives without trusting their files, processes or code."""

import gzip
import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from packed_runs import make_bag_fit, the, unpacked
from parts import parametrize
from processes import children

import honest_runs
import mjrec
from forged_runs import ForgedRun
from mjrec.evidence.findings import Verdict
from mjrec.formats.locks import Lock

EVIL = "evil_of_mjrec_tests"


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """Return a packed run of two episodes with videos."""
    place = tmp_path_factory.mktemp("packed")
    honest_runs.pendulum(place / "recorded", episodes=2)
    return mjrec.pack(place / "recorded", place / "run.zip")


@pytest.fixture
def bag(packed, tmp_path):
    """Return an unpacked copy of the run to edit."""
    return unpacked(packed, tmp_path / "bag")


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """Return the folder in which temporary folders are created."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def failures(bag, level="files"):
    """Return everything that contradicts an archive, one failure per line."""
    found = mjrec.verify(bag, level=level)
    return "\n".join(f"{each.item}: {each.reason}" for each in found.failures)


def test_honest_archive_is_whole(packed, bag):
    """The path may be the zip, its unpacked folder, or the folder around that."""
    for path in (packed, bag, bag.parent):
        found = mjrec.verify(path, level="files")
        assert found.failures == ()
        # The verdict is partial because nothing was recreated.
        assert found.verdict is Verdict.PARTLY


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda b: the(b, "*000000.mp4").unlink(), "000000.mp4"),
        (lambda b: (b / "data/new.txt").write_text(""), "data/new.txt"),
        (lambda b: (b / "new.txt").write_text(""), "new.txt"),
        (lambda b: (b / "data/README.md").rename(b / "data/README.txt"), "README.md"),
        (lambda b: (b / "data/README.md").write_text("new"), "README.md"),
        (lambda b: (b / "bag-info.txt").write_text("new"), "bag-info.txt"),
        (lambda b: (b / "fetch.txt").write_text("http://x/ 1 data/x\n"), "fetch.txt"),
        (lambda b: (b / "manifest-sha512.txt").unlink(), "manifest-sha512"),
    ],
)
def test_changed_bag_is_found(change, said, bag):
    """The manifests reveal any change that does not update them too."""
    change(bag)
    assert said in failures(bag)


@pytest.mark.parametrize(
    "name",
    ["../outside", "/etc/passwd", "data/../../outside", "C:/x", "data\\x", "bagit.txt"],
)
def test_bag_that_names_files_outside_is_found(name, bag):
    """No file outside the bag is opened."""
    with (bag / "manifest-sha512.txt").open("a") as file:
        file.write(f"{'0' * 128}  {name}\n")
    assert re.search("leads out|absolute|backslash|bagit.txt", failures(bag))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("bagit.txt", "BagIt-Version: 2.0\nTag-File-Character-Encoding: UTF-8\n"),
        ("bag-info.txt", "Mjrec-Evidence-Version: 2\n"),
        ("bag-info.txt", "Bagging-Date: 2026-01-01\n"),
    ],
)
def test_unknown_version_is_found(name, text, bag):
    """This version cannot know what a newer one means."""
    (bag / name).write_text(text)
    make_bag_fit(bag)
    assert name in failures(bag)


def test_link_in_an_unpacked_run_is_refused(bag):
    """A link may lead anywhere."""
    (bag / "data/link").symlink_to("README.md")
    with pytest.raises(mjrec.UnreadableArchive, match="link"):
        mjrec.verify(bag, level="files")


@parametrize("suffix", [".mjb.gz", ".framehash"], default=[".mjb.gz"])
def test_files_that_unpack_to_no_end_do_no_harm(suffix, bag):
    """Unpacking stops before it fills memory or disk."""
    if suffix == ".mjb.gz":
        bomb = gzip.compress(bytes(1 << 30), 9)
        the(bag, "openaigym.model.*.mjb.gz").write_bytes(bomb)
    else:
        the(bag, "*000000.framehash").write_text("0, 0, 0, 1, 3, 00\n" * 1_000_000)
    make_bag_fit(bag)
    assert failures(bag, "pixels")


def test_environment_file_is_not_believed(bag):
    """An unreadable file is a failure."""
    (bag / "data/environment.json").write_text("[" * 100_000)
    make_bag_fit(bag)
    assert "environment.json" in failures(bag, "stats")
    (bag / "data/environment.json").write_text(
        '{"recordings": {}, "packed_with": {"options": 7}}'
    )
    make_bag_fit(bag)
    assert failures(bag, "pixels")


def meddled(path, meddle):
    """Verify, and call `meddle` with the id of the first child process."""
    before, met = children(), set()

    def look(_):
        new = children() - before
        if new and not met:
            met.update(new)
            meddle(next(iter(new)))

    found = mjrec.verify(path, level="stats", on_progress=look)
    assert met
    assert children() == before
    return found


@pytest.mark.parametrize(
    ("signum", "reason"),
    [(signal.SIGKILL, "SIGKILL"), (signal.SIGSTOP, "2 seconds")],
)
def test_death_of_a_process_is_a_failure_with_its_reason(
    packed, monkeypatch, signum, reason
):
    """A dead or silent process means FAIL, not an exception."""
    if signum == signal.SIGSTOP:
        monkeypatch.setattr("mjrec.evidence.verify._TIMEOUT_S", 2.0)
    found = meddled(packed, lambda child: os.kill(child, signum))
    assert found.verdict is Verdict.FAIL
    assert reason in found.failures[-1].reason


def test_processes_have_limits_and_no_trust(packed, monkeypatch):
    """A stranger's archive gets no trust from the user's settings."""
    monkeypatch.setenv("MJREC_TRUST_MODELS", "1")
    seen = {}

    def look(child):
        for name in ("limits", "environ"):
            seen[name] = Path(f"/proc/{child}/{name}").read_text()

    meddled(packed, look)
    assert "MJREC_TRUST_MODELS" not in seen["environ"]
    limits = dict(line.split("  ", 1) for line in seen["limits"].splitlines())
    assert limits["Max data size"].split()[0] != "unlimited"
    assert limits["Max core file size"].split()[0] == "0"


@pytest.mark.usefixtures("default_signals", "no_process_is_left")
def test_interruption_leaves_nothing(packed, temporary):
    """After Ctrl-C, no process or temporary folder remains."""
    with pytest.raises(KeyboardInterrupt):
        mjrec.verify(
            packed,
            level="stats",
            on_progress=lambda _: signal.raise_signal(signal.SIGINT),
        )
    assert list(temporary.iterdir()) == []


def test_nothing_is_left_and_nothing_is_written_elsewhere(bag, temporary):
    """Unpacked files are removed, and the input is unchanged."""
    before = {path: path.stat().st_mtime_ns for path in bag.rglob("*")}
    mjrec.verify(bag, level="stats")
    assert {path: path.stat().st_mtime_ns for path in bag.rglob("*")} == before
    assert list(temporary.iterdir()) == []


@pytest.mark.thorough
def test_folders_that_killed_verifications_left_are_removed(packed, temporary):
    """Folders that are in use or of unknown origin are kept."""
    names = ("killed", "living", "unknown")
    killed, living, unknown = (temporary / f"mjrec-verify-{name}" for name in names)
    for folder in (killed, living, unknown):
        (folder / "unpacked").mkdir(parents=True)
    (killed / "lock").touch()
    lock = Lock(living / "lock", "")
    for folder in (killed, living):
        os.utime(folder / "lock", (0, 0))
    mjrec.verify(packed, level="files")
    assert set(temporary.iterdir()) == {living, unknown}
    lock.release()


def test_process_ends_with_its_parent(packed, tmp_path):
    program = (
        "import os, sys, mjrec\n"
        "def told(progress):\n"
        "    told = open(f'/proc/self/task/{os.getpid()}/children').read().split()\n"
        "    if told:\n"
        "        print(told[0], flush=True)\n"
        "        sys.stdin.read()\n"
        f"mjrec.verify({str(packed)!r}, on_progress=told)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    ) as parent:
        child = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
    ended, _, _ = select.select([child], [], [], 30)
    os.close(child)
    assert ended


ENVIRONMENTS = [
    {"id": "Evil-v0", "entry_point": "subprocess:check_output"},
    {"id": "subprocess:check_output"},
    {"id": f"{EVIL}:Evil-v0"},
    {"id": "InvertedPendulum-v5", "entry_point": f"{EVIL}:Evil"},
    {"id": "InvertedPendulum-v5", "kwargs": {"xml_file": "MARKER"}},
    {"id": "InvertedPendulum-v5", "wrappers": [f"{EVIL}.Wrapper"]},
]


@parametrize(
    "environment",
    ENVIRONMENTS,
    default=[ENVIRONMENTS[2], ENVIRONMENTS[5]],
    ids=lambda environment: str(sorted(environment.items()))[:60],
)
def test_code_that_an_archive_names_is_not_run(environment, bag, tmp_path, monkeypatch):
    """Entry points, modules of ids, and wrappers are never imported."""
    marker, modules = tmp_path / "marker", tmp_path / "modules"
    modules.mkdir()
    (modules / f"{EVIL}.py").write_text(f"open({str(marker)!r}, 'w')\n")
    monkeypatch.setenv("PYTHONPATH", str(modules))
    monkeypatch.syspath_prepend(modules)
    said = json.loads(json.dumps(environment).replace("MARKER", str(marker)))

    def edit(facts):
        if isinstance(facts.get("environment"), dict):
            facts["environment"].update(said)

    ForgedRun(bag / "data/recordings").say_everywhere(edit)
    make_bag_fit(bag)
    found = mjrec.verify(bag, level="physics")
    assert not marker.exists()
    assert found.verdict is not Verdict.PASS


@pytest.mark.thorough
def test_model_that_includes_files_from_outside_is_not_compiled(tmp_path):
    """Rendering the model could reveal a secret file."""
    secret = tmp_path / "secret.xml"
    secret.write_text("<mujoco><option timestep='0.5'/></mujoco>")
    honest_runs.mjcf(tmp_path / "run")
    include = f'<include file="{secret}"/></mujoco>'.encode()
    ForgedRun(tmp_path / "run").rewrite_zip(
        lambda content: content.replace(b"</mujoco>", include),
    )
    found = mjrec.verify(tmp_path / "run", level="physics")
    assert found.verdict is Verdict.FAIL
    assert not any("0.5" in str(each) for each in found.failures)


@pytest.mark.parametrize(
    ("options", "kind"),
    [
        ({"level": "all"}, mjrec.UnknownName),
        ({"sample": 0}, mjrec.InvalidArgument),
        ({"sample": True}, mjrec.InvalidArgument),
        ({"sample": np.True_}, mjrec.InvalidArgument),
        ({"sample": np.int64(1)}, mjrec.UnreadableArchive),
        ({"allow": ["anything"]}, mjrec.InvalidArgument),
        ({"report": "/nowhere/at/all.html"}, mjrec.DirectoryNotWritable),
        ({}, mjrec.UnreadableArchive),
    ],
)
def test_options_are_checked_first(options, kind, tmp_path):
    """Options are checked before the archive is looked for."""
    for path in (tmp_path / "nothing.zip", tmp_path):
        with pytest.raises(kind, match=None if options else str(path)):
            mjrec.verify(path, **options)


def test_files_beside_recordings_of_a_directory_do_not_matter(bag):
    """Extra files in a plain directory are ignored unless named like recordings."""
    recordings = Path(shutil.move(bag / "data/recordings", bag.parent / "own"))
    (recordings / "notes.txt").write_text("mine")
    assert failures(recordings, "stats") == ""
    stray = the(recordings, "*000000.h5").name.replace("000000", "000007")
    shutil.copy(the(recordings, "*000000.h5"), recordings / stray)
    assert "episode 7" in failures(recordings, "stats")


def test_facts_say_what_was_verified_with_what(packed):
    """The facts have the archive's hash, versions, and a fresh seed for the sample."""
    first, second = (
        mjrec.verify(packed, level="files", sample=1).facts for _ in range(2)
    )
    assert mjrec.__version__ == first["versions"]["mjrec"]
    assert len(first["archive"]["sha256"]) == 64
    assert None is not first["seed"] != second["seed"]
