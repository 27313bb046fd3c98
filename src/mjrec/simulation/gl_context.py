# SPDX-License-Identifier: Apache-2.0
"""OpenGL contexts, and the driver that draws in them.

A context is current on at most one thread, and a thread has at most one current
context. An environment keeps its own context current on the thread that steps it and
does not always make it current again (Gymnasium's viewer does not). If we left another
context current there, the environment's frames would be black. So the context that was
current before is always made current again.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import os
import sys
from collections.abc import Iterator
from typing import Any

import mujoco

from ..errors import Error, GLError
from ..gl.egl import egl_devices

_STRINGS = ("GL_VENDOR", "GL_RENDERER", "GL_VERSION")

# The size of the window that mujoco allocates. It is never drawn into: everything goes
# to the offscreen buffer of the `MjrContext`.
_WINDOW_SIDE = 16

# Mesa's rasterizer has its own threads, which a forked child lacks. The child's first
# frame waits for them forever, even if every context was freed before the fork.
_has_made_context = False
_forked_from_gl = False


def new_context() -> Any:
    """Create a mujoco context, and make it current on this thread.

    Only the context's owner may free it, with `free`. The caller must make the previous
    context current again, with `context_kept`.

    Raises:
        GLError: no context can be created here, or this process was forked from a
            process that had created contexts.
    """
    global _has_made_context
    refuse_fork_of_gl()
    try:
        # mujoco's own class frees a context on the thread that last referred to it.
        owned = {"__del__": lambda context: None}
        kind: Any = type("OwnedGLContext", (_context_class(),), owned)
        context = kind(_WINDOW_SIDE, _WINDOW_SIDE)
        _has_made_context = True
        context.make_current()
        # Not every mujoco context imports PyOpenGL, which `current_gl_facts` needs.
        raw_opengl()
        works = bool(current_gl_facts())
    except Error:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise gl_error("No OpenGL context can be created", reason) from error
    if not works:
        # GLFW without a display creates an object that does nothing.
        raise gl_error("No OpenGL context can be created", "it cannot be drawn to")
    return context


def gl_error(what: str, reason: object, *, remedy: str = "") -> GLError:
    """Return the error for a failed OpenGL operation.

    Args:
        what: what failed, as a clause.
        reason: the message from mujoco or the driver.
        remedy: a sentence that suggests a remedy to try before `mjrec doctor`.
    """
    backend = os.environ.get("MUJOCO_GL")
    setting = "unset" if backend is None else repr(backend)
    parts = [
        f"{what}, with MUJOCO_GL {setting}: {str(reason).rstrip('. ')}.",
        remedy,
        "Run `mjrec doctor` to see which backend renders here and why the others do "
        "not.",
    ]
    return GLError(" ".join(filter(None, parts)))


def raw_opengl() -> Any:
    """Return PyOpenGL's functions for OpenGL 1.0. A context must be current.

    `OpenGL.GL` is not used, because its import takes longer than drawing a frame.
    """
    # PyOpenGL chooses its platform on import, and mujoco sets the platform when it
    # imports its context class. So do not import PyOpenGL before a context exists.
    return importlib.import_module("OpenGL.raw.GL.VERSION.GL_1_0")


def current_gl_facts() -> dict[str, Any]:
    """Return metadata about the context that is current on this thread.

    These are `gl_vendor`, `gl_renderer`, `gl_version` and, if EGL reports the device it
    draws on, `gl_device`: its `index` in EGL's list and, if a GPU's driver reports
    them, its `file` and `uuid`. The dict is empty if no context is current.

    CUDA's device number is not queried, because that would initialize CUDA in a process
    that may belong to another library and be forked later.
    """
    # If a context exists, PyOpenGL has been imported. Do not import it here.
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
def context_kept(*, or_none: bool = False) -> Iterator[None]:
    """Restore, after the block, the context that was current before it.

    This works only with EGL. Other backends cannot make another library's context
    current, so the block's context stays current.

    Args:
        or_none: whether to end without a current context if there was none before. If
            False, the block's context then stays current.
    """
    before = _current_in_egl()
    try:
        yield
    finally:
        if before is None and or_none and (current := _current_in_egl()):
            egl = sys.modules["OpenGL.EGL"]
            none = (egl.EGL_NO_SURFACE, egl.EGL_NO_SURFACE, egl.EGL_NO_CONTEXT)
            before = (current[0], *none)
        if before is not None:
            # The block may have freed that context.
            with contextlib.suppress(sys.modules["OpenGL.error"].Error):
                sys.modules["OpenGL.EGL"].eglMakeCurrent(*before)


@contextlib.contextmanager
def collection_paused() -> Iterator[None]:
    """Pause the garbage collector inside the block.

    When mujoco's renderers are collected, they free their OpenGL objects in whichever
    context is current. A frame that is drawn there then contains arbitrary memory.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def refuse_fork_of_gl() -> None:
    """Raise GLError if this process was forked from one that had used OpenGL."""
    if _forked_from_gl:
        raise GLError(
            "This process was forked from one that had used OpenGL, so drawing here "
            'would hang. Start it with multiprocessing\'s "spawn" method (for '
            'Gymnasium: AsyncVectorEnv(..., context="spawn")), or fork before anything '
            "is drawn."
        )


def _note_fork() -> None:
    global _forked_from_gl
    # This includes contexts that another library created through mujoco's EGL.
    display = getattr(sys.modules.get("mujoco.egl"), "EGL_DISPLAY", None)
    _forked_from_gl = _forked_from_gl or _has_made_context or display is not None


os.register_at_fork(after_in_child=_note_fork)


def _current_in_egl() -> tuple[Any, ...] | None:
    """Return the arguments of `eglMakeCurrent` that restore the current context."""
    # If there is a context, PyOpenGL has been imported.
    egl = sys.modules.get("OpenGL.EGL")
    if egl is None or not (context := egl.eglGetCurrentContext()):
        return None
    surfaces = map(egl.eglGetCurrentSurface, (egl.EGL_DRAW, egl.EGL_READ))
    return egl.eglGetCurrentDisplay(), *surfaces, context


def _context_class() -> Any:
    """Return the context class for the backend that mujoco chose on import."""
    if hasattr(mujoco, "GLContext"):
        return mujoco.GLContext
    # mujoco hides the error on import. Importing the failed module again raises it.
    for module in ("mujoco.rendering.classic.gl_context", "mujoco.gl_context"):
        with contextlib.suppress(ModuleNotFoundError, AttributeError):
            return importlib.import_module(module).GLContext
    raise gl_error(
        "mujoco was imported without rendering",
        "module 'mujoco' has no attribute 'GLContext'",
    )
