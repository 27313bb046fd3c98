# SPDX-License-Identifier: Apache-2.0
"""A thread that owns one OpenGL context.

A context belongs to the thread on which it is current, and each thread has one current
context. An environment that draws keeps its own context current on the thread that
steps it and does not always make it current again (Gymnasium's viewer does not), so a
second renderer on that thread would turn the environment's pictures black. A context
with a thread of its own disturbs nobody.
"""

from __future__ import annotations

import atexit
import concurrent.futures
import functools
import importlib
import logging
import os
import queue
import sys
import threading
import time
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, ParamSpec, TypeAlias, TypeVar

import mujoco

from ..errors import ClosedError, Error, GLError
from .gl_info import current_gl_facts, current_gl_strings, raw_opengl

logger = logging.getLogger(__name__)

P = ParamSpec("P")
T = TypeVar("T")

# No picture takes this long, not even one of 16384x16384 pixels on a busy machine
# without a GPU; a driver that hangs does.
_TIMEOUT_S = 300.0
_TIMEOUT_AT_EXIT_S = 10.0
_SLICE_S = 0.5

# What mujoco allocates for the window, which is never drawn into: everything goes to
# the offscreen buffer of the `MjrContext`.
_WINDOW_SIDE = 16

# Making the first context of a backend initialises a display that all of them share.
_making_context = threading.Lock()

_Requests: TypeAlias = "queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None]"


class GLThread:
    """Runs functions on one thread, on which a GL context of its own is current.

    Its methods may be called from any thread, one call at a time. The thread ends at
    `close`, when this object is garbage collected, and at interpreter exit.

    Args:
        finish: called on the thread before the context is freed. It must hold no
            reference to this object, or that would never be garbage collected.

    Attributes:
        facts: what metadata says of who draws, as `current_gl_facts`.

    Raises:
        GLError: no context can be made here, or this process was forked from one that
            has made contexts.
    """

    def __init__(self, *, finish: Callable[[], None]) -> None:
        _refuse_fork_of_gl()
        self._requests: _Requests = queue.SimpleQueue()
        self._closed = False
        self._hangs = False
        self._process_id = os.getpid()
        # Of the last request, which may still run after Ctrl-C.
        self._last: Future[Any] = Future()
        # A daemon, because the interpreter waits for other threads before it calls
        # what atexit knows, and this one ends only when it is told to.
        self._thread = threading.Thread(
            target=_serve,
            args=(self._requests, self._last, finish),
            name="mjrec-gl",
            daemon=True,
        )
        self._thread.start()
        self._release = weakref.finalize(
            self, _tell_to_end, self._requests, self._process_id
        )
        # Its own atexit hook may run after EGL was shut down, ours may not.
        self._release.atexit = False
        self.facts: dict[str, Any] = self._result(self._last)
        # Hooks run in reverse order, and mujoco's, which shuts EGL down, was registered
        # when the first context was made.
        self._exit_hook = functools.partial(_close_at_exit, weakref.ref(self))
        atexit.register(self._exit_hook)
        weakref.finalize(self, atexit.unregister, self._exit_hook).atexit = False

    def call(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Return `function(*args, **kwargs)`, called on the thread.

        What it raises is raised here, the same object.

        Raises:
            ClosedError: after `close`.
            GLError: in a forked child, which has no copy of the thread; or the driver
                hangs.
        """
        self.settle()
        future: Future[T] = Future()
        self._last = future
        try:
            self._requests.put((future, functools.partial(function, *args, **kwargs)))
            return self._result(future)
        finally:
            # After Ctrl-C, where it has not begun. The traceback of an error holds this
            # frame, which must not hold the error.
            if not future.cancel() and future.done():
                self._last = _idle()
            del future

    def settle(self) -> None:
        """Return when the thread is idle.

        It is busy only after Ctrl-C in the midst of an earlier call; what that one
        was using must be left alone until then.

        Raises:
            ClosedError, GLError: as `call`.
        """
        self._check_usable()
        _wait_for(self._last)

    def close(self, timeout_s: float = _TIMEOUT_S) -> None:
        """Call `finish`, free the context and end the thread. Idempotent.

        Does nothing in a forked child.
        """
        self._closed = True
        if os.getpid() != self._process_id:
            return
        self._release()
        atexit.unregister(self._exit_hook)
        if not self._hangs:
            self._thread.join(timeout_s)

    def _check_usable(self) -> None:
        """Raise ClosedError or GLError if a call would."""
        if self._closed:
            raise ClosedError("The renderer is closed.")
        if os.getpid() != self._process_id:
            raise GLError(
                f"This renderer lives in process {self._process_id} and cannot draw "
                "after a fork: make it in the process that draws. Start that process "
                'with multiprocessing\'s "spawn" method.'
            )
        if self._hangs:
            raise GLError(
                "The OpenGL driver hangs since an earlier call: end this process."
            )

    def _result(self, future: Future[T]) -> T:
        if _wait_for(future):
            return future.result()
        self._hangs = True
        raise GLError(
            f"The OpenGL driver gave no answer within {_TIMEOUT_S:.0f} seconds. "
            "Run `mjrec doctor` to see which backend works; end this process."
        )


def _wait_for(future: Future[Any]) -> bool:
    """Wait until a request is answered; tell whether it is."""
    deadline = time.monotonic() + _TIMEOUT_S
    while not future.done() and (left := deadline - time.monotonic()) > 0:
        # In slices: a signal that comes just before the wait does not end it, and
        # Ctrl-C would be noticed only after it.
        concurrent.futures.wait([future], min(left, _SLICE_S))
    return future.done()


def _idle() -> Future[Any]:
    future: Future[Any] = Future()
    future.cancel()
    return future


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


def _serve(requests: _Requests, made: Future[Any], finish: Callable[[], None]) -> None:
    try:
        context = _make_context()
    except BaseException as error:
        made.set_exception(error)
        return
    made.set_result(current_gl_facts())
    # Nothing of the caller's is kept alive while waiting for the next request.
    del made
    while (request := requests.get()) is not None:
        _answer(*request, context)
        del request
    _end(context, finish)


def _answer(future: Future[Any], function: Callable[[], Any], context: Any) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        # Each time, because a garbage collection on this thread may have freed some
        # other context, and mujoco's EGL then lets go of whatever is current.
        context.make_current()
        future.set_result(function())
    except BaseException as error:
        future.set_exception(error)
        # Its traceback holds this frame.
        del future


def _end(context: Any, finish: Callable[[], None]) -> None:
    # At interpreter exit somebody else may have shut EGL down already; everything is
    # gone then, and there is nobody to tell.
    for step in (context.make_current, finish, context.free):
        try:
            step()
        except Exception:
            logger.debug("Could not free an OpenGL context", exc_info=True)


def _tell_to_end(requests: _Requests, process_id: int) -> None:
    # `put` may be called from a finaliser; the thread does the rest in its own time.
    if os.getpid() == process_id:
        requests.put(None)


def _close_at_exit(reference: weakref.ref[GLThread]) -> None:
    if (thread := reference()) is not None:
        thread.close(_TIMEOUT_AT_EXIT_S)


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
        works = bool(current_gl_strings().get("gl_renderer"))
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
        try:
            return importlib.import_module(module).GLContext
        except (ModuleNotFoundError, AttributeError):
            continue
    raise gl_error("mujoco was imported without rendering", "it has no GLContext")


def _owned(context_class: type[Any]) -> type[Any]:
    """Return a subclass that only its owner frees.

    mujoco's classes free the context in `__del__`, on whichever thread drops it.
    """
    return type("OwnedGLContext", (context_class,), {"__del__": _leave_to_the_owner})


def _leave_to_the_owner(context: object) -> None:
    del context


# Mesa's rasteriser has threads of its own, which a forked child lacks: the first frame
# that it draws waits for them for ever, even if every context was freed before.
_has_made_context = False
_forked_from_gl = False


def _note_fork() -> None:
    global _forked_from_gl
    _forked_from_gl = _forked_from_gl or _has_made_context or _egl_is_initialised()


def _egl_is_initialised() -> bool:
    """Return whether anybody has made a context through mujoco's EGL."""
    return getattr(sys.modules.get("mujoco.egl"), "EGL_DISPLAY", None) is not None


os.register_at_fork(after_in_child=_note_fork)


def _refuse_fork_of_gl() -> None:
    if _forked_from_gl:
        raise GLError(
            "This process was forked from one that had used OpenGL, and drawing here "
            'would wait for ever. Start it with multiprocessing\'s "spawn" method (for '
            'Gymnasium: AsyncVectorEnv(..., context="spawn")), or fork before anything '
            "is drawn."
        )
