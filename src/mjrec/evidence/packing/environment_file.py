# SPDX-License-Identifier: Apache-2.0
"""`environment.json`: what the recordings and their pictures were made with."""

from __future__ import annotations

import importlib.metadata
import platform
import zlib
from typing import Any

from .packed_run import PackedRun, Session

# What the metadata of a video says of whatever made it.
_OF_PICTURES = ("gl_vendor", "gl_renderer", "gl_version", "rendered_with")
_OF_ENCODING = ("ffmpeg_sha256",)


def environment(run: PackedRun) -> dict[str, Any]:
    """Return the content of the file; it depends on the recordings and on versions.

    Returns:
        `recordings`: for each monitor, by its infix, `env_id`, `versions`,
        `surroundings` (null where the recording says nothing of them), and `pictures`
        and `encoders`, each different one that made a video of it. `packed_with`: the
        versions of what has made this archive.
    """
    return {
        "recordings": {session.infix: _of(session) for session in run.sessions},
        "packed_with": {
            "mjrec": importlib.metadata.version("mjrec"),
            "bagit": importlib.metadata.version("bagit"),
            "python": platform.python_version(),
            # What deflates, to the very byte.
            "zlib": zlib.ZLIB_RUNTIME_VERSION,
        },
    }


def _of(session: Session) -> dict[str, Any]:
    pictures: list[dict[str, Any]] = []
    encoders: list[dict[str, Any]] = []
    for video in session.videos:
        said = video.metadata
        encoder = said.get("encoder_version")
        version = encoder.get("version") if isinstance(encoder, dict) else None
        _note(pictures, {key: said.get(key) for key in _OF_PICTURES})
        _note(encoders, {"version": version, **{k: said.get(k) for k in _OF_ENCODING}})
    return {
        "env_id": session.env_id,
        "versions": dict(session.versions),
        "surroundings": session.surroundings or None,
        "pictures": pictures,
        "encoders": encoders,
    }


def _note(known: list[dict[str, Any]], one: dict[str, Any]) -> None:
    if any(value is not None for value in one.values()) and one not in known:
        known.append(one)
