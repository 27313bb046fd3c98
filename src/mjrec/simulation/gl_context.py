# SPDX-License-Identifier: Apache-2.0
"""OpenGL contexts, and who draws in them.

A context is current on one thread at a time, and a thread has one current context. An
environment keeps its own current on the thread that steps it and does not always make
it current again (Gymnasium's viewer does not): another one left there would turn its
frames black. So whatever was current before is current again afterwards.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import sys
from collections.abc import Iterator
from typing import Any

import mujoco

from ..errors import Error, GLError
from ..gl.egl import egl_devices

_STRINGS = ("GL_VENDOR", "GL_RENDERER", "GL_VERSION")

# What mujoco allocates for the window, which is never drawn into: everything goes to
# the offscreen buffer of the `MjrContext`.
_WINDOW_SIDE = 16

# Mesa's rasteriser has threads of its own, which a forked child lacks: the first frame
# that it draws waits for them for ever, even if every context was freed before.
_has_made_context = False
_forked_from_gl = False


def new_context() -> Any:
    """Return a new context of mujoco's, current on this thread.

    Only its owner frees it, by `free`. What was current before is its caller's to put
    back, with `context_kept`.

    Raises:
        GLError: no context can be made here, or this process was forked from one that
            had made contexts.
    """
    global _has_made_context
    refuse_fork_of_gl()
    try:
        # mujoco's own class frees a context on whichever thread drops it.
        owned = {"__del__": lambda context: None}
        kind: Any = type("OwnedGLContext", (_context_class(),), owned)
        context = kind(_WINDOW_SIDE, _WINDOW_SIDE)
        _has_made_context = True
        context.make_current()
        # Not every context of mujoco's imports it, and nothing is read before.
        raw_opengl()
        works = bool(current_gl_facts())
    except Error:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise gl_error("No OpenGL context can be made", reason) from error
    if not works:
        # GLFW without a display makes an object that does nothing.
        raise gl_error("No OpenGL context can be made", "nothing draws into it")
    return context


def gl_error(what: str, reason: object, *, remedy: str = "") -> GLError:
    """Return the error for something that OpenGL cannot do here.

    Args:
        what: what cannot be done.
        reason: what mujoco or the driver said.
        remedy: what to try before `mjrec doctor`.
    """
    backend = os.environ.get("MUJOCO_GL")
    setting = "unset" if backend is None else repr(backend)
    parts = [
        f"{what}, with MUJOCO_GL {setting}: {str(reason).rstrip('. ')}.",
        remedy,
        "Run `mjrec doctor` to see which backend renders here and what the others "
        "lack.",
    ]
    return GLError(" ".join(filter(None, parts)))


def raw_opengl() -> Any:
    """Return PyOpenGL's functions of OpenGL 1.0, for use where a context is current.

    Not `OpenGL.GL`, which takes longer to import than a frame to draw.
    """
    # It chooses its platform when it is imported, and mujoco sets which one when it
    # imports its context class: not before there is a context.
    return importlib.import_module("OpenGL.raw.GL.VERSION.GL_1_0")


def current_gl_facts() -> dict[str, Any]:
    """Return what metadata says of who draws in the context current on this thread.

    These are `gl_vendor`, `gl_renderer` and `gl_version` and, where EGL tells on which
    of its devices it draws, `gl_device`: its `index` in EGL's list and, of a GPU whose
    driver says them, its `file` and its `uuid`. Empty where no context is current.

    CUDA's number is not asked for, because that would begin CUDA in a process that may
    be another library's and forked later.
    """
    # Code that drew has imported it already; it must not be imported here.
    if "OpenGL.platform" not in sys.modules:
        return {}
    gl = raw_opengl()
    facts: dict[str, Any] = {}
    for name in _STRINGS:
        try:
            pointer = gl.glGetString(getattr(gl, name))
        except sys.modules["OpenGL.error"].Error:
            return {}
        value = ctypes.cast(pointer, ctypes.c_char_p).value
        if value is None:
            return {}
        facts[name.lower()] = value.decode(errors="replace")
    platform = getattr(sys.modules["OpenGL.platform"], "PLATFORM", None)
    if type(platform).__name__ == "EGLPlatform":
        for device in egl_devices(with_cuda=False):
            if device.in_use:
                known = {"file": device.device_file, "uuid": device.uuid}
                details = {name: value for name, value in known.items() if value}
                facts["gl_device"] = {"index": device.index, **details}
    return facts


@contextlib.contextmanager
def context_kept() -> Iterator[None]:
    """Make the context that is current before the block current again after it.

    With EGL. The other backends cannot make another library's context current;
    with them the block's context stays current, as it does where there was none.
    """
    before = _current_in_egl()
    try:
        yield
    finally:
        if before is not None:
            # The block may have freed it.
            with contextlib.suppress(sys.modules["OpenGL.error"].Error):
                sys.modules["OpenGL.EGL"].eglMakeCurrent(*before)


def refuse_fork_of_gl() -> None:
    """Raise GLError in a process that was forked from one that had used OpenGL."""
    if _forked_from_gl:
        raise GLError(
            "This process was forked from one that had used OpenGL, and drawing here "
            'would wait for ever. Start it with multiprocessing\'s "spawn" method (for '
            'Gymnasium: AsyncVectorEnv(..., context="spawn")), or fork before anything '
            "is drawn."
        )


def _note_fork() -> None:
    global _forked_from_gl
    # Also where another library has made a context through mujoco's EGL.
    display = getattr(sys.modules.get("mujoco.egl"), "EGL_DISPLAY", None)
    _forked_from_gl = _forked_from_gl or _has_made_context or display is not None


os.register_at_fork(after_in_child=_note_fork)


def _current_in_egl() -> tuple[Any, ...] | None:
    """Return what makes the current context, if any, current again."""
    # Making a context has loaded it.
    egl = sys.modules.get("OpenGL.EGL")
    if egl is None or not (context := egl.eglGetCurrentContext()):
        return None
    surfaces = map(egl.eglGetCurrentSurface, (egl.EGL_DRAW, egl.EGL_READ))
    return egl.eglGetCurrentDisplay(), *surfaces, context


def _context_class() -> Any:
    """Return the class for the backend that mujoco chose when it was imported."""
    if hasattr(mujoco, "GLContext"):
        return mujoco.GLContext
    # mujoco swallows the reason when it is imported; importing the part that failed
    # once more tells it.
    for module in ("mujoco.rendering.classic.gl_context", "mujoco.gl_context"):
        with contextlib.suppress(ModuleNotFoundError, AttributeError):
            return importlib.import_module(module).GLContext
    raise gl_error(
        "mujoco was imported without rendering",
        "module 'mujoco' has no attribute 'GLContext'",
    )
