# SPDX-License-Identifier: Apache-2.0
"""`use_gl`, in processes of their own: it is about what a process has done so far."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from parts import parametrize

from mjrec.gl import probe

_CHOOSING = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID")
_SCREEN = ("DISPLAY", "WAYLAND_DISPLAY", "XDG_SESSION_TYPE")
_SHOW = (
    "\nprint(answer, os.environ.get('MUJOCO_GL'), os.environ.get('PYOPENGL_PLATFORM'))"
)
_HEAD = "import logging, os, sys; import mjrec; logging.basicConfig(level='INFO')\n"


def run(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a Python whose environment chooses no OpenGL but these."""
    environ = {k: v for k, v in os.environ.items() if k not in _CHOOSING + _SCREEN}
    return subprocess.run(
        [sys.executable, "-P", "-c", _HEAD + code],
        env={**environ, **variables},
        capture_output=True,
        check=False,
        text=True,
    )


def answer_of(code: str, **variables: str) -> str:
    """Return what `code`, which sets `answer`, and the variables afterwards say."""
    done = run(code + _SHOW, **variables)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def error_of(code: str, **variables: str) -> str:
    """Return how `code` failed, and that no variable has changed."""
    body = "\n  ".join(code.splitlines())
    wrapped = (
        f"before = dict(os.environ)\ntry:\n  {body}\n"
        "except mjrec.Error as error:\n"
        "  print(type(error).__name__, error)\n"
        "  assert dict(os.environ) == before\n"
        "else:\n  sys.exit('no error')"
    )
    done = run(wrapped, **variables)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_it_is_inert() -> None:
    """No simulator, no OpenGL, no variable."""
    code = (
        "before = dict(os.environ); import mjrec.gl\n"
        "assert not {'mujoco', 'OpenGL', 'glfw', 'dm_control'} & set(sys.modules)\n"
        "assert dict(os.environ) == before"
    )
    done = run(code)
    assert done.returncode == 0, done.stderr


def test_egl_is_tried_first() -> None:
    """With nothing said, the first that renders, for PyOpenGL too."""
    assert answer_of("answer = mjrec.use_gl()") == "egl egl egl"


@parametrize("text", ["egl", " EGL "])
def test_the_argument_in_any_spelling(text: str) -> None:
    """What is set is the spelling that every program understands."""
    assert answer_of(f"answer = mjrec.use_gl({text!r})") == "egl egl egl"


def test_the_variable_in_any_spelling() -> None:
    """`MUJOCO_GL=EGL`, which Gymnasium refuses, becomes `egl`."""
    assert answer_of("answer = mjrec.use_gl()", MUJOCO_GL="EGL") == "egl egl egl"


def test_the_argument_before_the_variable() -> None:
    """The variable is not even looked at."""
    code = "answer = mjrec.use_gl('egl')"
    assert answer_of(code, MUJOCO_GL="nonsense") == "egl egl egl"


@parametrize("text", ["", "on"])
def test_a_variable_that_names_no_backend(text: str) -> None:
    """Rendering is on, by which backend is left open."""
    assert answer_of("answer = mjrec.use_gl()", MUJOCO_GL=text) == "egl egl egl"


def test_a_contradicting_platform_is_put_right() -> None:
    """`PYOPENGL_PLATFORM` follows."""
    code = "answer = mjrec.use_gl()"
    assert answer_of(code, PYOPENGL_PLATFORM="osmesa") == "egl egl egl"


def test_mujoco_then_takes_the_choice() -> None:
    """What is imported afterwards draws by it."""
    code = "mjrec.use_gl('egl'); import mujoco; answer = mujoco.GLContext.__module__"
    assert answer_of(code).startswith("mujoco.egl ")


@pytest.mark.parametrize("text", ["nonsense", "", "off", "cuda"])
def test_unknown_argument(text: str) -> None:
    """The backends that there are are listed."""
    said = error_of(f"mjrec.use_gl({text!r})")
    assert said.startswith("UnknownName There is no OpenGL backend")
    assert "egl, osmesa, glfw" in said


def test_unknown_variable() -> None:
    """The message says that the name comes from the environment."""
    said = error_of("mjrec.use_gl()", MUJOCO_GL="nonsense")
    assert said.startswith("UnknownName There is no OpenGL backend 'nonsense'")
    assert "egl, osmesa, glfw" in said
    assert "environment variable MUJOCO_GL" in said


@pytest.mark.parametrize("text", ["off", "Disable", "0"])
def test_rendering_turned_off(text: str) -> None:
    """It is said, and not overruled."""
    said = error_of("mjrec.use_gl()", MUJOCO_GL=text)
    assert f"GLError The environment variable MUJOCO_GL is {text!r}" in said
    assert "turns rendering off" in said


def test_an_asked_backend_that_does_not_render() -> None:
    """The error comes at once, with cause and fix, and nothing is set."""
    said = error_of("mjrec.use_gl('glfw')")
    assert "GLError OpenGL backend glfw (asked for) cannot be used here." in said
    assert "DISPLAY is not set" in said
    assert "xvfb-run" in said


def test_a_named_backend_that_does_not_render() -> None:
    """The error says that the variable named it."""
    said = error_of("mjrec.use_gl()", MUJOCO_GL="glfw")
    assert "OpenGL backend glfw (MUJOCO_GL names it) cannot be used here." in said


def test_the_next_one_where_the_first_crashes(tmp_path: Path) -> None:
    """A crash of EGL's driver leads to OSMesa, and the reason is logged."""
    osmesa = probe("osmesa")
    if not osmesa.renders:
        pytest.skip(f"{osmesa.cause} {osmesa.fix}")
    (tmp_path / "sitecustomize.py").write_text(
        "import ctypes, os\n"
        "if os.environ.get('MUJOCO_GL') == 'egl':\n  ctypes.string_at(0)\n"
    )
    code = "answer = mjrec.use_gl()" + _SHOW
    done = run(code, PYTHONPATH=str(tmp_path))
    assert done.stdout.strip() == "osmesa osmesa osmesa"
    assert "egl cannot be used: The driver crashed (SIGSEGV)" in done.stderr


def test_nothing_renders(tmp_path: Path) -> None:
    """Every backend is listed with its own cause and fix."""
    for name in ("libEGL.so", "libOSMesa.so"):
        for number in ["", *(f".{n}" for n in range(10))]:
            (tmp_path / f"{name}{number}").touch()
    said = error_of("mjrec.use_gl()", LD_LIBRARY_PATH=str(tmp_path))
    assert said.startswith("GLError No OpenGL backend can be used here.\n")
    assert "egl: EGL's library is there and cannot be loaded" in said
    assert "osmesa: OSMesa's library is there and cannot be loaded" in said
    assert "glfw: GLFW needs a display" in said
    assert "apt-get install -y libegl1 " in said
    assert "apt-get install -y libosmesa6 " in said


def test_mujoco_imported_with_another_backend() -> None:
    """The one that it took and the one asked for are named, and the way out."""
    said = error_of("import mujoco\nmjrec.use_gl('egl')")
    assert "mujoco was imported with glfw in this process" in said
    assert "cannot change to egl" in said
    assert "before anything imports them" in said


def test_a_variable_set_after_the_import() -> None:
    """What mujoco took counts, not what the variable says since."""
    code = (
        "import mujoco\nos.environ['MUJOCO_GL'] = 'osmesa'\nbefore = dict(os.environ)"
    )
    said = error_of(f"{code}\nmjrec.use_gl()", MUJOCO_GL="egl")
    assert "mujoco was imported with egl in this process" in said


def test_mujoco_imported_with_the_same_backend() -> None:
    """Nothing has to change, so there is nothing to say."""
    code = "import mujoco; answer = mjrec.use_gl('egl')"
    assert answer_of(code, MUJOCO_GL="egl") == "egl egl egl"


def test_mujoco_imported_without_rendering() -> None:
    """Rendering that was off at the import cannot be turned on."""
    code = "import mujoco\ndel os.environ['MUJOCO_GL']\nbefore = dict(os.environ)"
    said = error_of(f"{code}\nmjrec.use_gl()", MUJOCO_GL="off")
    assert "mujoco was imported without a backend" in said


def test_mujoco_imported_leaves_one_backend_to_try() -> None:
    """With nothing asked for, what mujoco took is tried, and all reasons are given."""
    said = error_of("import mujoco\nmjrec.use_gl()")
    assert "egl: mujoco was imported with glfw" in said
    assert "glfw: GLFW needs a display" in said


def test_pyopengl_imported_before() -> None:
    """PyOpenGL, too, chooses once."""
    code = "import OpenGL.GL\nbefore = dict(os.environ)\nmjrec.use_gl('egl')"
    said = error_of(code, PYOPENGL_PLATFORM="glx")
    assert "PyOpenGL was imported with glx in this process" in said


def test_dm_control_imported_with_another_backend() -> None:
    """dm_control's choice is found too, where mujoco has none yet."""
    code = (
        "import types\nmodule = types.ModuleType('dm_control._render')\n"
        "module.BACKEND = 'osmesa'\nsys.modules['dm_control._render'] = module\n"
        "mjrec.use_gl('egl')"
    )
    assert "dm_control was imported with osmesa" in error_of(code)
