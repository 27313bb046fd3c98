# SPDX-License-Identifier: Apache-2.0
"""Verifying from beginning to end: opening, the levels in turn, the report."""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import operator
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import (
    DirectoryNotWritable,
    InvalidArgument,
    UnknownName,
    UnreadableArchive,
)
from ...formats.json_fields import read_object
from ...machine import machine_fingerprint
from ..layout import ENVIRONMENT
from ..verification import Level, Verification
from .archive import Archive, open_archive
from .level_process import checks_of
from .task import Task
from .working_folder import working_folder

_PACKAGES = ("mjrec", "mujoco", "numpy", "gymnasium", "dm-control", "imageio-ffmpeg")


@dataclass(frozen=True, kw_only=True)
class VerificationProgress:
    """How far a verification is.

    Attributes:
        level: that is being checked.
        done: how much of it.
        total: of how much; a new level begins from 0.
    """

    level: Level
    done: int
    total: int


def verify(
    path: str | os.PathLike[str],
    *,
    level: str = "pixels",
    sample: int | None = None,
    seed: int = 0,
    trust: Collection[str] = (),
    report: str | os.PathLike[str] | None = None,
    on_progress: Callable[[VerificationProgress], object] | None = None,
) -> Verification:
    """Check a packed run, item by item: passed, failed or not checkable, and why.

    What is checked may be anybody's. It is unpacked into a temporary folder, which is
    removed again, and read in a process of its own with limits of memory, of time and
    of the sizes of files. No code that it names is run, but for the environments whose
    ids are in `trust`.

    Args:
        path: what `mjrec pack` has made; or that, unpacked; or a monitor directory, of
            which nothing can say whether files are missing.
        level: how deep: `"files"` (they are all there, unchanged), `"stats"` (and the
            statistics follow from the rewards, the videos from the schedule),
            `"physics"` (and the states from the actions) or `"pixels"` (and the
            pictures from the states).
        sample: how many frames of each video are drawn; None is all of them.
        seed: of the random choice of these.
        trust: ids of environments that may be made though they are in nobody's
            registry: this runs code that you have installed, and nobody has looked at.
        report: where to write a page about it, HTML in one file.
        on_progress: told how far it is.

    Returns:
        All that was found. Nothing that fails raises.

    Raises:
        UnreadableArchive: there is no such file, or it is damaged, or made to do harm.
        InvalidArgument: there is no such level, or `sample` is not 1 or more.
        MissingDependency: a report needs the extra `evidence`.
        DirectoryNotWritable: the report cannot be written there.
        Error: there is too little room for what is packed.
    """
    deepest = _level(level)
    drawn = _sample(sample)
    page = None if report is None else Path(report).absolute()
    write_report = None if page is None else _report_writer(page)
    told = on_progress or (lambda _: None)
    given = Path(path)
    if not given.exists():
        raise UnreadableArchive(given, "there is no such file or directory")
    with working_folder() as folder:
        unpacked, place = folder / "unpacked", folder / "child"
        pictures = folder / "pictures"
        for made in (unpacked, place, pictures):
            made.mkdir()
        archive = open_archive(given.absolute(), unpacked)
        task = Task(
            recordings=archive.recordings,
            level=deepest,
            sample=drawn,
            seed=operator.index(seed),
            trust=frozenset(trust),
            environment=_environment(archive),
            pictures=None if page is None else pictures,
        )
        checks = checks_of(
            task,
            bag=archive.bag,
            place=place,
            told=lambda at, done, total: told(
                VerificationProgress(level=at, done=done, total=total)
            ),
        )
        with contextlib.closing(checks):
            verification = Verification(
                path=given,
                level=deepest,
                checks=tuple(checks),
                facts=_facts(archive, task),
            )
        if write_report is not None:
            write_report(verification, page, pictures=pictures)
    return verification


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


def _environment(archive: Archive) -> Mapping[str, Any]:
    """Return what the packed run says it was made with; nothing if that is damaged."""
    if archive.bag is None:
        return {}
    with contextlib.suppress(OSError, ValueError):
        return read_object(archive.recordings.parent / ENVIRONMENT)
    return {}


def _facts(archive: Archive, task: Task) -> dict[str, Any]:
    return {
        "archive": {"kind": archive.kind.value, **archive.facts},
        "sample": task.sample,
        "seed": task.seed,
        "trust": sorted(task.trust),
        "versions": dict(_versions()),
        "machine": dict(machine_fingerprint()),
    }


def _versions() -> Iterator[tuple[str, str]]:
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            yield package, importlib.metadata.version(package)
