# SPDX-License-Identifier: Apache-2.0
"""Whose OpenGL context is current on this thread."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def current_context_kept() -> Iterator[None]:
    """Make the context that is current before the block current again after it.

    With EGL. The other backends cannot make a context current that somebody else
    made; with them the block's context stays current.
    """
    # Whoever made a context has loaded it.
    egl = sys.modules.get("OpenGL.EGL")
    before = None if egl is None else egl.eglGetCurrentContext()
    if egl is None or not before:
        yield
        return
    display = egl.eglGetCurrentDisplay()
    surfaces = [egl.eglGetCurrentSurface(kind) for kind in (egl.EGL_DRAW, egl.EGL_READ)]
    try:
        yield
    finally:
        if _address(egl.eglGetCurrentContext()) != _address(before):
            # The block may have freed it.
            with contextlib.suppress(sys.modules["OpenGL.error"].Error):
                egl.eglMakeCurrent(display, *surfaces, before)


def _address(context: Any) -> int | None:
    # No context is a null pointer, which has no address.
    return int(context.address) if context else None
