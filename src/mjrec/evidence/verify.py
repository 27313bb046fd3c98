# SPDX-License-Identifier: Apache-2.0
"""Verifying a packed run: recreated from its inputs, and compared."""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import operator
import os
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping
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
from ..formats.dataclass_json import from_json
from ..formats.locks import Lock, is_locked
from ..machine import machine_fingerprint
from ..sandbox import Sandbox
from .excuses import with_allowed
from .findings import Excuse, Finding, Level, Outcome, Topic, Verification
from .stages import MODULE

_PACKAGES = ("mjrec", "mujoco", "numpy", "gymnasium", "dm-control", "imageio-ffmpeg")
# Compiling a model may take 300 of them.
_TIMEOUT_S = 900.0
_SEEDS = 2**32
_PREFIX = "mjrec-verify-"
# Held by the process whose folder it is in.
_LOCK = "lock"
# A lock is a file for a moment before it is held.
_A_MOMENT_S = 60.0


@dataclass(frozen=True, kw_only=True)
class VerificationProgress:
    """How far a verification is.

    Attributes:
        phase: "reading", "playing", "drawing" or "comparing".
        done: how much of it.
        total: of how much; a new phase begins from 0.
        seconds_left: of this phase, as far as can be told; None else.
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
    """Run a packed run again, and compare the result with the archive.

    The archive may come from a stranger. Three processes read it, run it and compare,
    each with limits on memory and time, without network or home directory, and each
    sees only what it needs: the second gets the inputs only (environment, seeds,
    actions, options). No code that the archive names is run, except environments in
    `trust`.

    Args:
        path: an archive of `mjrec pack`, an unpacked one, or a monitor directory
            or a folder of several (for which missing files cannot be found).
        level: where to stop: `"files"` (the bag holds what it lists), `"stats"`
            (rewards, ends, statistics and selection of episodes), `"physics"` (also all
            states) or `"pixels"` (also all frames and files).
        sample: how many frames of each video to check. None is all.
        seed: for the choice of these frames. None is random.
        trust: ids of environments that may be made although they are in no trusted
            registry. This runs code that you have installed.
        allow: excuses to accept, by name and value: `"gl=NVIDIA H100"`.
        report: path of an HTML page to write.
        on_progress: called with the progress.

    Returns:
        The verdict, PASS, PARTLY or FAIL, with all findings. A difference does not
            raise.

    Raises:
        UnreadableArchive: the file is missing, damaged or hostile.
        InvalidArgument: `level` is unknown, `sample` is below 1, or `allow` names no
            excuse.
        MissingDependency: a report needs the extra `evidence`.
        DirectoryNotWritable: the report cannot be written.
        Error: there is not enough room to unpack.
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
    write_report = None if page is None else _report_writer(page)
    given = Path(path)
    if not given.exists():
        raise UnreadableArchive(given, "there is no such file or directory")
    with _working_folder() as folder:
        verifying = _Verifying(given.absolute(), folder, asked, on_progress)
        verifying.run(deepest)
        verification = Verification(
            path=given,
            level=deepest,
            findings=tuple(verifying.findings),
            excuses=tuple(verifying.excuses),
            inputs=verifying.inputs,
            facts={
                "archive": verifying.facts,
                **{key: asked[key] for key in ("sample", "seed", "trust", "allow")},
                "versions": dict(_versions()),
                "machine": dict(machine_fingerprint()),
            },
        )
        if write_report is not None:
            write_report(verification, page)
    return verification


class _Verifying:
    """The three processes, one after the other, and what they say.

    Args:
        path: what was given.
        folder: an empty one, for all that they leave.
        asked: the level, the sample and so on.
        on_progress: told how far they are.
    """

    def __init__(
        self,
        path: Path,
        folder: Path,
        asked: Mapping[str, Any],
        on_progress: Callable[[VerificationProgress], object] | None,
    ) -> None:
        self.findings: list[Finding] = []
        self.excuses: list[Excuse] = []
        self.inputs: Mapping[str, Any] = {}
        self.facts: Mapping[str, Any] = {}
        self._path = path
        self._folder = folder
        # Each where the process that makes it may write.
        self._given = folder / "open" / "given"
        self._inputs = folder / "open" / "inputs"
        self._made = folder / "make" / "made"
        self._asked = asked
        self._progress = _Progress(on_progress)

    def run(self, level: Level) -> None:
        """Run as many of them as the level takes, until one fails."""
        given, inputs, made = self._given, self._inputs, self._made
        if not self._stage("open", "reading", [self._path]) or level is Level.FILES:
            return
        if self._stage("make", "playing", [inputs]):
            self._stage("compare", "comparing", [given, made])

    def _stage(self, stage: str, phase: str, readable: list[Path]) -> bool:
        """Run one, which can read no more than that; return whether it ended well."""
        place = self._folder / stage
        place.mkdir()
        request = {
            **self._asked,
            "stage": stage,
            "path": str(self._path),
            "place": str(place),
            "given": str(self._given),
            "inputs": str(self._inputs),
            "made": str(self._made),
        }
        self._progress.begin(phase)
        failure = None
        with Sandbox(MODULE, request, place=place, readable=readable) as sandbox:
            for said in sandbox.answers(_TIMEOUT_S):
                if said is None:
                    failure = f"nothing was heard of it for {_TIMEOUT_S:g} seconds"
                    break
                self._take(said)
                if "done" in said:
                    return True
                failure = said.get("failure", failure)
            failure = failure or f"its process {sandbox.last_words()}"
        # The reader knows nothing of the folder that they worked in.
        failure = failure.replace(f"{self._folder}{os.sep}", "")
        self.findings.append(
            Finding(
                topic=Topic.FILES,
                item="",
                outcome=Outcome.DIFFERENT,
                reason=f"{phase} ended with a failure: {failure}",
                unit="verification",
                is_headline=True,
            )
        )
        return False

    def _take(self, said: Mapping[str, Any]) -> None:
        """Take in what a process says."""
        match said:
            case {"refused": reason}:
                raise UnreadableArchive(self._path, reason)
            case {"error": text}:
                raise Error(text)
            case {"finding": finding}:
                self.findings.append(from_json(Finding, finding))
            case {"excuses": excuses}:
                self.excuses = [from_json(Excuse, each) for each in excuses]
            case {"inputs": inputs}:
                self.inputs = inputs
            case {"facts": facts}:
                self.facts = facts
            case {"phase": phase}:
                self._progress.begin(phase)
            case {"count": [int(done), int(total)]}:
                self._progress.count(done, total)


class _Progress:
    """Tells of progress, with the time left.

    Args:
        told: called with each.
    """

    def __init__(self, told: Callable[[VerificationProgress], object] | None) -> None:
        self._told = told or (lambda _: None)
        self._phase = ""
        self._began = 0.0

    def begin(self, phase: str) -> None:
        """Begin a phase."""
        self._phase, self._began = phase, time.monotonic()
        self._told(VerificationProgress(phase=phase, done=0, total=1))

    def count(self, done: int, total: int) -> None:
        """Say how much of it is done."""
        passed = time.monotonic() - self._began
        left = passed * (total - done) / done if done > 0 else None
        self._told(
            VerificationProgress(
                phase=self._phase, done=done, total=total, seconds_left=left
            )
        )


def _level(level: str) -> Level:
    try:
        return Level(level)
    except ValueError as error:
        names = [known.value for known in Level]
        raise UnknownName("level of verification", level, names) from error


def _sample(sample: int | None) -> int | None:
    if sample is None:
        return None
    if isinstance(sample, bool) or operator.index(sample) < 1:
        raise InvalidArgument(
            f"sample is how many frames of each video are drawn, 1 or more, got "
            f"{sample!r}. Leave it out to draw all of them."
        )
    return operator.index(sample)


def _report_writer(page: Path) -> Callable[..., object]:
    if not page.parent.is_dir():
        raise DirectoryNotWritable(page.parent, "there is no such directory")
    # Only here: the report's templates are an extra.
    module = importlib.import_module(".verification_report", __package__)
    writer: Callable[..., object] = module.write_verification_report
    return writer


def _versions() -> Iterator[tuple[str, str]]:
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            yield package, importlib.metadata.version(package)


@contextlib.contextmanager
def _working_folder() -> Iterator[Path]:
    """Yield a new folder, and remove it at the end.

    What verifications of the same user have left that were killed is removed first.
    """
    parent = Path(tempfile.gettempdir())
    for folder in parent.glob(f"{_PREFIX}*"):
        # One that goes away meanwhile, or that cannot be looked at, is no reason to
        # stop.
        with contextlib.suppress(OSError):
            if _is_abandoned(folder):
                shutil.rmtree(folder, ignore_errors=True)
    with tempfile.TemporaryDirectory(
        prefix=_PREFIX, ignore_cleanup_errors=True
    ) as name:
        folder = Path(name)
        lock = None
        # There are file systems without locks.
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
    # Where there is none, nothing says that its process has ended.
    age = time.time() - (folder / _LOCK).lstat().st_mtime
    return age > _A_MOMENT_S and not is_locked(folder / _LOCK)
