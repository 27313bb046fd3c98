# SPDX-License-Identifier: Apache-2.0
"""Programs in another Python process."""

import os
import subprocess
import sys

_CHOOSE_GL = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID")
_CHOOSE_SCREEN = ("DISPLAY", "WAYLAND_DISPLAY", "XDG_SESSION_TYPE")


def without_gl(**variables):
    """Return this process's environment, in which only `variables` choose OpenGL."""
    chosen = _CHOOSE_GL + _CHOOSE_SCREEN
    return {k: v for k, v in os.environ.items() if k not in chosen} | variables


def run_python(code, *arguments, status=0, under=(), **options):
    """Run `python -c code`, and check its exit status.

    Args:
        code: the program.
        *arguments: its `sys.argv[1:]`.
        status: the expected status, negative for a signal, or None for any.
        under: a command that runs Python.
        **options: of `subprocess.run`.
    """
    done = subprocess.run(
        [*under, sys.executable, "-P", "-c", code, *map(str, arguments)],
        **{"capture_output": True, "text": True, "timeout": 240, **options},
    )
    assert status is None or done.returncode == status, done.stderr
    return done
