# SPDX-License-Identifier: Apache-2.0
"""What a program was found to be, remembered from process to process.

Asking ffmpeg three questions and hashing its 80 megabytes takes as long as drawing a
hundred small frames. The answers lie in `$XDG_CACHE_HOME/mjrec/programs.json`
(`~/.cache/mjrec/programs.json` by default), which anybody may delete. They count only
for the very file that was asked: the same path, device, inode, size and times, of which
the kernel sets the last. A file that others can write is neither read nor replaced, and
where none can be kept, everything is asked anew.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path

from ..atomic_files import write_text
from ..errors import FileNotWritten
from .regular_files import open_regular

_MOST_BYTES = 1 << 20
_MOST_PROGRAMS = 8
_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH

_found: dict[str, dict[str, str]] = {}


def remembered(program: str, question: str, answer: Callable[[], str]) -> str:
    """Return the answer to a question about a program, asking only once.

    Args:
        program: its path.
        question: what tells it from other questions.
        answer: asks the program; what it raises is not remembered.
    """
    found = os.stat(program)  # noqa: PTH116  a name is enough
    identity = " ".join(
        map(
            str,
            (
                *(found.st_dev, found.st_ino, found.st_size),
                *(found.st_mtime_ns, found.st_ctime_ns, program),
            ),
        )
    )
    path = _path()
    if identity not in _found:
        _found[identity] = _read(path).get(identity, {})
    answers = _found[identity]
    if question not in answers:
        answers[question] = answer()
        _write(path, identity, answers)
    return answers[question]


def _path() -> Path | None:
    cache = os.environ.get("XDG_CACHE_HOME", "")
    # Relative ones are to be ignored, says its specification.
    if cache.startswith("/"):
        return Path(cache, "mjrec", "programs.json")
    home = os.path.expanduser("~")  # noqa: PTH111  `Path.home` raises for users without one
    if home.startswith("/") and os.access(home, os.F_OK):
        return Path(home, ".cache", "mjrec", "programs.json")
    return None


def _read(path: Path | None) -> dict[str, dict[str, str]]:
    try:
        if path is None or not _is_own(path.parent):
            return {}
        with open_regular(path) as file:
            if not _is_own(path):
                return {}
            said = json.loads(file.read(_MOST_BYTES))
            return {key: dict(value) for key, value in said.items()}
    # Whatever stands there, it can be found out again.
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}


def _write(path: Path | None, identity: str, answers: dict[str, str]) -> None:
    if path is None:
        return
    with contextlib.suppress(OSError, FileNotWritten):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if _is_own(path.parent) and (not path.exists() or _is_own(path)):
            others = {k: v for k, v in _read(path).items() if k != identity}
            kept = dict(list(others.items())[1 - _MOST_PROGRAMS :])
            write_text(path, json.dumps({**kept, identity: answers}))


def _is_own(path: Path) -> bool:
    found = path.lstat()
    is_own = found.st_uid == os.geteuid() and not found.st_mode & _OTHERS_MAY_WRITE
    return is_own and not stat.S_ISLNK(found.st_mode)
