# SPDX-License-Identifier: Apache-2.0
"""What a recording was made with: packages, machine, variables, command line, code.

Looking takes a third of a second and more (a hundred packages, calls of git), nearly
all of it in other processes. It is done once, on a thread, and asked for when a
manifest is written.
"""

from __future__ import annotations

import functools
import logging
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .installed_packages import installed_packages
from .machine import cpu_flags, cpu_model, machine_fingerprint, usable_cpus

logger = logging.getLogger(__name__)

# What changes pictures, the last bits of numbers, or which library is loaded.
_VARIABLES = (
    "CUDA_VISIBLE_DEVICES",
    "DISPLAY",
    "EGL_",
    "GALLIUM_",
    "GALLIVM_",
    "GLIBC_TUNABLES",
    "LD_LIBRARY_PATH",
    "LD_PRELOAD",
    "LIBGL_",
    "LP_",
    "MESA_",
    "MJREC_",
    "MKL_",
    "MUJOCO_",
    "NVIDIA_",
    "OMP_",
    "OPENBLAS_",
    "PYOPENGL_PLATFORM",
    "PYTHONHASHSEED",
    "PYTHONPATH",
    "__EGL_",
)
_SECONDS_FOR_GIT = 5.0
# Leaving is quick.
_PATIENCE = 2.0


class Surroundings:
    """What is around a process, found on a thread of its own.

    Args:
        root: the directory of the user's code.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._found: dict[str, Any] | None = None
        # What can be overwritten later is taken at once.
        self._command = list(sys.orig_argv)
        self._directory = str(Path.cwd())
        self._variables = _variables(os.environ)
        self._thread = threading.Thread(
            target=self._look, name="mjrec-surroundings", daemon=True
        )
        self._thread.start()

    def found(self, *, wait: bool) -> Mapping[str, Any] | None:
        """Return what was found.

        Args:
            wait: whether to wait for it, two seconds at most.

        Returns:
            None if it is not there yet, or could not be found. Else `command`,
            `working_directory`, `packages` (names to `version` and `record_sha256`,
            the sha256 of what the wheel's own list of its files says, or None),
            `machine` (see `machine_fingerprint`), `cpu` (`model`, `flags`, `usable`),
            `system`, `python`, `variables`, and `code` (`root`, `commit`, `dirty`,
            `remote`) or None where the user's code is in no git repository, or git
            has not answered yet.
        """
        if wait:
            self._thread.join(_PATIENCE)
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
            # Of a large repository git says it late, or never.
            self._found = {**found, "code": None}
            self._found = {**found, "code": _code(self._root)}
        except Exception:
            # No recording is to fail of it.
            logger.warning("What surrounds this recording is not known.", exc_info=True)


@functools.cache
def look_around() -> Surroundings:
    """Return the surroundings of this process, which are looked for from now on."""
    return Surroundings(_code_root())


# A child that is forked while the thread looks has no such thread.
os.register_at_fork(after_in_child=look_around.cache_clear)


def _variables(environ: Mapping[str, str]) -> dict[str, str]:
    return {
        name: environ[name]
        for name in sorted(environ)
        if any(
            name == v or (v.endswith("_") and name.startswith(v)) for v in _VARIABLES
        )
    }


def _code_root() -> Path:
    """Return where the user's program is: its script's directory, or the working one.

    What is run by its name, or with `-m`, from among what is installed, is not it.
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
    """Return what git says; None where there is none, no repository, or no answer."""
    try:
        done = subprocess.run(
            # A repository's own configuration could name a program to run.
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
