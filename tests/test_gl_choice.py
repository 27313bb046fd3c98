# SPDX-License-Identifier: Apache-2.0
"""`use_gl`, in processes of their own: it is about what a process has done so far."""

import pytest
from other_python import run_python, without_gl
from parts import parametrize

from mjrec.gl.choice import probe

_SHOW = "\nprint(answer, os.environ['MUJOCO_GL'], os.environ['PYOPENGL_PLATFORM'])"
_HEAD = "import logging, os, sys; import mjrec; logging.basicConfig(level='INFO')\n"


def run(code, **variables):
    """Run `code` in a Python whose environment chooses no OpenGL but these."""
    return run_python(_HEAD + code, env=without_gl(**variables))


def error_of(code, **variables):
    """Return how `code` failed, and that no variable has changed."""
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
        # What is set is the spelling that every program understands.
        ("answer = mjrec.use_gl()", {"MUJOCO_GL": "EGL"}),
        ("answer = mjrec.use_gl('egl')", {"MUJOCO_GL": "nonsense"}),
        # Rendering is on, by which backend is left open.
        ("answer = mjrec.use_gl()", {"MUJOCO_GL": "on"}),
        ("answer = mjrec.use_gl()", {"PYOPENGL_PLATFORM": "osmesa"}),
        ("import mujoco; answer = mjrec.use_gl('egl')", {"MUJOCO_GL": "egl"}),
    ],
)
def test_a_backend_is_taken(code, variables):
    """The argument, else the variable, else the first that renders; both variables."""
    assert run(code + _SHOW, **variables).stdout == "egl egl egl\n"


def test_mujoco_then_takes_the_choice():
    """What is imported afterwards draws by it; importing mjrec.gl imports none."""
    code = (
        "import mjrec.gl\n"
        "assert not {'mujoco', 'OpenGL', 'glfw', 'dm_control'} & set(sys.modules)\n"
        "mjrec.use_gl('egl'); import mujoco; answer = mujoco.GLContext.__module__"
    )
    assert run(code + _SHOW).stdout.startswith("mujoco.egl ")


@pytest.mark.parametrize(
    ("code", "variables", "said"),
    [
        ("mjrec.use_gl('cuda')", {}, ["UnknownName There is no OpenGL backend 'cuda'"]),
        (
            "mjrec.use_gl()",
            {"MUJOCO_GL": "nonsense"},
            ["UnknownName", "comes from the environment variable MUJOCO_GL"],
        ),
        ("mjrec.use_gl()", {"MUJOCO_GL": "Off"}, ["GLError", "turns rendering off"]),
        (
            "mjrec.use_gl('glfw')",
            {},
            ["backend glfw (requested) cannot", "DISPLAY is not set", "xvfb-run"],
        ),
    ],
)
def test_what_cannot_be_taken(code, variables, said):
    """The error has the cause and what to do, and no variable changes."""
    error = error_of(code, **variables)
    assert all(each in error for each in said), error


def test_the_next_one_where_the_first_crashes(tmp_path):
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


def test_nothing_renders(tmp_path):
    """Every backend is listed with its own cause and fix."""
    for name in ("libEGL.so", "libOSMesa.so"):
        for number in ["", *(f".{n}" for n in range(10))]:
            (tmp_path / f"{name}{number}").touch()
    said = error_of("mjrec.use_gl()", LD_LIBRARY_PATH=str(tmp_path))
    assert said.startswith("GLError No OpenGL backend can be used here.\n")
    assert "egl: EGL's library is installed but cannot be loaded" in said
    assert "osmesa: OSMesa's library is installed but cannot be loaded" in said
    assert "glfw: GLFW needs a display" in said
    assert "apt-get install -y libegl1 " in said
    assert "apt-get install -y libosmesa6 " in said


@pytest.mark.parametrize(
    ("code", "variables", "said"),
    [
        (
            "import mujoco\nmjrec.use_gl('egl')",
            {},
            ["mujoco was imported with glfw", "switch to egl", "before anything"],
        ),
        (
            "import OpenGL.GL\nbefore = dict(os.environ)\nmjrec.use_gl('egl')",
            {"PYOPENGL_PLATFORM": "glx"},
            ["PyOpenGL was imported with glx in this process"],
        ),
        # Stands for dm_control with OSMesa, which not every machine has.
        (
            "import types\nmodule = types.ModuleType('dm_control._render')\n"
            "module.BACKEND = 'osmesa'\nsys.modules['dm_control._render'] = module\n"
            "mjrec.use_gl('egl')",
            {},
            ["dm_control was imported with osmesa"],
        ),
    ],
    ids=["mujoco", "PyOpenGL", "dm_control"],
)
def test_what_was_imported_before(code, variables, said):
    """A backend is taken once; the one that was is named, and the way out."""
    error = error_of(code, **variables)
    assert all(each in error for each in said), error
