# SPDX-License-Identifier: Apache-2.0
"""The packages of the services, which nobody needs who does not use them."""

from __future__ import annotations

import importlib

from ..errors import MissingDependency


def require(package: str, *, purpose: str, extra: str) -> None:
    """Import `package`.

    Raises:
        MissingDependency: it is not installed.
    """
    try:
        importlib.import_module(package)
    except ModuleNotFoundError as error:
        # One that is installed and lacks something itself is another matter.
        if error.name != package:
            raise
        raise MissingDependency(
            package, purpose=purpose, install=f'pip install "mjrec[{extra}]"'
        ) from error
