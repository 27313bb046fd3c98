# SPDX-License-Identifier: Apache-2.0
"""`mjrec doctor`: whether this machine can record, and what to do if not."""

from __future__ import annotations

import dataclasses

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from ..gl import EglDevice, Probe
from ..machine_report import Cpus, Ffmpeg, MachineReport, Package, examine_machine
from .terminal import print_json

_INDENT = 2
# Where values stand, right of names.
_DEEPER = 14


def doctor(*, json: bool = False) -> int:
    """Show whether this machine can record, and what to do if it cannot.

    Tries each OpenGL backend with a real picture, ffmpeg with a real video, and each
    package with its simplest task, all in processes of their own. The exit status is 0
    if a recording would get pictures, else 1.

    Args:
        json: print one JSON object instead.
    """
    waiting = Console(stderr=True)
    with waiting.status("Trying OpenGL, ffmpeg and the packages ..."):
        report = examine_machine()
    if json:
        print_json(dataclasses.asdict(report))
    else:
        show_report(report, Console(highlight=False))
    return 0 if report.can_render else 1


def show_report(report: MachineReport, console: Console) -> None:
    """Print `report` for people."""
    _heading(console, "OpenGL")
    for probe in report.backends:
        _show_probe(console, probe)
    _show_choice(console, report)
    _heading(console, "ffmpeg")
    _show_ffmpeg(console, report.ffmpeg)
    _heading(console, "Packages")
    _line(console, "python", report.python, report.platform)
    for package in report.packages:
        _show_package(console, package)
    _heading(console, "Extras and engines")
    for extra in report.extras:
        if extra.version is not None:
            _line(console, extra.name, extra.version)
        else:
            _line(console, extra.name, "not found", style="yellow")
            _whole_line(console, extra.fix)
    _heading(console, "Machine")
    _line(console, "CPUs", str(report.cpus.usable), _about_cpus(report.cpus))
    files = ", ".join(report.gpu_device_files)
    _line(console, "GPUs", files or "none", "" if files else "(no device file in /dev)")


def _show_probe(console: Console, probe: Probe) -> None:
    if not probe.renders:
        # In no alarming colour: one backend is enough.
        _line(console, probe.backend, "does not render", style="yellow")
        _explain(console, probe.cause, probe.fix)
        return
    speed = probe.frames_per_second
    rate = "" if speed is None else f"{speed:.3g} frames a second, 480x480"
    _line(console, probe.backend, "renders", rate, style="green")
    if probe.gl_renderer:
        _block(console, f"{probe.gl_renderer}{', on the CPU' * probe.software}")
        _block(console, f"OpenGL {probe.gl_version}")
    for device in probe.devices:
        _block(console, _about_device(device))


def _about_device(device: EglDevice) -> str:
    facts = [
        "the CPU" if device.software else "",
        device.device_file,
        "" if device.cuda_id is None else f"CUDA device {device.cuda_id}",
        "used" if device.in_use else "",
    ]
    return f"EGL device {device.index}: {', '.join(filter(None, facts))}"


def _show_choice(console: Console, report: MachineReport) -> None:
    if report.backend:
        remark = f"({report.reason})"
        _line(console, "mjrec", f"uses {report.backend}", remark, style="green")
    else:
        _line(console, "mjrec", "cannot render", style="red")
        # The rest says again what stands above.
        _block(console, report.reason.partition("\n")[0])
    for problem in report.problems:
        _line(console, "note", problem.cause)
        _block(console, problem.fix)


def _show_ffmpeg(console: Console, ffmpeg: Ffmpeg) -> None:
    if ffmpeg.encodes:
        _line(console, "libx264", "encodes", style="green")
        _block(console, ffmpeg.version.partition(" Copyright")[0])
    else:
        _line(console, "libx264", "does not encode", style="red")
        _explain(console, ffmpeg.cause, ffmpeg.fix)
    if ffmpeg.path:
        _whole_line(console, ffmpeg.path)


def _show_package(console: Console, package: Package) -> None:
    if package.version is None:
        _line(console, package.name, "not installed", style="yellow")
        _block(console, package.fix)
    elif package.works is False:
        _line(console, package.name, package.version, "does not work", style="red")
        _explain(console, package.cause, package.fix)
    else:
        _line(console, package.name, package.version)


def _about_cpus(cpus: Cpus) -> str:
    quota = "no quota" if cpus.quota is None else f"a quota of {cpus.quota:g}"
    return f"usable ({cpus.allowed} allowed of {cpus.present} present, {quota})"


def _heading(console: Console, text: str) -> None:
    console.print(Text(text, style="bold"))


def _line(
    console: Console, name: str, value: str, remark: str = "", *, style: str = ""
) -> None:
    """Print a name and its value, wrapped in the value's column."""
    row = Table.grid(padding=0)
    row.add_column(width=_DEEPER - _INDENT, no_wrap=True)
    row.add_column()
    text = Text(value, style=style)
    text.append(f" {remark}" if remark else "", style="default")
    row.add_row(name, text)
    console.print(Padding(row, (0, 0, 0, _INDENT), expand=False))


def _explain(console: Console, cause: str, fix: str) -> None:
    _block(console, f"Cause: {cause}")
    if fix:
        _block(console, f"Fix: {fix}")


def _block(console: Console, text: str) -> None:
    """Print lines in the column of values; those that are commands unwrapped."""
    for line in text.splitlines():
        if line.startswith("  "):
            _whole_line(console, line)
        else:
            console.print(Padding(Text(line), (0, 0, 0, _DEEPER), expand=False))


def _whole_line(console: Console, line: str) -> None:
    # Wrapped by the terminal, if at all: what is copied from it stays one line.
    indent = " " * (_DEEPER if not line.startswith(" ") else _INDENT * 2)
    console.print(Text(indent + line.strip(), style="cyan"), soft_wrap=True)
