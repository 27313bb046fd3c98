# SPDX-License-Identifier: Apache-2.0
"""A process without access to the network, the home folder or other files.

`python -m mjrec.confined MODULE` runs a module in such a process. The process confines
itself before it imports the module, because confining a thread does not confine threads
that already exist. An unprivileged Linux process can use:

- Landlock (Linux 5.13): only Python, the system and the given paths can be read, and
  only given paths can be written to. Since Linux 6.7, TCP is blocked too.
- An empty network namespace, if the system lets users create one.

If the kernel supports neither, the only protection is the sandbox's limits, an empty
home folder and a short list of environment variables.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import runpy
import struct
import sys
from collections.abc import Iterable
from pathlib import Path

VARIABLE = "MJREC_CONFINED"

_SYSTEM = (
    *("/usr", "/lib", "/lib64", "/bin", "/sbin", "/etc", "/proc", "/sys", "/opt"),
    # On some systems, drivers and their lists are in these folders.
    *("/nix", "/run/opengl-driver", "/var/lib"),
)
_CLONE_NEWUSER, _CLONE_NEWNET = 0x1000_0000, 0x4000_0000
_NO_NEW_PRIVILEGES = 38

# These system calls have the same numbers on all current architectures.
_CREATE, _ADD, _RESTRICT = 444, 445, 446
_PATH_BENEATH = 1
_READ = 0b1101  # execute, read a file, read a folder
# Number of Landlock's file access rights, by Landlock version.
_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
_NO_TCP = 0b11
_SCOPES = 0b11  # abstract sockets and signals
# Landlock version 4 added TCP, and version 6 added the scopes.
_WITH_TCP, _WITH_SCOPES = 4, 6

_libc = ctypes.CDLL(None, use_errno=True)


def confine(
    readable: Iterable[str], writable: Iterable[str], hidden: Iterable[str] = ()
) -> None:
    """Permanently confine this process and its children, as far as the kernel can.

    Args:
        readable: files and folders that may be read, in addition to Python's and the
            system's.
        writable: folders that may be written to.
        hidden: folders that modules must not be imported from, such as the folder of
            the caller's script.
    """
    _leave_network()
    version = _libc.syscall(_CREATE, None, ctypes.c_size_t(0), 1)
    if version < 1:
        return
    files = (1 << _RIGHTS.get(version, 16)) - 1
    rules = [files]
    # Older kernels expect a shorter structure.
    if version >= _WITH_TCP:
        rules.append(_NO_TCP)
    if version >= _WITH_SCOPES:
        rules.append(_SCOPES)
    packed = struct.pack(f"={len(rules)}Q", *rules)
    ruleset = _libc.syscall(_CREATE, packed, ctypes.c_size_t(len(packed)), 0)
    if ruleset < 0:
        return
    python = {sys.prefix, sys.base_prefix, *filter(None, sys.path)}
    for path in {*_SYSTEM, *python, *readable} - {*hidden}:
        _allow(ruleset, path, _READ)
    for path in {"/dev", *writable}:
        _allow(ruleset, path, files)
    _libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    _libc.syscall(_RESTRICT, ruleset, 0)
    os.close(ruleset)


def _leave_network() -> None:
    user, group = os.getuid(), os.getgid()
    # An unprivileged process may have this right inside its own user namespace.
    if _libc.unshare(_CLONE_NEWNET) == 0:
        return
    if _libc.unshare(_CLONE_NEWUSER | _CLONE_NEWNET) != 0:
        return
    with contextlib.suppress(OSError):
        for name, text in (
            ("setgroups", "deny"),
            ("uid_map", f"{user} {user} 1"),
            ("gid_map", f"{group} {group} 1"),
        ):
            Path("/proc/self", name).write_text(text)


def _allow(ruleset: int, path: str, rights: int) -> None:
    try:
        parent = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    if not Path(path).is_dir():
        # The kernel rejects folder rights for a file.
        rights &= 0b101 | 1 << 1 | 1 << 14 | 1 << 15
    rule = struct.pack("=Qi", rights, parent)
    _libc.syscall(_ADD, ruleset, _PATH_BENEATH, rule, 0)
    os.close(parent)


def main() -> None:
    """Confine this process as its environment variable requests, and run the module."""
    confine(**json.loads(os.environ.pop(VARIABLE)))
    module = sys.argv.pop(1)
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
