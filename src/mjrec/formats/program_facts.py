# SPDX-License-Identifier: Apache-2.0
"""What a program was found to be, remembered from process to process.

Asking ffmpeg three questions and hashing its 80 megabytes takes as long as drawing a
hundred small frames. The answers lie in `$XDG_CACHE_HOME/mjrec/programs.json`
(`~/.cache/mjrec/programs.json` by default), which can be deleted at any time. They
count only for the very file that was asked: the same path, device, inode, size and
times, of which the kernel sets the last. Where none can be kept, everything is asked
anew.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path

from ..atomic_files import write_text
from ..errors import FileNotWritten
from .regular_files import read_regular

_MOST_BYTES = 1 << 20
_MOST_PROGRAMS = 8

_found: dict[str, dict[str, str]] = {}


def remembered(program: str, question: str, answer: Callable[[], str]) -> str:
    """Return the answer to a question about a program, asking only once.

    Args:
        program: its path.
        question: what tells it from other questions.
        answer: asks the program; what it raises is not remembered.
    """
    status = Path(program).stat()
    times = (status.st_mtime_ns, status.st_ctime_ns)
    numbers = (status.st_dev, status.st_ino, status.st_size, *times)
    identity = " ".join(map(str, (*numbers, program)))
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111  `Path.home` raises for users without one
    path = Path(home, "mjrec", "programs.json")
    if identity not in _found:
        _found[identity] = _read(path).get(identity, {})
    answers = _found[identity]
    if question not in answers:
        answers[question] = answer()
        with contextlib.suppress(OSError, FileNotWritten):
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            others = {k: v for k, v in _read(path).items() if k != identity}
            newest = dict(list(others.items())[1 - _MOST_PROGRAMS :])
            write_text(path, json.dumps({**newest, identity: answers}))
    return answers[question]


def _read(path: Path) -> dict[str, dict[str, str]]:
    # Whatever stands there, it can be found out again.
    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError):
        said = json.loads(read_regular(path, limit=_MOST_BYTES))
        return {key: dict(value) for key, value in said.items()}
    return {}
