# SPDX-License-Identifier: Apache-2.0
"""A process with limits, in which a module of ours reads what strangers have written.

Whatever a hostile file does to HDF5's, MuJoCo's, OpenGL's or ffmpeg's code, it does it
there. The parent sends one request; the child starts by calling `enter`, and says what
it finds.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from . import json_text
from .child_python import Child, places_of_main
from .confined import VARIABLE
from .errors import Error
from .parent import Parent
from .provenance import is_of_drawing

logger = logging.getLogger(__name__)

_GIB = 1 << 30
# Of each process that takes part. What is mapped and never touched counts for the
# address space only, and OpenGL's drivers map a lot. Drawing 1280x720 frames with
# llvmpipe takes 0.35 GiB of the one and 0.9 GiB of the other (measured).
LIMITS: Final[Mapping[str, int]] = {
    "RLIMIT_DATA": 8 * _GIB,
    "RLIMIT_AS": 128 * _GIB,
    "RLIMIT_FSIZE": 8 * _GIB,
    "RLIMIT_NOFILE": 1024,
    "RLIMIT_CORE": 0,
    # Seconds: a day.
    "RLIMIT_CPU": 86_400,
}

# Says that a stranger's compiled models may be loaded.
_TRUST_VARIABLE = "MJREC_TRUST_MODELS"
# Says to what runs in a sandbox, and to what that starts, that it does.
_INSIDE_VARIABLE = "MJREC_SANDBOX"

_CONFINED = "mjrec.confined"
# Of the variables, what Python, OpenGL and ffmpeg need to be found: a token is none.
_KEPT = frozenset({"PATH", "LANG", "LD_LIBRARY_PATH", "TZ", "IMAGEIO_FFMPEG_EXE"})

_NOTHING: Mapping[str, str] = {}


class Sandbox(Child):
    """The process, seen from its parent. Leaving `with` ends it and its group.

    Args:
        module: what runs in it; it calls `enter`.
        request: what it is asked for, JSON.
        place: an empty folder for what it leaves behind: its working directory, and
            where its temporary files are.
        limits: by their names in `resource`.
        more_environ: environment variables besides this process's.
        readable: where given, it can read nothing but Python, the system and these,
            write nothing but `place` and `writable`, and has no network and no home,
            as far as `confined` can have it here.
        writable: folders besides `place`.

    Raises:
        Error: it cannot be started.
    """

    most_bytes = 1 << 24

    def __init__(
        self,
        module: str,
        request: Mapping[str, Any],
        *,
        place: Path,
        limits: Mapping[str, int] = LIMITS,
        more_environ: Mapping[str, str] = _NOTHING,
        readable: Sequence[Path] | None = None,
        writable: Sequence[Path] = (),
    ) -> None:
        environ = {k: v for k, v in os.environ.items() if k != _TRUST_VARIABLE}
        command = [module]
        if readable is not None:
            environ = {k: v for k, v in environ.items() if k in _KEPT or _is_kept(k)}
            paths = {
                "readable": [str(path) for path in readable],
                "writable": [str(path) for path in (place, *writable)],
                "hidden": places_of_main(),
            }
            environ |= {"HOME": str(place), VARIABLE: json.dumps(paths)}
            command = [_CONFINED, module]
        environ |= {**more_environ, "TMPDIR": str(place), _INSIDE_VARIABLE: "1"}
        try:
            # MuJoCo's own log appears where it runs.
            super().__init__(*command, environ=environ, cwd=str(place))
        except OSError as error:
            raise Error(
                f"No process with limits could be started: {sys.executable!r}: {error}."
            ) from error
        self.send(request=_plain(request), limits=dict(limits))

    def answers(self, timeout_s: float) -> Iterator[Mapping[str, Any] | None]:
        """Yield what it says until it ends; None once it was silent for so long."""
        for message in self.messages(timeout_s):
            if message is None:
                logger.warning("A process with limits hangs: %s", self.stacks())
            yield message

    def __exit__(self, *error: object) -> None:
        # Those with a session of their own (who draw, ffmpeg) end with the pipes to it.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        self.end()


def is_inside() -> bool:
    """Return whether this process runs in a sandbox already."""
    return _INSIDE_VARIABLE in os.environ


def enter() -> tuple[Any, Callable[..., None]]:
    """Keep this process to its limits, and let it end with its parent.

    Returns:
        The request; and what says its keyword arguments to the parent.
    """
    parent = Parent()
    told = parent.receive()
    for name, wanted in told["limits"].items():
        kind = getattr(resource, name)
        _, most = resource.getrlimit(kind)
        allowed = wanted if most == resource.RLIM_INFINITY else min(wanted, most)
        resource.setrlimit(kind, (allowed, allowed))
    # With those of its group.
    parent.listen(lambda: os.killpg(0, signal.SIGKILL))
    return told["request"], lambda **answers: parent.send(**_plain(answers))


def _is_kept(name: str) -> bool:
    return is_of_drawing(name) or name.startswith(("LC_", "PYTHON", "__GLX_", "VK_"))


def _plain(answers: Mapping[str, Any]) -> Any:
    return json.loads(json_text.dumps(answers))
