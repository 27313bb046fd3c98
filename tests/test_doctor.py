# SPDX-License-Identifier: Apache-2.0
"""Test the text, JSON and exit status of `mjrec doctor`."""

import dataclasses
import importlib.metadata
import io
import json
import os
import platform
import subprocess
import sys

import pytest
from rich.console import Console

from mjrec.commands.doctor import show_report
from mjrec.gl.backends import Diagnosis
from mjrec.gl.choice import Probe
from mjrec.gl.egl import EglDevice
from mjrec.machine_report import (
    Cpus,
    Ffmpeg,
    MachineReport,
    Package,
    examine_ffmpeg,
    examine_package,
)

_PATH = "/opt/" + "a-long-path/" * 8 + "ffmpeg"
_RAY = 'python -m pip install "mjrec[ray]"'
_APT = "apt-get install -y libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0"


def run_doctor(*arguments, **variables):
    unset = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY", "COLUMNS")
    environ = {k: v for k, v in os.environ.items() if k not in unset}
    return subprocess.run(
        [sys.executable, "-P", "-m", "mjrec", "doctor", *arguments],
        env={**environ, **variables},
        capture_output=True,
        text=True,
    )


# Takes more than five seconds: each backend renders in its own process.
def test_json_describes_a_machine_that_renders():
    healthy = run_doctor("--json")
    assert healthy.returncode == 0, healthy.stderr
    facts = json.loads(healthy.stdout)
    assert (facts["can_render"], facts["backend"]) == (True, "egl")
    assert facts["reason"] == "the first that works"
    [note] = facts["problems"]
    assert "MUJOCO_GL is not set" in note["cause"]
    assert "export MUJOCO_GL=egl" in note["fix"]
    egl, osmesa, glfw = facts["backends"]
    names = [backend["backend"] for backend in (egl, osmesa, glfw)]
    assert names == ["egl", "osmesa", "glfw"]
    assert egl["frames_per_second"] > 0
    assert egl["gl_renderer"]
    assert "DISPLAY is not set" in glfw["cause"]
    assert glfw["fix"]
    assert facts["ffmpeg"]["encodes"] is True
    assert facts["ffmpeg"]["version"].startswith("ffmpeg version")
    assert facts["python"] == platform.python_version()
    packages = {package["name"]: package for package in facts["packages"]}
    assert packages["mujoco"]["version"] == importlib.metadata.version("mujoco")
    assert packages["gymnasium"]["works"] is True, packages["gymnasium"]
    extras = {extra["name"]: extra for extra in facts["extras"]}
    assert extras["SciPy"]["version"] == importlib.metadata.version("scipy")
    assert {"Slurm", "Ray", "submitit", "Dask", "report", "GPU"} < extras.keys()
    # Scripts read these keys, so new ones may be added but none renamed.
    assert list(facts) == [
        *("can_render", "backend", "reason", "backends", "problems"),
        *("gpu_device_files", "ffmpeg", "packages", "extras", "cpus"),
        *("python", "platform"),
    ]
    assert list(egl) == [
        *("backend", "renders", "gl_renderer", "gl_vendor", "gl_version"),
        *("frames_per_second", "devices", "cause", "fix", "output"),
    ]
    assert list(packages["mujoco"]) == ["name", "version", "works", "cause", "fix"]
    assert list(facts["ffmpeg"]) == ["path", "version", "encodes", "cause", "fix"]
    assert list(facts["cpus"]) == ["usable", "present", "allowed", "quota"]


@pytest.mark.thorough
def test_status_is_1_where_rendering_is_off():
    done = run_doctor(MUJOCO_GL="off")
    assert done.returncode == 1
    assert "cannot render" in done.stdout
    assert "turns rendering" in done.stdout
    assert "export MUJOCO_GL=egl" in done.stdout
    assert "Traceback" not in done.stderr


LLVMPIPE = EglDevice(0, "/dev/dri/renderD128", 3, True, True)
MESA = {"gl_renderer": "llvmpipe (LLVM 15.0.6)", "gl_version": "4.5 Mesa [22.3.6]"}
# This report has at least one entry of every kind.
REPORT = MachineReport(
    can_render=True,
    backend="egl",
    reason="the first that works",
    backends=(
        Probe("egl", True, frames_per_second=12.345, devices=(LLVMPIPE,), **MESA),
        Probe("osmesa", False, cause="[bold]It[/bold] is gone.", fix=f"Do:\n  {_APT}"),
    ),
    problems=(Diagnosis("Something is odd.", "Do:\n  export X=1"),),
    gpu_device_files=("/dev/nvidia0",),
    ffmpeg=Ffmpeg(_PATH, "ffmpeg version 9 Copyright (c) 2000", encodes=True),
    packages=(
        Package("dm_control", None, fix="To install it:\n  pip install x"),
        Package("mujoco", "9", works=False, cause="It is too new.", fix="Wait."),
    ),
    extras=(Package("SciPy", "1.14"), Package("Ray", None, fix=_RAY)),
    cpus=Cpus(usable=2, present=64, allowed=4, quota=2.5),
    python="3.11.7",
    platform="Linux",
)


def shown(report):
    console = Console(width=80, file=io.StringIO(), highlight=False)
    show_report(report, console)
    return console.file.getvalue()


def test_text_has_each_fact_once_and_whole_commands():
    """Brackets in the text are not treated as markup."""
    text = shown(REPORT)
    lines = [line.rstrip() for line in text.splitlines()]
    assert f"    {_APT}" in lines
    assert [line for line in lines if len(line) > 80 and _PATH not in line] == []
    reason = "Nothing renders.\negl: why"
    none = dataclasses.replace(REPORT, backend=None, reason=reason)
    assert "egl: why" not in shown(none)
    for words in (
        "12.3 frames per second",
        "llvmpipe (LLVM 15.0.6), on the CPU",
        "4.5 Mesa [22.3.6]",
        "EGL device 0: the CPU, /dev/dri/renderD128, CUDA device 3, used",
        "Cause: [bold]It[/bold] is gone.",
        "uses egl (the first that works)",
        "Something is odd.",
        "not installed",
        "Cause: It is too new.",
        "2 usable (4 of 64 allowed, a quota of 2.5)",
        "/dev/nvidia0",
        "SciPy       1.14",
        _RAY,
    ):
        assert words in text


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        ("libx264", "Unknown encoder 'libx264'"),
        # The check uses the encoder options of recordings, not only H.264.
        ("cpu-independent=1", "Error parsing option cpu-independent"),
    ],
)
def test_unusable_ffmpeg_has_cause_and_fix(refused, message, tmp_path, monkeypatch):
    good = examine_ffmpeg()
    assert good.encodes
    fake = tmp_path / "ffmpeg"
    fake.write_text(
        f'#!/bin/sh\nfor argument do\n  [ "$argument" = {refused} ] && '
        f'{{ echo "{message}" >&2; exit 8; }}\ndone\nexec {good.path} "$@"\n'
    )
    fake.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(fake))
    found = examine_ffmpeg()
    assert (found.version, found.encodes, found.cause) == (good.version, False, message)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    found = examine_ffmpeg()
    assert (found.path, found.encodes) == ("/bin/false", False)
    assert found.cause
    assert "IMAGEIO_FFMPEG_EXE" in found.fix


@pytest.mark.parametrize(
    ("program", "cause", "fix"),
    [
        (
            "raise AttributeError(\"'MjModel' has no attribute 'flex_vertedge'\")",
            "does not support MuJoCo 4",
            'pip install "mujoco<4"',
        ),
        ("raise ValueError('of its own')", "ValueError: of its own", "pip install y"),
        ("import ctypes; ctypes.string_at(0)", "status -11", "pip install y"),
    ],
)
def test_failing_package_has_a_cause_and_a_fix(program, cause, fix):
    """Cause and fix are given even if importing the package crashes."""
    lacking = examine_package("mjrec-there-is-no-such", "import nothing", "pip get x")
    assert (lacking.version, lacking.works) == (None, None)
    assert "pip get x" in lacking.fix
    found = examine_package("numpy", program, "pip install y")
    assert found.works is False
    assert cause in found.cause
    assert fix in found.fix
