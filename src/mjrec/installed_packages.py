# SPDX-License-Identifier: Apache-2.0
"""The packages that this process can import, and which builds of them they are.

Reading the files of a hundred packages keeps Python busy for a fifth of a second. On a
thread of a process that simulates this costs more than its share: whenever a step lets
go of the interpreter's lock, the thread keeps it for five milliseconds, and a
simulation stands still until all is read (200 steps of HalfCheetah in a tenth of a
second instead of 1600). So a process of its own reads them.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import logging
import os
import subprocess
import sys
from collections.abc import Sequence

from .child_python import environment_of_child, python_command, take_standard_output

logger = logging.getLogger(__name__)

# By the names of the packages: `version`, and `record_sha256` as below.
Packages = dict[str, dict[str, str | None]]

# What an installer adds to the files of a wheel, or changes.
_OF_INSTALLATION = ("INSTALLER", "REQUESTED", "RECORD", "direct_url.json")
_TIMEOUT_S = 60.0


def installed_packages() -> Packages:
    """Return what is installed where this process looks for modules.

    Waits for a process that finds it out, without keeping other threads from running.

    Returns:
        By the names of the packages, in their order, `version` and `record_sha256`:
        the sha256 of what the wheel's own list of its files says, None without one.
    """
    places = [entry for entry in sys.path if isinstance(entry, str)]
    if not sys.executable or getattr(sys, "frozen", False):
        # There is no Python to start: it is part of another program.
        return _packages_in(places)
    try:
        finished = subprocess.run(
            python_command(__name__),
            input=json.dumps(places).encode(),
            env=environment_of_child(os.environ),
            capture_output=True,
            timeout=_TIMEOUT_S,
            check=True,
        )
        found: Packages = json.loads(finished.stdout)
        if not isinstance(found, dict):
            raise ValueError("it said something else")
    except (OSError, RuntimeError, subprocess.SubprocessError, ValueError) as error:
        logger.debug("Packages are looked for in this process: %s", error)
        return _packages_in(places)
    return found


def _packages_in(places: Sequence[str]) -> Packages:
    found: Packages = {}
    for distribution in importlib.metadata.distributions(path=list(places)):
        # Parsed at each access.
        metadata = distribution.metadata
        name = metadata["Name"]
        # The first on the path is the one that is imported.
        if name and name not in found:
            found[name] = {
                "version": metadata["Version"],
                "record_sha256": _record_sha256(distribution),
            }
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))


def _record_sha256(distribution: importlib.metadata.Distribution) -> str | None:
    """Return the sha256 of the sorted lines of what a wheel says it consists of.

    Lines of what an installer adds, such as compiled Python, are left out, so that two
    installations of one wheel have the same.
    """
    text = distribution.read_text("RECORD")
    if not text:
        return None
    lines = (line.strip() for line in text.splitlines())
    own = sorted(line for line in lines if line and not _is_of_installation(line))
    return hashlib.sha256("\n".join(own).encode()).hexdigest()


def _is_of_installation(line: str) -> bool:
    path = line.rsplit(",", 2)[0].strip('"')
    is_outside = path.startswith(("..", "/"))
    return (
        is_outside
        or path.endswith(".pyc")
        or path.rpartition("/")[2] in _OF_INSTALLATION
    )


def _main() -> None:
    descriptor = take_standard_output()
    packages = _packages_in(json.load(sys.stdin))
    with os.fdopen(descriptor, "w") as output:
        json.dump(packages, output)


if __name__ == "__main__":
    _main()
