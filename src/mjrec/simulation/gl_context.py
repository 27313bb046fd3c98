# SPDX-License-Identifier: Apache-2.0
"""OpenGL contexts that are current only while they are used, and who draws in them.

A context is current on one thread at a time, and a thread has one current context. An
environment keeps its own current on the thread that steps it and does not always make
it current again (Gymnasium's viewer does not): another one left there would turn its
frames black. So whatever was current before is current again afterwards.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import importlib
import logging
import os
import sys
import threading
import weakref
from collections.abc import Iterator
from typing import Any

import mujoco

from ..errors import ClosedError, Error, GLError
from ..gl.egl import egl_devices

logger = logging.getLogger(__name__)

_STRINGS = ("GL_VENDOR", "GL_RENDERER", "GL_VERSION")

# What mujoco allocates for the window, which is never drawn into: everything goes to
# the offscreen buffer of the `MjrContext`.
_WINDOW_SIDE = 16

# Making the first context of a backend initialises a display that all of them share.
_making_context = threading.Lock()


class GLContext:
    """An OpenGL context, with MuJoCo's drawing context in it.

    It may be used on any thread, by one at a time. It is freed at interpreter exit,
    before mujoco shuts EGL down.

    Attributes:
        drawing: MuJoCo's context, made by the owner while this one is current.
        facts: what metadata says of who draws, as `current_gl_facts`.

    Raises:
        GLError: no context can be made here, or this process was forked from one that
            had made contexts.
    """

    def __init__(self) -> None:
        _refuse_fork_of_gl()
        self.drawing: mujoco.MjrContext | None = None
        self._closed = False
        self._process_id = os.getpid()
        with context_kept(or_none=True):
            self._context = _make_context()
            self.facts = current_gl_facts()
        _alive.add(self)
        _free_all_at_exit()

    @contextlib.contextmanager
    def current(self) -> Iterator[None]:
        """Make the context current for the block.

        Raises:
            ClosedError: after `free`.
            GLError: in a forked child.
        """
        if self._closed:
            raise ClosedError("The renderer is closed.")
        _refuse_fork_of_gl()
        with context_kept(or_none=True):
            self._context.make_current()
            yield

    def free(self) -> None:
        """Free what lies in the context, then the context. Idempotent.

        Does nothing in a forked child.
        """
        if self._closed:
            return
        self._closed = True
        if os.getpid() != self._process_id:
            # Deleting it would free what is the parent's.
            _of_the_parent.append(self)
            return
        with context_kept(or_none=True):
            # At exit somebody else may have shut EGL down already, and all is gone.
            for step in (self._context.make_current, self._drop, self._context.free):
                try:
                    step()
                except Exception:
                    logger.debug("Could not free an OpenGL context", exc_info=True)

    def _drop(self) -> None:
        if self.drawing is not None:
            self.drawing.free()
            self.drawing = None


_alive: weakref.WeakSet[GLContext] = weakref.WeakSet()
_of_the_parent: list[GLContext] = []


@functools.cache
def _free_all_at_exit() -> None:
    # After the first context was made: hooks run in reverse order, and mujoco's, which
    # shuts EGL down, was registered then.
    atexit.register(_free_all)


def _free_all() -> None:
    for context in list(_alive):
        context.free()


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
    be somebody else's and forked later.
    """
    # Whoever drew has imported it already, and nobody else may do it here.
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
                said = {name: value for name, value in known.items() if value}
                facts["gl_device"] = {"index": device.index, **said}
    return facts


@contextlib.contextmanager
def context_kept(*, or_none: bool = False) -> Iterator[None]:
    """Make the context that is current before the block current again after it.

    With EGL. The other backends cannot make a context current that somebody else
    made; with them the block's context stays current.

    Args:
        or_none: whether none is to be current afterwards where none was before; else
            the block's context stays then.
    """
    before = _current_in_egl()
    try:
        yield
    finally:
        if before is None and or_none:
            before = _current_in_egl(nothing=True)
        if before is not None:
            # The block may have freed it.
            with contextlib.suppress(sys.modules["OpenGL.error"].Error):
                sys.modules["OpenGL.EGL"].eglMakeCurrent(*before)


def _current_in_egl(*, nothing: bool = False) -> tuple[Any, ...] | None:
    """Return what makes the current context, if any, or none current again."""
    # Whoever made a context has loaded it.
    egl = sys.modules.get("OpenGL.EGL")
    if egl is None or not (context := egl.eglGetCurrentContext()):
        return None
    display = egl.eglGetCurrentDisplay()
    if nothing:
        return display, egl.EGL_NO_SURFACE, egl.EGL_NO_SURFACE, egl.EGL_NO_CONTEXT
    surfaces = map(egl.eglGetCurrentSurface, (egl.EGL_DRAW, egl.EGL_READ))
    return display, *surfaces, context


def _make_context() -> Any:
    """Return a new context, current on this thread."""
    global _has_made_context
    try:
        with _making_context:
            context: Any = _owned(_context_class())(_WINDOW_SIDE, _WINDOW_SIDE)
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


def _owned(context_class: type[Any]) -> type[Any]:
    """Return a subclass that only its owner frees.

    mujoco's classes free the context in `__del__`, on whichever thread drops it.
    """
    return type("OwnedGLContext", (context_class,), {"__del__": lambda context: None})


# Mesa's rasteriser has threads of its own, which a forked child lacks: the first frame
# that it draws waits for them for ever, even if every context was freed before.
_has_made_context = False
_forked_from_gl = False


def _note_fork() -> None:
    global _forked_from_gl
    # Also where somebody else has made a context through mujoco's EGL.
    display = getattr(sys.modules.get("mujoco.egl"), "EGL_DISPLAY", None)
    _forked_from_gl = _forked_from_gl or _has_made_context or display is not None


os.register_at_fork(after_in_child=_note_fork)


def _refuse_fork_of_gl() -> None:
    if _forked_from_gl:
        raise GLError(
            "This process was forked from one that had used OpenGL, and drawing here "
            'would wait for ever. Start it with multiprocessing\'s "spawn" method (for '
            'Gymnasium: AsyncVectorEnv(..., context="spawn")), or fork before anything '
            "is drawn."
        )
