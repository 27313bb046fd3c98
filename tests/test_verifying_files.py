# SPDX-License-Identifier: Apache-2.0
"""The level `files`: what is honest passes, and what is not is found."""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from packed_runs import (
    edit_json,
    make_bag_fit,
    make_manifests_fit,
    the,
    unpacked,
    zipped,
)

import mjrec
from mjrec.evidence.verification import Check, Level, Verdict
from mjrec.evidence.verifying.bag_checks import check_bag
from mjrec.evidence.verifying.file_checks import check_files
from mjrec.evidence.verifying.task import Task


@pytest.fixture(scope="module")
def packed(
    pendulums: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A packed run of three episodes, two with videos."""
    path = tmp_path_factory.mktemp("packed") / "run.zip"
    return mjrec.pack(pendulums(3, mode="evaluation"), path, title="Pendulum")


@pytest.fixture
def bag(packed: Path, tmp_path: Path) -> Path:
    """The same, unpacked, to be changed."""
    return unpacked(packed, tmp_path / "unpacked")


def failures(bag: Path) -> list[tuple[str, str]]:
    """Return the subjects and reasons of what the level `files` finds wrong."""
    task = Task(recordings=bag / "data" / "recordings", level=Level.FILES)
    checks = check_files(task, lambda *_: None, bag=bag)
    return [(c.subject, c.reason) for c in checks if c.verdict is Verdict.FAIL]


def test_packed_run_passes(packed: Path) -> None:
    """Whole, in a process of its own."""
    verification = mjrec.verify(packed, level="stats")
    assert verification.failures == ()
    assert verification.count(Verdict.NOT_CHECKABLE) == 0
    assert {check.level for check in verification.checks} == {Level.FILES, Level.STATS}


@pytest.mark.thorough
def test_unpacked_run_passes(bag: Path) -> None:
    """As `unzip` leaves it, by its own folder or by the one around it."""
    for path in (bag, bag.parent):
        assert mjrec.verify(path, level="files").failures == ()


def test_recordings_that_were_not_packed_cannot_lack_files(bag: Path) -> None:
    """Nothing says what was there; what is there is checked."""
    verification = mjrec.verify(bag / "data" / "recordings", level="files")
    assert verification.passed
    [unknown] = [
        check for check in verification.checks if check.verdict is Verdict.NOT_CHECKABLE
    ]
    assert "not packed" in unknown.reason


@pytest.mark.parametrize(
    ("forge", "subject", "reason"),
    [
        (lambda b: the(b, "*000000.mp4").unlink(), "000000.mp4", "missing"),
        (lambda b: (b / "data/new.txt").write_text(""), "data/new.txt", "nothing says"),
        (lambda b: (b / "new.txt").write_text(""), "new.txt", "nothing says"),
        (
            lambda b: (b / "data/README.md").rename(b / "data/README.txt"),
            "data/README.md",
            "missing",
        ),
        (lambda b: (b / "data/README.md").write_text("new"), "README.md", "changed"),
        (lambda b: (b / "bag-info.txt").write_text("new"), "bag-info.txt", "changed"),
        (lambda b: (b / "data/link").symlink_to("README.md"), "data/link", "link"),
        (
            lambda b: (b / "fetch.txt").write_text("http://x/ 1 data/x\n"),
            "fetch.txt",
            "elsewhere",
        ),
        (lambda b: (b / "manifest-sha512.txt").unlink(), "manifest-sha512", "read"),
    ],
)
def test_change_to_a_packed_run_is_found(
    forge: Callable[[Path], object], subject: str, reason: str, bag: Path
) -> None:
    """By whoever has not the means to write the manifests anew."""
    forge(bag)
    found = failures(bag)
    assert any(subject in which and reason in why for which, why in found), found


@pytest.mark.parametrize(
    "name",
    ["../outside", "/etc/passwd", "data/../../outside", "C:/x", "data\\x", "bagit.txt"],
)
def test_bag_that_names_files_outside_is_found(name: str, bag: Path) -> None:
    """None of them is opened."""
    manifest = bag / "manifest-sha512.txt"
    with manifest.open("a") as file:
        file.write(f"{'0' * 128}  {name}\n")
    lines = len(manifest.read_text().splitlines())
    found = failures(bag)
    assert any(f"line {lines}" in why for _, why in found), found


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("bagit.txt", "BagIt-Version: 2.0\nTag-File-Character-Encoding: UTF-8\n"),
        ("bagit.txt", "BagIt-Version: 1.0\nTag-File-Character-Encoding: UTF-16\n"),
        ("bag-info.txt", "Mjrec-Evidence-Version: 2\n"),
        ("bag-info.txt", "Bagging-Date: 2026-01-01\n"),
    ],
)
def test_unknown_version_is_found(name: str, text: str, bag: Path) -> None:
    """What a newer version means, this one cannot know."""
    (bag / name).write_text(text)
    make_bag_fit(bag)
    assert [subject for subject, _ in failures(bag)] == [name]


@pytest.mark.parametrize(
    ("forge", "subject"),
    [
        (lambda b: (b / "data/notes.txt").write_text("x"), "data/notes.txt"),
        (lambda b: (b / "data/.hidden").write_text("x"), "data/.hidden"),
        (lambda b: (b / "notes.txt").write_text("x"), "notes.txt"),
        (lambda b: (b / "data/CITATION.cff").unlink(), "data/CITATION.cff"),
        (
            lambda b: shutil.copytree(b / "data/recordings", b / "data/more"),
            "data/more",
        ),
        (lambda b: (b / "data/more").mkdir(), "data/more"),
        (
            lambda b: (
                (b / "data/recordings/openaigym.model.0123456789abcdef.zip")
                # Called like what a model was made from.
                .write_text("x")
            ),
            "openaigym.model.0123456789abcdef.zip",
        ),
    ],
)
def test_file_that_no_packed_run_has_is_found(
    forge: Callable[[Path], object], subject: str, bag: Path
) -> None:
    """In manifests and a crate that list it."""
    forge(bag)
    make_bag_fit(bag)
    assert subject in [which for which, _ in failures(bag)]


def edit_crate(entity: str, edit: Callable[[Any], object]) -> Callable[[Path], None]:
    """Return what changes one entity of a crate."""

    def change(bag: Path) -> None:
        edit_json(
            bag / "data" / "ro-crate-metadata.json",
            lambda crate: [edit(e) for e in crate["@graph"] if e["@id"] == entity],
        )

    return change


@pytest.mark.parametrize(
    ("forge", "subject", "reason"),
    [
        (
            edit_crate("README.md", lambda e: e.update(contentSize="3")),
            "data/README.md",
            "said to have 3 bytes",
        ),
        (
            edit_crate("recordings/", lambda e: e["hasPart"].pop(0)),
            "data/recordings/openaigym.episode_batch",
            "there and not listed",
        ),
        (
            edit_crate("./", lambda e: e["hasPart"].append({"@id": "paper.pdf"})),
            "data/paper.pdf",
            "listed and not there",
        ),
        (
            edit_crate("./", lambda e: e.pop("hasPart")),
            "data/ro-crate",
            "does not list",
        ),
        (edit_crate("./", lambda e: e.update(hasPart=7)), "data/ro-crate", "be read"),
        (
            edit_crate("README.md", lambda e: e.update({"@id": ["./"]})),
            "data/ro-crate",
            "be read",
        ),
    ],
)
def test_crate_that_lists_other_files_is_found(
    forge: Callable[[Path], object], subject: str, reason: str, bag: Path
) -> None:
    """Also where it makes no sense at all."""
    forge(bag)
    make_manifests_fit(bag)
    [(which, why)] = failures(bag)
    assert which.startswith(subject)
    assert reason in why


def swap_contents(one: Path, other: Path) -> None:
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)


@pytest.mark.parametrize(
    ("forge", "subject", "reason"),
    [
        (
            lambda r: swap_contents(the(r, "*000000.mp4"), the(r, "*000001.mp4")),
            "video000000.mp4",
            "SHA-256",
        ),
        (
            lambda r: (r / "openaigym.video.0.7.video000009.mp4").write_bytes(b"x"),
            "video000009.mp4",
            "no metadata",
        ),
        (lambda r: (r / "notes.txt").write_text("x"), "notes.txt", "no recording"),
        (lambda r: (r / ".hidden").write_text("x"), ".hidden", "no recording"),
        (lambda r: the(r, "*000001.meta.json").unlink(), "000001.mp4", "no metadata"),
        (lambda r: the(r, "*000001.mp4").unlink(), "000001.meta.json", "is missing"),
        (lambda r: the(r, "*.manifest.json").unlink(), "", "no manifest"),
        (
            lambda r: edit_json(the(r, "*.manifest.json"), lambda m: m["videos"].pop()),
            "video000001.mp4",
            "no manifest lists it",
        ),
        (
            lambda r: edit_json(
                the(r, "*000001.meta.json"), lambda m: m.update(frame_count=1)
            ),
            "video000001.mp4",
            "1 frames",
        ),
    ],
)
def test_forged_recordings_are_found_in_manifests_that_fit(
    forge: Callable[[Path], object], subject: str, reason: str, bag: Path
) -> None:
    """What the files say of each other is checked, whatever the bag says."""
    forge(bag / "data" / "recordings")
    make_bag_fit(bag)
    found = failures(bag)
    assert any(subject in which and reason in why for which, why in found), found


def test_dropped_line_of_frame_hashes_is_found(bag: Path) -> None:
    """There is one for each frame, in their order."""
    path = the(bag, "*000001.framehash")
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-2] + lines[-1:]))
    make_bag_fit(bag)
    [(subject, reason)] = failures(bag)
    assert subject.endswith("video000001.mp4")
    assert "no hash of frame" in reason


def test_model_under_another_models_name_is_found(bag: Path) -> None:
    """The digits in its name are those of its content."""
    path = the(bag, "*.mjb.gz")
    path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes()) + b"x"))
    make_bag_fit(bag)
    assert [subject for subject, _ in failures(bag)] == [path.name]


def test_model_that_unpacks_to_no_end_is_found(bag: Path) -> None:
    """Before it has filled anything."""
    path = the(bag, "*.mjb.gz")
    with gzip.open(path, "wb", 1) as file:
        for _ in range(300):
            file.write(bytes(1 << 20))
    make_bag_fit(bag)
    [(subject, reason)] = failures(bag)
    assert subject == path.name
    assert "far more than any model" in reason


def test_many_failures_are_told_in_few_checks(tmp_path: Path) -> None:
    """A hundred thousand wrong files are no hundred thousand lines."""
    (tmp_path / "bagit.txt").write_text("x")
    for number in range(300):
        (tmp_path / f"{number}").write_text("x")
    checks: list[Check] = list(check_bag(tmp_path, lambda *_: None))
    assert 100 < len(checks) < 110
    assert any("likewise" in check.reason for check in checks)


def test_zip_of_a_changed_bag_fails(bag: Path, tmp_path: Path) -> None:
    """The archive is well-formed: it is no error, but a failed check."""
    (bag / "data" / "README.md").write_text("new")
    verification = mjrec.verify(zipped(bag, tmp_path / "new.zip"), level="files")
    assert {f.subject for f in verification.failures} == {"data/README.md"}
    assert not verification.passed


def test_nothing_is_written_into_what_is_verified(bag: Path) -> None:
    """Neither beside the recordings nor anywhere else in a folder."""
    before = {p: p.stat().st_mtime_ns for p in sorted(bag.rglob("*"))}
    mjrec.verify(bag, level="stats")
    assert {p: p.stat().st_mtime_ns for p in sorted(bag.rglob("*"))} == before


def test_directory_without_recordings_is_an_error(tmp_path: Path) -> None:
    """And it says what would be one."""
    with pytest.raises(mjrec.UnreadableFile, match=r"bagit.txt"):
        mjrec.verify(tmp_path)


def test_missing_archive_is_an_error(tmp_path: Path) -> None:
    """It names the file."""
    with pytest.raises(mjrec.UnreadableFile, match=r"no such file"):
        mjrec.verify(tmp_path / "run.zip")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"level": "bones"}, "files, stats, physics, pixels"),
        ({"sample": 0}, "1 or more"),
        ({"report": "/no/such/folder/report.html"}, "no such directory"),
    ],
)
def test_options_are_checked_first(
    options: dict[str, object], message: str, packed: Path
) -> None:
    """Before anything is unpacked."""
    with pytest.raises(mjrec.Error, match=message):
        mjrec.verify(packed, **options)  # type: ignore[arg-type]  # that is the point


@pytest.mark.thorough
def test_others_files_beside_recordings_are_nobodys_business(
    packed: Path, tmp_path: Path
) -> None:
    """Of a directory that was not packed; what is called like ours is told."""
    recordings = unpacked(packed, tmp_path / "u") / "data" / "recordings"
    (recordings / "notes.txt").write_text("mine")
    assert mjrec.verify(recordings, level="files").passed
    shutil.copy(recordings / "notes.txt", recordings / "openaigym.evil.txt")
    [failure] = mjrec.verify(recordings, level="files").failures
    assert failure.subject == "openaigym.evil.txt"


@pytest.mark.thorough
def test_facts_say_what_was_verified_with_what(packed: Path) -> None:
    """The archive's hash among them, for whoever keeps the verdict."""
    facts = mjrec.verify(packed, level="files", seed=3).facts
    assert facts["archive"]["kind"] == "packed run"
    assert len(facts["archive"]["sha256"]) == 64
    assert facts["seed"] == 3
    assert facts["versions"]["mjrec"] == mjrec.__version__
    json.dumps(facts)
