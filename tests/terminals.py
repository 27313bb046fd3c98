# SPDX-License-Identifier: Apache-2.0
"""Commands on a terminal, for tests."""

import contextlib
import os
import pty
import signal
import subprocess


def on_terminal(command, *, stop_at=None):
    """Run a command on a terminal; return its exit status and what it showed.

    Args:
        command: with its arguments.
        stop_at: what it shows before it gets Ctrl-C.
    """
    reader, terminal = pty.openpty()
    environ = {**os.environ, "COLUMNS": "100", "TERM": "xterm"}
    with subprocess.Popen(
        command, stdout=terminal, stderr=terminal, env=environ
    ) as process:
        os.close(terminal)
        shown = b""
        # Linux's way to say that the other end is closed.
        with contextlib.suppress(OSError):
            while block := os.read(reader, 1 << 16):
                shown += block
                if stop_at is not None and stop_at.encode() in shown:
                    process.send_signal(signal.SIGINT)
                    stop_at = None
        os.close(reader)
    return process.returncode, shown.decode()
