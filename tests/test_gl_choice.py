# SPDX-License-Identifier: Apache-2.0
"""Test `use_gl` in new processes, because it depends on what was imported before."""

import pytest
from other_python import run_python, without_gl
from parts import parametrize

from mjrec.gl.choice import probe

_SHOW = "\nprint(answer, os.environ['MUJOCO_GL'], os.environ['PYOPENGL_PLATFORM'])"
_HEAD = "import logging, os, sys; import mjrec; logging.basicConfig(level='INFO')\n"


def run(code, **variables):
    """Run `code` in a new Python with only these OpenGL variables."""
    return run_python(_HEAD + code, env=without_gl(**variables))


def error_of(code, **variables):
    """Return the error that `code` raises, and check that no variable changes."""
    body = "\n  ".join(code.splitlines())
    wrapped = (
        f"before = dict(os.environ)\ntry:\n  {body}\n"
        "except mjrec.Error as error:\n"
        "  print(type(error).__name__, error)\n"
        "  assert dict(os.environ) == before\n"
        "else:\n  sys.exit('no error')"
    )
    return run(wrapped, **variables).stdout


@parametrize(
    ("code", "variables"),
    [
        ("answer = mjrec.use_gl()", {}),
        ("answer = mjrec.use_gl(' EGL ')", {}),
        # The result has the spelling that every program understands.
        ("answer = mjrec.use_gl()", {"MUJOCO_GL": "EGL"}),
        ("answer = mjrec.use_gl('egl')", {"MUJOCO_GL": "nonsense"}),
        # The value "on" does not choose a backend.
        ("answer = mjrec.use_gl()", {"MUJOCO_GL": "on"}),
        ("answer = mjrec.use_gl()", {"PYOPENGL_PLATFORM": "osmesa"}),
        ("import mujoco; answer = mjrec.use_gl('egl')", {"MUJOCO_GL": "egl"}),
    ],
)
def test_backend_comes_from_argument_variable_or_first_that_renders(code, variables):
    """`use_gl` sets both variables to the backend."""
    assert run(code + _SHOW, **variables).stdout == "egl egl egl\n"


def test_mujoco_imported_later_uses_the_backend():
    """`mjrec.gl` itself imports neither mujoco nor OpenGL."""
    code = (
        "import mjrec.gl\n"
        "assert not {'mujoco', 'OpenGL', 'glfw', 'dm_control'} & set(sys.modules)\n"
        "mjrec.use_gl('egl'); import mujoco; answer = mujoco.GLContext.__module__"
    )
    assert run(code + _SHOW).stdout.startswith("mujoco.egl ")


@pytest.mark.parametrize(
    ("code", "variables", "words"),
    [
        ("mjrec.use_gl('cuda')", {}, ["UnknownName There is no OpenGL backend 'cuda'"]),
        (
            *("mjrec.use_gl()", {"MUJOCO_GL": "nonsense"}),
            ["UnknownName", "comes from the environment variable MUJOCO_GL"],
        ),
        ("mjrec.use_gl()", {"MUJOCO_GL": "Off"}, ["GLError", "turns rendering off"]),
        (
            *("mjrec.use_gl('glfw')", {}),
            ["backend glfw (requested) cannot", "DISPLAY is not set", "xvfb-run"],
        ),
        # An earlier import of mujoco has already chosen another backend.
        (
            *("import mujoco\nmjrec.use_gl('egl')", {}),
            ["mujoco was imported with glfw", "switch to egl", "before anything"],
        ),
        (
            "import OpenGL.GL\nbefore = dict(os.environ)\nmjrec.use_gl('egl')",
            {"PYOPENGL_PLATFORM": "glx"},
            ["PyOpenGL was imported with glx in this process"],
        ),
        # This stand-in for dm_control uses OSMesa, which not every machine has.
        (
            "import types\nmodule = types.ModuleType('dm_control._render')\n"
            "module.BACKEND = 'osmesa'\nsys.modules['dm_control._render'] = module\n"
            "mjrec.use_gl('egl')",
            *({}, ["dm_control was imported with osmesa"]),
        ),
    ],
)
def test_unusable_backends_are_errors_with_cause_and_fix(code, variables, words):
    error = error_of(code, **variables)
    assert all(each in error for each in words), error


def test_crash_of_egl_leads_to_osmesa(tmp_path):
    osmesa = probe("osmesa")
    if not osmesa.renders:
        pytest.skip(f"{osmesa.cause} {osmesa.fix}")
    (tmp_path / "sitecustomize.py").write_text(
        "import ctypes, os\n"
        "if os.environ.get('MUJOCO_GL') == 'egl':\n  ctypes.string_at(0)\n"
    )
    done = run("answer = mjrec.use_gl()" + _SHOW, PYTHONPATH=str(tmp_path))
    assert done.stdout.strip() == "osmesa osmesa osmesa"
    assert "egl cannot be used: The driver crashed (SIGSEGV)" in done.stderr


def test_error_lists_cause_and_fix_of_every_backend(tmp_path):
    for name in ("libEGL.so", "libOSMesa.so"):
        for number in ["", *(f".{n}" for n in range(10))]:
            (tmp_path / f"{name}{number}").touch()
    error = error_of("mjrec.use_gl()", LD_LIBRARY_PATH=str(tmp_path))
    assert error.startswith("GLError No OpenGL backend can be used here.\n")
    for words in (
        "egl: EGL's library is installed but cannot be loaded",
        "osmesa: OSMesa's library is installed but cannot be loaded",
        "glfw: GLFW needs a display",
        "apt-get install -y libegl1 ",
        "apt-get install -y libosmesa6 ",
    ):
        assert words in error
