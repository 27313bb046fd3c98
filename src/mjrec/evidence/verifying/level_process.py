# SPDX-License-Identifier: Apache-2.0
"""The process that does the checks, seen from its parent."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import Any

from ...sandbox import LIMITS, Sandbox
from ..verification import Check, Level, Verdict
from .carried_checks import check_from_json, task_to_json
from .task import Task

_MODULE = "mjrec.evidence.verifying.child"

# Compiling a model may take 300 of them.
_PATIENCE_S = 900.0

# How it may be told of progress: the level, how much is done, and of how much.
Told = Callable[[Level, int, int], object]


def checks_of(
    task: Task,
    *,
    bag: Path | None,
    place: Path,
    told: Told,
    limits: Mapping[str, int] = LIMITS,
    patience_s: float = _PATIENCE_S,
) -> Generator[Check, None, None]:
    """Yield the checks of a task, done in a process of their own.

    Where that process dies, hangs or is at the end of its means, one failed check says
    so, and those levels that it had not come to are not checkable.

    Args:
        task: what is asked for.
        bag: the folder that is a bag; None where nothing was packed.
        place: an empty folder for what it leaves behind.
        told: called with its progress.
        limits: by their names in `resource`.
        patience_s: seconds that it may say nothing.

    Raises:
        Error: it cannot be started.
    """
    request = {
        "task": task_to_json(task),
        "bag": None if bag is None else str(bag),
    }
    with Sandbox(_MODULE, request, place=place, limits=limits) as sandbox:
        yield from _Conversation(sandbox, task.level, told).checks(patience_s)


class _Conversation:
    """What is said by the process.

    Args:
        sandbox: which it runs in.
        level: the deepest that was asked for.
        told: called with its progress.
    """

    def __init__(self, sandbox: Sandbox, level: Level, told: Told) -> None:
        self._sandbox = sandbox
        self._levels = level.included
        self._told = told
        self._at: Level = Level.FILES
        self._last = ""
        self._failure: str | None = None
        self._has_ended = False

    def checks(self, patience_s: float) -> Iterator[Check]:
        """Yield what it finds, and at the end what became of it."""
        for said in self._sandbox.said(patience_s):
            if said is None:
                self._failure = f"nothing was heard of it for {patience_s:g} seconds"
            else:
                yield from self._understood(said)
        if not self._has_ended:
            yield from self._broken_off()

    def _understood(self, said: Mapping[str, Any]) -> Iterator[Check]:
        if "check" in said:
            check = check_from_json(said["check"])
            self._last = check.subject
            yield check
        elif "level" in said:
            self._at, self._last = Level(said["level"]), ""
        elif "count" in said:
            self._told(self._at, *said["count"])
        elif "failure" in said:
            self._failure = str(said["failure"])
        self._has_ended = self._has_ended or "end" in said

    def _broken_off(self) -> Iterator[Check]:
        after = f" after {self._last}" if self._last else ""
        why = self._failure or f"their process {self._sandbox.last_words()}"
        yield Check(
            level=self._at,
            claim="the checks of this level come to an end",
            subject="",
            verdict=Verdict.FAIL,
            reason=f"they ended{after}: {why}",
        )
        for level in self._levels[self._levels.index(self._at) + 1 :]:
            yield Check(
                level=level,
                claim="the checks of this level come to an end",
                subject="",
                verdict=Verdict.NOT_CHECKABLE,
                reason=f"the level {self._at.value}, before it, ended with a failure",
            )
