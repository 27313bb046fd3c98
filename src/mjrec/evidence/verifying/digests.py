# SPDX-License-Identifier: Apache-2.0
"""Digests of files that may be anybody's."""

from __future__ import annotations

import hashlib
from pathlib import Path

from ...formats.regular_files import open_regular

_CHUNK = 1 << 20


def digest_of(path: Path, algorithm: str = "sha256") -> str:
    """Return the digest of a regular file, in hexadecimal.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no regular file, or a link that leads out of its directory.
    """
    digest = hashlib.new(algorithm)
    with open_regular(path) as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()
