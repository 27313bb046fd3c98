# SPDX-License-Identifier: Apache-2.0
"""`mjrec doctor`: check whether this machine can record, and explain what to fix."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from ..gl.choice import Probe
from ..gl.egl import EglDevice
from ..machine_report import Ffmpeg, MachineReport, Package, examine_machine
from .terminal import print_json

_INDENT = 2
# The column where values start.
_DEEPER = 14


@dataclasses.dataclass(frozen=True)
class _Row:
    """A name, its value, a remark after the value, and the lines below it."""

    name: str
    value: str
    remark: str = ""
    style: str = ""
    below: tuple[str, ...] = ()


def doctor(*, json: bool = False) -> int:
    """Check whether this machine can render, and explain what to do if it cannot.

    Renders a frame with each OpenGL backend, encodes a video with ffmpeg, and tries the
    simplest task of each package, in separate processes. The exit status is 0 if a
    recording would get frames, otherwise 1.

    Args:
        json: print one JSON object instead of text.
    """
    waiting = Console(stderr=True)
    with waiting.status("Testing OpenGL, ffmpeg and the packages ..."):
        report = examine_machine()
    if json:
        print_json(dataclasses.asdict(report))
    else:
        show_report(report, Console(highlight=False))
    return 0 if report.can_render else 1


def show_report(report: MachineReport, console: Console) -> None:
    """Print `report` in human-readable form."""
    sections = {
        "OpenGL": [*map(_probe, report.backends), *_choice(report)],
        "ffmpeg": [_ffmpeg(report.ffmpeg)],
        "Packages": [
            _Row("python", report.python, report.platform),
            *map(_package, report.packages),
        ],
        "Extras and engines": [*map(_extra, report.extras)],
        "Machine": [*_machine(report)],
    }
    for heading, rows in sections.items():
        console.print(Text(heading, style="bold"))
        for row in rows:
            _print(console, row)


def _probe(probe: Probe) -> _Row:
    if not probe.renders:
        # Not in red: one working backend is enough.
        below = _advice(probe.cause, probe.fix)
        return _Row(probe.backend, "does not render", style="yellow", below=below)
    speed = probe.frames_per_second
    rate = "" if speed is None else f"{speed:.3g} frames per second, 480x480"
    renderer = f"{probe.gl_renderer}{', on the CPU' * probe.software}"
    facts = (renderer, f"OpenGL {probe.gl_version}") if probe.gl_renderer else ()
    below = (*facts, *map(_device, probe.devices))
    return _Row(probe.backend, "renders", rate, "green", below)


def _device(device: EglDevice) -> str:
    facts = [
        "the CPU" if device.software else "",
        device.device_file,
        "" if device.cuda_id is None else f"CUDA device {device.cuda_id}",
        "used" if device.in_use else "",
    ]
    return f"EGL device {device.index}: {', '.join(filter(None, facts))}"


def _choice(report: MachineReport) -> Iterator[_Row]:
    if report.backend:
        yield _Row("mjrec", f"uses {report.backend}", f"({report.reason})", "green")
    else:
        # The other lines repeat what is printed above.
        reason = report.reason.partition("\n")[0]
        yield _Row("mjrec", "cannot render", style="red", below=(reason,))
    for problem in report.problems:
        yield _Row("note", problem.cause, below=(problem.fix,))


def _ffmpeg(ffmpeg: Ffmpeg) -> _Row:
    path = (f"  {ffmpeg.path}",) if ffmpeg.path else ()
    if ffmpeg.encodes:
        below = (ffmpeg.version.partition(" Copyright")[0], *path)
        return _Row("libx264", "encodes", style="green", below=below)
    below = (*_advice(ffmpeg.cause, ffmpeg.fix), *path)
    return _Row("libx264", "does not encode", style="red", below=below)


def _package(package: Package) -> _Row:
    if package.version is None:
        fix = (package.fix,)
        return _Row(package.name, "not installed", style="yellow", below=fix)
    if package.works is False:
        below = _advice(package.cause, package.fix)
        return _Row(package.name, package.version, "does not work", "red", below)
    return _Row(package.name, package.version)


def _extra(extra: Package) -> _Row:
    if extra.version is not None:
        return _Row(extra.name, extra.version)
    return _Row(extra.name, "not found", style="yellow", below=(f"  {extra.fix}",))


def _machine(report: MachineReport) -> Iterator[_Row]:
    cpus = report.cpus
    quota = "no quota" if cpus.quota is None else f"a quota of {cpus.quota:g}"
    remark = f"usable ({cpus.allowed} of {cpus.present} allowed, {quota})"
    yield _Row("CPUs", str(cpus.usable), remark)
    files = ", ".join(report.gpu_device_files)
    yield _Row("GPUs", files or "none", "" if files else "(no device file in /dev)")


def _advice(cause: str, fix: str) -> tuple[str, ...]:
    return (f"Cause: {cause}", f"Fix: {fix}") if fix else (f"Cause: {cause}",)


def _print(console: Console, row: _Row) -> None:
    """Print a row, wrapped within the value column, except for lines with commands.

    Commands stay on one line so that they can be copied from the terminal.
    """
    grid = Table.grid(padding=0)
    grid.add_column(width=_DEEPER - _INDENT, no_wrap=True)
    grid.add_column()
    text = Text(row.value, style=row.style)
    text.append(f" {row.remark}" if row.remark else "", style="default")
    grid.add_row(row.name, text)
    console.print(Padding(grid, (0, 0, 0, _INDENT), expand=False))
    for line in "\n".join(row.below).splitlines():
        if line.startswith("  "):
            command = Text(" " * _INDENT * 2 + line.strip(), style="cyan")
            console.print(command, soft_wrap=True)
        else:
            console.print(Padding(Text(line), (0, 0, 0, _DEEPER), expand=False))
