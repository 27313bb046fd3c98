# SPDX-License-Identifier: Apache-2.0
"""A process with resource limits, in which an mjrec module reads untrusted files.

If a hostile file attacks HDF5, MuJoCo, OpenGL or ffmpeg, only that process is affected.
The parent sends one request. The child first calls `enter` and then sends its answers.
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
from .messages import Parent
from .provenance import is_of_drawing

logger = logging.getLogger(__name__)

_GIB = 1 << 30
# The limits of each process. Memory that is mapped but never touched counts only as
# address space (AS), and OpenGL drivers map a lot. Rendering 1280x720 frames with
# llvmpipe takes 0.35 GiB of DATA and 0.9 GiB of AS (measured).
LIMITS: Final[Mapping[str, int]] = {
    "RLIMIT_DATA": 8 * _GIB,
    "RLIMIT_AS": 128 * _GIB,
    "RLIMIT_FSIZE": 8 * _GIB,
    "RLIMIT_NOFILE": 1024,
    "RLIMIT_CORE": 0,
    # One day, in seconds.
    "RLIMIT_CPU": 86_400,
}

# If set, compiled models from untrusted sources may be loaded.
_TRUST_VARIABLE = "MJREC_TRUST_MODELS"
# Set in a sandboxed process and in the processes that it starts.
_INSIDE_VARIABLE = "MJREC_SANDBOX"

_CONFINED = "mjrec.confined"
# The variables that Python, OpenGL and ffmpeg need. All others, such as access tokens,
# are removed.
_KEPT = frozenset({"PATH", "LANG", "LD_LIBRARY_PATH", "TZ", "IMAGEIO_FFMPEG_EXE"})

_NOTHING: Mapping[str, str] = {}


class Sandbox(Child):
    """A sandboxed process, as seen from its parent.

    Leaving the `with` block ends the process and its process group.

    Args:
        module: the module to run, which must call `enter`.
        request: the JSON request for the module.
        place: an empty folder, which is the process's working directory and holds its
            temporary files.
        limits: resource limits, keyed by their names in `resource`.
        more_environ: environment variables in addition to this process's.
        readable: if given, the process can read only Python, the system and these
            paths, can write only to `place`, and has no network or home folder, as far
            as `confined` can enforce this here.

    Raises:
        Error: the process cannot be started.
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
    ) -> None:
        environ = {k: v for k, v in os.environ.items() if k != _TRUST_VARIABLE}
        command = [module]
        if readable is not None:
            environ = {k: v for k, v in environ.items() if k in _KEPT or _is_kept(k)}
            paths = {
                "readable": [str(path) for path in readable],
                "writable": [str(place)],
                "hidden": places_of_main(),
            }
            environ |= {"HOME": str(place), VARIABLE: json.dumps(paths)}
            command = [_CONFINED, module]
        environ |= {**more_environ, "TMPDIR": str(place), _INSIDE_VARIABLE: "1"}
        try:
            # MuJoCo writes its log file to the working directory.
            super().__init__(*command, environ=environ, cwd=str(place))
        except OSError as error:
            raise Error(
                f"Could not start a sandboxed process: {sys.executable!r}: {error}."
            ) from error
        self.send(request=_plain(request), limits=dict(limits))

    def answers(self, timeout_s: float) -> Iterator[Mapping[str, Any] | None]:
        """Yield the process's answers until it ends.

        Args:
            timeout_s: maximum time in seconds without an answer. After that, None is
                yielded and the iterator ends.
        """
        for message in self.messages(timeout_s):
            if message is None:
                logger.warning("A sandboxed process is hanging: %s", self.stacks())
            yield message

    def __exit__(self, *error: object) -> None:
        # Children with their own session (render workers, ffmpeg) end when their pipes
        # close.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        self.end()


def is_inside() -> bool:
    """Return whether this process already runs in a sandbox."""
    return _INSIDE_VARIABLE in os.environ


def enter() -> tuple[Any, Callable[..., None]]:
    """Apply the limits to this process, and make it end when its parent ends.

    Returns:
        The request, and a function that sends its keyword arguments to the parent.
    """
    parent = Parent()
    received = parent.receive()
    for name, wanted in received["limits"].items():
        kind = getattr(resource, name)
        _, most = resource.getrlimit(kind)
        allowed = wanted if most == resource.RLIM_INFINITY else min(wanted, most)
        resource.setrlimit(kind, (allowed, allowed))
    # When the parent ends, kill the whole process group.
    parent.listen(lambda: os.killpg(0, signal.SIGKILL))
    return received["request"], lambda **answers: parent.send(**_plain(answers))


def _is_kept(name: str) -> bool:
    return is_of_drawing(name) or name.startswith(("LC_", "PYTHON", "__GLX_", "VK_"))


def _plain(answers: Mapping[str, Any]) -> Any:
    return json.loads(json_text.dumps(answers))
