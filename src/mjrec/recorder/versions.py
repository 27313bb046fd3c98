# SPDX-License-Identifier: Apache-2.0
"""The versions of what makes a recording."""

from __future__ import annotations

import functools
import importlib.metadata
import platform
from collections.abc import Mapping
from types import MappingProxyType

_PACKAGES = (
    *("mjrec", "mujoco", "gymnasium", "gymnasium-robotics", "dm-control", "numpy"),
    "imageio-ffmpeg",
)


@functools.cache
def versions() -> Mapping[str, str]:
    """Return the versions of Python and of the packages that are installed."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return MappingProxyType(found)
