# SPDX-License-Identifier: Apache-2.0
"""A check of everything that recording needs on a machine."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from .errors import EncoderError, Error
from .formats.encoder_settings import MUXERS, encoder_settings, try_encoding
from .formats.ffmpeg import ffmpeg_executable, ffmpeg_version
from .gl.backends import BACKENDS, Diagnosis, diagnose, platforms_contradict
from .gl.choice import Probe, choose, probe
from .machine import cgroup_cpu_quota, gpu_device_files, usable_cpus

# Each entry: a distribution, a program that uses it as a recording does but without
# rendering, and the command that installs it.
_PACKAGES = (
    ("mjrec", "", ""),
    ("mujoco", "import mujoco", "python -m pip install mujoco"),
    (
        "gymnasium",
        "import gymnasium; gymnasium.make('InvertedPendulum-v5').reset()",
        "python -m pip install gymnasium",
    ),
    (
        "dm_control",
        # Importing is not enough: dm_control 1.0.50 fails at the first task if MuJoCo
        # is too new for it.
        "from dm_control import suite; suite.load('pendulum', 'swingup').reset()",
        'python -m pip install "mjrec[dm-control]"',
    ),
    ("numpy", "", ""),
)
# Optional packages and engines. Each entry: a name, its distributions, and the
# requirement that installs them.
_EXTRAS = (
    ("SciPy", ("scipy",), "mjrec"),
    ("report", ("jinja2", "pillow"), "mjrec[report]"),
    ("evidence", ("jinja2", "packaging"), "mjrec[evidence]"),
    ("robotics", ("gymnasium-robotics",), "mjrec[robotics]"),
    ("TensorBoard", ("tensorboard",), "mjrec[tensorboard]"),
    ("W&B", ("wandb",), "mjrec[wandb]"),
    ("Ray", ("ray",), "mjrec[ray]"),
    ("submitit", ("submitit",), "mjrec[slurm]"),
    ("Dask", ("dask", "distributed"), "dask[distributed]"),
)
_PROGRAM_TIMEOUT = 120
_COMMAND_TIMEOUT = 10
_NVIDIA_VERSION = Path("/proc/driver/nvidia/version")
_TRIAL_FPS = Fraction(50)


@dataclass(frozen=True)
class Package:
    """A Python package.

    Attributes:
        name: the package's name.
        version: its version; None if it is not installed.
        works: whether a minimal program that uses it succeeds; None if not tried.
        cause: why it does not work.
        fix: instructions for fixing or installing it.
    """

    name: str
    version: str | None
    works: bool | None = None
    cause: str = ""
    fix: str = ""


@dataclass(frozen=True)
class Ffmpeg:
    """The ffmpeg that encodes videos.

    Attributes:
        path: path of the executable; None if it was not found.
        version: the first line of its version output.
        encodes: whether it encoded a test frame as H.264.
        cause: why it failed.
        fix: instructions for fixing it.
    """

    path: str | None
    version: str = ""
    encodes: bool = False
    cause: str = ""
    fix: str = ""


@dataclass(frozen=True)
class Cpus:
    """The CPUs of the machine and of this process.

    Attributes:
        usable: number of CPUs that this process can keep busy.
        present: number of CPUs in the machine; None if unknown.
        allowed: number of CPUs that the process may run on (its affinity).
        quota: number of CPUs that the cgroup allows; None if unlimited.
    """

    usable: int
    present: int | None
    allowed: int
    quota: float | None


@dataclass(frozen=True)
class MachineReport:
    """The results of `mjrec doctor`.

    Attributes:
        can_render: whether recordings can be rendered now.
        backend: the backend that `use_gl` would choose; None if it would raise.
        reason: why this backend was chosen, or the error's message.
        backends: the result of each backend's test.
        problems: questionable settings that do not prevent rendering.
        gpu_device_files: device files of the GPUs.
        ffmpeg: the encoder.
        packages: Python packages that recording uses.
        extras: optional packages, engines, and the GPU's driver.
        cpus: the CPUs of the machine and of this process.
        python: the interpreter's version.
        platform: the operating system and processor.
    """

    can_render: bool
    backend: str | None
    reason: str
    backends: tuple[Probe, ...]
    problems: tuple[Diagnosis, ...]
    gpu_device_files: tuple[str, ...]
    ffmpeg: Ffmpeg
    packages: tuple[Package, ...]
    extras: tuple[Package, ...]
    cpus: Cpus
    python: str
    platform: str


def examine_machine() -> MachineReport:
    """Test everything that recording needs, which takes a few seconds.

    The tests run in other processes, so nothing is imported or changed in this one.
    """
    probes = {backend: probe(backend, measure=True) for backend in BACKENDS}
    chosen = None
    try:
        choice = choose()
        chosen, reason = choice.backend, choice.reason
    except Error as error:
        reason = str(error)
    return MachineReport(
        can_render=chosen is not None,
        backend=chosen,
        reason=reason,
        backends=tuple(probes.values()),
        problems=tuple(_problems(chosen, probes)),
        gpu_device_files=tuple(gpu_device_files()),
        ffmpeg=examine_ffmpeg(),
        packages=tuple(examine_package(*package) for package in _PACKAGES),
        extras=(*(_examine_extra(*extra) for extra in _EXTRAS), _slurm(), _gpu()),
        cpus=Cpus(
            usable=usable_cpus(),
            present=os.cpu_count(),
            allowed=len(os.sched_getaffinity(0)),
            quota=cgroup_cpu_quota(),
        ),
        python=platform.python_version(),
        platform=platform.platform(),
    )


def _problems(chosen: str | None, probes: dict[str, Probe]) -> Iterator[Diagnosis]:
    named = os.environ.get("MUJOCO_GL", "")
    if chosen is None:
        for other in [name for name, tried in probes.items() if tried.renders][:1]:
            yield Diagnosis(
                f"MUJOCO_GL={named} keeps mjrec from using {other}, which works here.",
                f"Use {other}:\n  export MUJOCO_GL={other}",
            )
        return
    # Settings that mjrec corrects for itself, but that other programs do not correct.
    if platforms_contradict(os.environ, chosen):
        yield Diagnosis(
            f"PYOPENGL_PLATFORM={os.environ['PYOPENGL_PLATFORM']} contradicts "
            f"{chosen}. mjrec corrects this for itself; in other programs, mujoco "
            "will not be able to render.",
            "Remove the variable:\n  unset PYOPENGL_PLATFORM",
        )
    if named not in ("", chosen):
        yield Diagnosis(
            f"MUJOCO_GL={named} is not a backend name that Gymnasium and dm_control "
            "know. mjrec corrects this for itself; other programs may fail.",
            f"Use their spelling:\n  export MUJOCO_GL={chosen}",
        )
    if not named and not probes["glfw"].renders:
        yield Diagnosis(
            "MUJOCO_GL is not set. mjrec works without it, but other programs then "
            "choose GLFW, which does not work here.",
            f"For other programs:\n  export MUJOCO_GL={chosen}",
        )
    if probes[chosen].warning():
        yield Diagnosis(probes[chosen].warning(), "")


def examine_ffmpeg() -> Ffmpeg:
    """Find ffmpeg and encode a test frame as a recording does."""
    path, version = None, ""
    try:
        path = ffmpeg_executable()
        version = ffmpeg_version()
        settings = encoder_settings(codec=None, crf=None, muxer=MUXERS[".mp4"])
        try_encoding(settings, _TRIAL_FPS)
    except Error as error:
        output = error.stderr.split("\n") if isinstance(error, EncoderError) else []
        cause = next(filter(None, map(str.strip, reversed(output))), str(error))
        fix = (
            "Install the ffmpeg that comes with imageio-ffmpeg, or specify another:\n"
            "  python -m pip install --force-reinstall imageio-ffmpeg\n"
            "  export IMAGEIO_FFMPEG_EXE=/path/to/ffmpeg"
        )
        return Ffmpeg(path, version, cause=cause, fix=fix)
    return Ffmpeg(path, version, encodes=True)


def examine_package(name: str, program: str, install: str) -> Package:
    """Look up a package and test it.

    Args:
        name: the distribution's name.
        program: Python code that uses the package, run in a separate process without
            OpenGL. If empty, only the version is looked up.
        install: the command that installs the package.
    """
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return Package(name, None, fix=f"To install it:\n  {install}")
    if not program:
        return Package(name, version)
    try:
        done = _run(sys.executable, "-P", "-c", program, timeout=_PROGRAM_TIMEOUT)
    except subprocess.TimeoutExpired:
        failure = f"It did not finish within {_PROGRAM_TIMEOUT} seconds."
    else:
        if done.returncode == 0:
            return Package(name, version, works=True)
        failure = done.stderr.strip() or f"It exited with status {done.returncode}."
    known = diagnose(failure, environ=_WITHOUT_GL)
    found = known or Diagnosis(failure.splitlines()[-1], f"Reinstall it:\n  {install}")
    return Package(name, version, works=False, cause=found.cause, fix=found.fix)


def _examine_extra(name: str, distributions: Sequence[str], install: str) -> Package:
    try:
        versions = [importlib.metadata.version(each) for each in distributions]
    except importlib.metadata.PackageNotFoundError:
        return Package(name, None, fix=f'python -m pip install "{install}"')
    if len(versions) == 1:
        return Package(name, versions[0])
    both = zip(distributions, versions, strict=True)
    return Package(name, ", ".join(f"{each} {version}" for each, version in both))


def _slurm() -> Package:
    try:
        done = _run("sbatch", "--version", timeout=_COMMAND_TIMEOUT)
        done.check_returncode()
    except (OSError, subprocess.SubprocessError):
        fix = "Submit jobs from a login node of the cluster, where sbatch is installed."
        return Package("Slurm", None, fix=fix)
    return Package("Slurm", done.stdout.strip())


def _gpu() -> Package:
    try:
        output = _NVIDIA_VERSION.read_text(errors="replace")
    except OSError:
        if gpu_device_files():
            return Package("GPU", "found, but without NVIDIA's driver")
        fix = "There is no GPU device file in /dev, so videos are rendered on the CPU."
        return Package("GPU", None, fix=fix)
    return Package("GPU", output.partition("\n")[0].strip())


# OpenGL is off because only the package itself is tested, not rendering.
_WITHOUT_GL = {"MUJOCO_GL": "off"}


def _run(*command: str, timeout: float) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        env={**os.environ, **_WITHOUT_GL},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        timeout=timeout,
        check=False,
    )
