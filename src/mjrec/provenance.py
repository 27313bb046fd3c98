# SPDX-License-Identifier: Apache-2.0
"""Provenance of a recording: packages, machine, variables, command line and code.

Collecting it takes a third of a second or more, mostly in other processes. A thread
collects it once, and it is used whenever a manifest is written.

Reading the files of a hundred packages keeps Python busy for a fifth of a second. On a
thread of the simulating process, this would cost even more: whenever a step releases
the interpreter lock, the thread holds it for five milliseconds. That nearly stops the
simulation until all files are read (200 steps of HalfCheetah in a tenth of a second
instead of 1600). So a separate process, which runs this module, reads the files.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import logging
import os
import platform
import re
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from .child_python import Child
from .machine import cpu_flags, cpu_model, machine_fingerprint, usable_cpus
from .messages import Parent

logger = logging.getLogger(__name__)

# Variables that can change frames, the last bits of numbers, or the loaded libraries.
_VARIABLES = frozenset(
    {
        *("CUDA_VISIBLE_DEVICES", "DISPLAY", "GLIBC_TUNABLES", "LD_LIBRARY_PATH"),
        *("LD_PRELOAD", "PYOPENGL_PLATFORM", "PYTHONHASHSEED", "PYTHONPATH"),
    }
)
_PREFIXES = (
    *("EGL_", "GALLIUM_", "GALLIVM_", "LIBGL_", "LP_", "MESA_", "MJREC_", "MKL_"),
    *("MUJOCO_", "NVIDIA_", "OMP_", "OPENBLAS_", "__EGL_"),
)
# Files that an installer changes or adds when it installs a wheel.
_OF_INSTALLATION = ("INSTALLER", "REQUESTED", "RECORD", "direct_url.json")
_NAME_OR_VERSION = re.compile(r"^(Name|Version): *(.*?) *$", re.MULTILINE)
_SECONDS_FOR_PACKAGES = 60.0
_SECONDS_FOR_GIT = 5.0
# Short, so that programs exit quickly.
_SECONDS_AT_THE_END = 2.0

# The command line stored in recordings. A worker sets it to that of the evaluation.
command = sys.orig_argv


def is_of_drawing(variable: str) -> bool:
    """Return whether frames or the last bits of numbers may depend on a variable."""
    return variable in _VARIABLES or variable.startswith(_PREFIXES)


class Provenance:
    """The provenance of this process, collected on a separate thread.

    Args:
        root: the directory that contains the user's code.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._found: dict[str, Any] | None = None
        # These can change later, so they are read immediately.
        self._command = list(command)
        self._directory = str(Path.cwd())
        self._variables = {
            name: value
            for name, value in sorted(os.environ.items())
            if is_of_drawing(name)
        }
        self._thread = threading.Thread(
            target=self._look, name="mjrec-provenance", daemon=True
        )
        self._thread.start()

    def found(self, *, wait: bool) -> Mapping[str, Any] | None:
        """Return the provenance, or None if it has not been collected.

        Args:
            wait: whether to wait up to two seconds for it to be collected.

        Returns:
            None if it is not ready or could not be collected. Otherwise `command`,
            `working_directory`, `packages` (names to `version` and `record_sha256`,
            the SHA-256 of the wheel's own list of its files, or None), `machine` (see
            `machine_fingerprint`), `cpu` (`model`, `flags`, `usable`), `system`,
            `python`, `variables`, and `code` (`root`, `commit`, `dirty`, `remote`).
            `code` is None if the user's code is not in a git repository, or git has not
            answered yet.
        """
        if wait:
            self._thread.join(_SECONDS_AT_THE_END)
        return self._found if wait or not self._thread.is_alive() else None

    def _look(self) -> None:
        try:
            found = {
                "command": self._command,
                "working_directory": self._directory,
                "python": sys.version,
                "packages": installed_packages(),
                "machine": dict(machine_fingerprint()),
                "cpu": {
                    "model": cpu_model(),
                    "flags": list(cpu_flags()),
                    "usable": usable_cpus(),
                },
                "system": platform.platform(),
                "variables": self._variables,
            }
            # In a large repository git may answer late or never.
            self._found = {**found, "code": None}
            self._found = {**found, "code": _code(self._root)}
        except Exception:
            # This must not make a recording fail. An exiting process has ended the
            # child that lists its packages, and no longer needs the list.
            if threading.main_thread().is_alive():
                logger.warning("The provenance could not be collected.", exc_info=True)


@functools.cache
def look_around() -> Provenance:
    """Return this process's provenance; the first call starts collecting it."""
    return Provenance(_code_root())


# A child forked while the thread is running does not have that thread.
os.register_at_fork(after_in_child=look_around.cache_clear)


def _code_root() -> Path:
    """Return the directory of the user's main script, or the working directory.

    An installed program (run by name or with `-m`) does not count as the user's script.
    """
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    if file is None:
        return Path.cwd()
    directory = Path(file).absolute().parent
    is_installed = directory.is_relative_to(sys.prefix) or "site-packages" in (
        directory.parts
    )
    return Path.cwd() if is_installed else directory


def _code(root: Path) -> dict[str, Any] | None:
    commit = _git(root, "rev-parse", "HEAD")
    top = _git(root, "rev-parse", "--show-toplevel")
    if commit is None or top is None:
        return None
    changes = _git(root, "status", "--porcelain", "--untracked-files=no")
    return {
        "root": top,
        "commit": commit,
        "dirty": None if changes is None else bool(changes),
        "remote": _git(root, "config", "--get", "remote.origin.url"),
    }


def _git(root: Path, *arguments: str) -> str | None:
    """Return git's output, or None if git is missing, fails or takes too long."""
    try:
        done = subprocess.run(
            # A repository's own configuration could make git run a program.
            ["git", "-c", "core.fsmonitor=false", *arguments],
            cwd=root,
            env={**os.environ, "GIT_OPTIONAL_LOCKS": "0", "LC_ALL": "C"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_SECONDS_FOR_GIT,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.decode(errors="replace").strip()


def installed_packages() -> dict[str, Any]:
    """Return the packages installed on this process's module search path.

    Waits for a process that collects them, without blocking other threads.

    Returns:
        `version` and `record_sha256` by package name, sorted by name. `record_sha256`
        is the SHA-256 of the wheel's own list of its files, or None if it has no list.
    """
    places = [entry for entry in sys.path if isinstance(entry, str)]
    # A Python embedded in another program has no executable to start.
    if sys.executable and not getattr(sys, "frozen", False):
        with (
            contextlib.suppress(OSError),
            Child(__name__, environ=os.environ) as child,
        ):
            child.send(places=places)
            for answer in child.messages(_SECONDS_FOR_PACKAGES):
                if answer is not None:
                    return answer
            logger.debug(
                "Reading packages in this process: the child %s", child.last_words()
            )
    return _packages_in(places)


def _packages_in(places: Sequence[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for distribution in importlib.metadata.distributions(path=list(places)):
        name, version = _name_and_version(distribution)
        # Python imports the first installation on the path.
        if name and name not in found:
            found[name] = {
                "version": version,
                "record_sha256": _record_sha256(distribution),
            }
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))


def _name_and_version(
    distribution: importlib.metadata.Distribution,
) -> tuple[str | None, str | None]:
    """Return a package's name and version quickly, without parsing all metadata."""
    text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO")
    answer = dict(_NAME_OR_VERSION.findall((text or "").partition("\n\n")[0]))
    return answer.get("Name"), answer.get("Version")


def _record_sha256(distribution: importlib.metadata.Distribution) -> str | None:
    """Return the SHA-256 of the sorted lines of a wheel's file list, or None if empty.

    Files that an installer adds, such as compiled Python, are left out, so that two
    installations of the same wheel have the same digest.
    """
    text = distribution.read_text("RECORD")
    if not text:
        return None
    lines = (line.strip() for line in text.splitlines())
    own = sorted(line for line in lines if line and not _is_of_installation(line))
    return hashlib.sha256("\n".join(own).encode()).hexdigest()


def _is_of_installation(line: str) -> bool:
    path = line.rsplit(",", 2)[0].strip('"')
    return (
        path.startswith(("..", "/"))
        or path.endswith(".pyc")
        or path.rpartition("/")[2] in _OF_INSTALLATION
    )


def _main() -> None:
    parent = Parent()
    parent.send(**_packages_in(parent.receive()["places"]))


if __name__ == "__main__":
    _main()


PACKAGES = (
    *("mjrec", "mujoco", "gymnasium", "gymnasium-robotics", "dm-control", "numpy"),
    *("h5py", "imageio-ffmpeg"),
)


@functools.cache
def versions(*more: str) -> Mapping[str, str]:
    """Return the versions of Python and of mjrec's main packages, if installed.

    Args:
        *more: names of additional packages.
    """
    found = {"python": platform.python_version()}
    for package in (*PACKAGES, *more):
        try:
            distribution = importlib.metadata.distribution(package)
            found[package] = str(_name_and_version(distribution)[1])
        except importlib.metadata.PackageNotFoundError:
            continue
    return MappingProxyType(found)
