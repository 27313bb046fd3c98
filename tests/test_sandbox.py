# SPDX-License-Identifier: Apache-2.0
"""Test how a sandboxed process reports its end."""

import contextlib
import os
import select
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

from processes import children
from waiting import wait_until

from mjrec.sandbox import Sandbox

_COMPILER = "mjrec.simulation.foreign_files"
_ENDLESS = (
    '<mujoco><worldbody><replicate count="100000000"><geom size="1"/></replicate>'
    "</worldbody></mujoco>"
)


def compiling(parent):
    """Return the compiler's process, ignoring others that importing mujoco starts."""
    return [pid for pid in children(parent) if f"-m\0{_COMPILER}" in command_of(pid)]


def command_of(pid):
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text()
    return ""


def test_death_is_reported_with_status_and_traceback(tmp_path):
    """An invalid request makes the process fail."""
    with Sandbox(_COMPILER, {}, place=tmp_path) as sandbox:
        assert list(sandbox.answers(60)) == []
        report = sandbox.last_words()
    assert report.startswith("ended with status 1")
    assert "KeyError: 'task'" in report


def test_busy_process_ends_with_its_parent(tmp_path):
    path = tmp_path / "openaigym.model.0123456789abcdef.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("contents.json", '{"format": 1, "main": "main.xml"}')
        archive.writestr("source/main.xml", _ENDLESS)
    program = (
        "from pathlib import Path\n"
        "from mjrec.simulation.foreign_files import compile_sources\n"
        f"compile_sources(Path({str(path)!r}), compiled_size=1)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program]) as parent:
        wait_until(lambda: bool(compiling(parent.pid)))
        [number] = compiling(parent.pid)
        busy = Path(f"/proc/{number}/stat")
        ticks = os.sysconf("SC_CLK_TCK")
        child = os.pidfd_open(number)
        try:
            wait_until(lambda: int(busy.read_text().split()[13]) > ticks, seconds=120)
        finally:
            parent.send_signal(signal.SIGKILL)
    ended, _, _ = select.select([child], [], [], 30)
    os.close(child)
    assert ended
