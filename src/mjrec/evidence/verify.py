# SPDX-License-Identifier: Apache-2.0
"""Verification of a packed run: it is recreated and compared with the archive."""

from __future__ import annotations

import contextlib
import numbers
import operator
import os
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import (
    DirectoryNotWritable,
    Error,
    InvalidArgument,
    UnknownName,
    UnreadableArchive,
)
from ..formats.json_fields import from_json
from ..formats.locks import Lock, is_locked
from ..machine import machine_fingerprint
from ..provenance import versions
from ..sandbox import Sandbox
from .excuses import with_allowed
from .findings import Excuse, Finding, Level, Outcome, Topic, Verification
from .stages import GIVEN, INPUTS, MADE, MODULE
from .verification_report import write_verification_report

# Compiling a model may take 300 s.
_TIMEOUT_S = 900.0
_SEEDS = 2**32
_PREFIX = "mjrec-verify-"
# A lock held by the process that owns the folder.
_LOCK = "lock"
# A lock's file exists for a moment before the lock is held.
_A_MOMENT_S = 60.0


@dataclass(frozen=True)
class VerificationProgress:
    """Progress of a verification.

    Attributes:
        phase: "reading", "playing", "drawing" or "comparing".
        done: amount of work done in this phase; each phase starts from 0.
        total: total amount of work in this phase.
        seconds_left: estimated time left in this phase, or None if unknown.
    """

    phase: str
    done: int
    total: int
    seconds_left: float | None = None


def verify(
    path: str | os.PathLike[str],
    *,
    level: str = "pixels",
    sample: int | None = None,
    seed: int | None = None,
    trust: Collection[str] = (),
    allow: Collection[str] = (),
    report: str | os.PathLike[str] | None = None,
    on_progress: Callable[[VerificationProgress], object] | None = None,
) -> Verification:
    """Recreate a packed run and compare the result with the archive.

    The archive may come from a stranger. Three processes read it, recreate the run and
    compare the two runs. Each has limits on memory and time, no network and no home
    directory, and sees only the data it needs: the second gets only inputs
    (environment, seeds, actions, options). No code that the archive names is run,
    except environments in `trust`.

    Args:
        path: an archive from `mjrec pack`, an unpacked one, a monitor directory, or a
            folder with several. In directories, missing files cannot be detected.
        level: where to stop: `"files"` (the bag contains what it lists), `"stats"`
            (rewards, ends, statistics and selection of episodes), `"physics"` (also all
            states) or `"pixels"` (also all frames and files).
        sample: number of frames of each video to check. None means all.
        seed: seed for choosing these frames. None means a random seed.
        trust: ids of environments that may be created although they are not in a
            trusted registry. This runs code that you have installed.
        allow: excuses to accept, by name and value: `"gl=NVIDIA H100"`.
        report: path of an HTML report to write.
        on_progress: called with the progress.

    Returns:
        The verdict, PASS, PARTLY or FAIL, with all findings. A difference does not
        raise an error.

    Raises:
        UnreadableArchive: the file is missing, damaged or hostile.
        InvalidArgument: `level` is unknown, `sample` is below 1, or `allow` contains
            an unknown excuse.
        MissingDependency: a report needs the extra `evidence`.
        DirectoryNotWritable: the report cannot be written.
        Error: there is not enough space to unpack.
    """
    deepest = _level(level)
    asked = {
        "level": deepest,
        "sample": _sample(sample),
        "seed": secrets.randbelow(_SEEDS) if seed is None else operator.index(seed),
        "trust": sorted(trust),
        "allow": list(allow),
    }
    with_allowed((), allow)
    page = None if report is None else Path(report).absolute()
    if page is not None and not page.parent.is_dir():
        raise DirectoryNotWritable(page.parent, "no such directory")
    given = Path(path)
    if not given.exists():
        raise UnreadableArchive(given, "no such file or directory")
    with _working_folder() as folder:
        heard = _run_all(given.absolute(), folder, asked, on_progress)
        verification = Verification(
            path=given,
            level=deepest,
            findings=tuple(heard["findings"]),
            excuses=tuple(from_json(Excuse, each) for each in heard["excuses"]),
            inputs=heard["inputs"],
            facts={
                "archive": heard["facts"],
                **{key: asked[key] for key in ("sample", "seed", "trust", "allow")},
                "versions": dict(versions()),
                "machine": dict(machine_fingerprint()),
            },
        )
        if page is not None:
            write_verification_report(verification, page)
    return verification


def _run_all(
    path: Path,
    folder: Path,
    asked: Mapping[str, Any],
    on_progress: Callable[[VerificationProgress], object] | None,
) -> dict[str, Any]:
    """Run the processes that the level needs, until one fails.

    Args:
        path: the path given to `verify`.
        folder: an empty folder for the processes' files.
        asked: the level, the sample and so on.
        on_progress: called with the progress.

    Returns:
        The values that the processes sent: `findings`, `excuses`, `inputs` and `facts`.
    """
    heard: dict[str, Any] = {"findings": [], "excuses": [], "inputs": {}, "facts": {}}
    stages = {
        "open": ("reading", [path]),
        "make": ("playing", [folder / INPUTS]),
        "compare": ("comparing", [folder / GIVEN, folder / MADE]),
    }
    for stage, (phase, readable) in stages.items():
        if stage != "open" and asked["level"] is Level.FILES:
            break
        place = folder / stage
        place.mkdir()
        request = {**asked, "stage": stage, "path": str(path), "folder": str(folder)}
        failure = _run(request, readable, place, phase, heard, on_progress)
        if failure is not None:
            # The temporary folder means nothing to the reader.
            failure = failure.replace(f"{folder}{os.sep}", "")
            reason, unit = f"{phase} failed: {failure}", "verification"
            topic, outcome = Topic.FILES, Outcome.DIFFERENT
            heard["findings"].append(
                Finding(topic, "", outcome, reason, unit=unit, is_headline=True)
            )
            break
    return heard


def _run(
    request: Mapping[str, Any],
    readable: Sequence[Path],
    place: Path,
    phase: str,
    heard: dict[str, Any],
    on_progress: Callable[[VerificationProgress], object] | None,
) -> str | None:
    """Run a process and add its messages to `heard`; return the reason if it failed."""
    report = on_progress or (lambda _: None)
    began, failure = time.monotonic(), None

    def show(done: int, total: int) -> None:
        passed = time.monotonic() - began
        left = passed * (total - done) / done if done > 0 else None
        report(VerificationProgress(phase, done, total, left))

    show(0, 1)
    with Sandbox(MODULE, request, place=place, readable=readable) as sandbox:
        for said in sandbox.answers(_TIMEOUT_S):
            match said:
                case None:
                    return f"it sent nothing for {_TIMEOUT_S:g} seconds"
                case {"refused": reason}:
                    raise UnreadableArchive(Path(request["path"]), reason)
                case {"error": text}:
                    raise Error(text)
                case {"done": _}:
                    return None
                case {"failure": reason}:
                    failure = reason
                case {"finding": finding}:
                    heard["findings"].append(from_json(Finding, finding))
                case {"phase": phase}:
                    began = time.monotonic()
                    show(0, 1)
                case {"count": [int(done), int(total)]}:
                    show(done, total)
                case _:
                    heard |= said
        return failure or f"its process {sandbox.last_words()}"


def _level(level: str) -> Level:
    try:
        return Level(level)
    except ValueError as error:
        names = [known.value for known in Level]
        raise UnknownName("verification level", level, names) from error


def _sample(sample: int | None) -> int | None:
    if sample is None:
        return None
    is_bool = isinstance(sample, bool)
    if is_bool or not isinstance(sample, numbers.Integral) or sample < 1:
        raise InvalidArgument(
            "sample must be the number of frames to check in each video, 1 or more, "
            f"got {sample!r}. Omit it to check all of them."
        )
    return int(sample)


@contextlib.contextmanager
def _working_folder() -> Iterator[Path]:
    """Yield a new folder, and remove it at the end.

    First, the folders of the same user's killed verifications are removed.
    """
    parent = Path(tempfile.gettempdir())
    for folder in parent.glob(f"{_PREFIX}*"):
        # Ignore folders that disappear in the meantime or cannot be read.
        with contextlib.suppress(OSError):
            if _is_abandoned(folder):
                shutil.rmtree(folder, ignore_errors=True)
    with tempfile.TemporaryDirectory(
        prefix=_PREFIX, ignore_cleanup_errors=True
    ) as name:
        folder = Path(name)
        lock = None
        # Some file systems have no locks.
        with contextlib.suppress(OSError):
            lock = Lock(folder / _LOCK, "", mode=0o600)
        try:
            yield folder
        finally:
            if lock is not None:
                lock.release()


def _is_abandoned(folder: Path) -> bool:
    facts = folder.lstat()
    if not stat.S_ISDIR(facts.st_mode) or facts.st_uid != os.getuid():
        return False
    # Without a lock file (OSError), it is unknown whether the process has ended.
    age = time.time() - (folder / _LOCK).lstat().st_mtime
    return age > _A_MOMENT_S and not is_locked(folder / _LOCK)
