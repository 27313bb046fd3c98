# SPDX-License-Identifier: Apache-2.0
"""Test that a probe in a child process explains each known OpenGL failure."""

import json
import os
import subprocess
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from other_python import run_python, without_gl

from mjrec.gl import choice
from mjrec.gl.choice import Probe, probe, probe_environment
from mjrec.simulation import gl_probe

_VENDOR_FILES = "__EGL_VENDOR_LIBRARY_FILENAMES"
_EGL_PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0"


def probe_with(backend, **variables):
    """Probe with only these OpenGL variables."""
    return probe_environment(without_gl(MUJOCO_GL=backend, **variables))


def test_egl_renders_and_reports_driver_speed_and_devices(monkeypatch):
    answer = probe("egl", measure=True)
    assert answer.renders, f"{answer.cause}\n{answer.fix}\n{answer.output}"
    assert answer.gl_renderer
    assert answer.gl_vendor
    assert answer.gl_version[0].isdigit()
    assert answer.frames_per_second > 0
    assert [device.index for device in answer.devices] == [*range(len(answer.devices))]
    assert sum(device.in_use for device in answer.devices) == 1
    # The answer is remembered until a variable changes.
    assert probe("egl") is probe("egl", measure=True) is answer
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "99")
    assert not probe("egl").renders


@pytest.mark.parametrize(
    ("backend", "variables", "cause", "fix"),
    [
        ("glfw", {"DISPLAY": ":77"}, "cannot open :77", "MUJOCO_GL to egl"),
        ("off", {}, "MUJOCO_GL=off turns rendering off", "Unset MUJOCO_GL"),
        (
            *("egl", {"MUJOCO_EGL_DEVICE_ID": "99"}),
            *("MUJOCO_EGL_DEVICE_ID=99, but EGL sees", "Set MUJOCO_EGL_DEVICE_ID to"),
        ),
        (
            *("egl", {_VENDOR_FILES: "/nonexistent"}),
            *(f"only in {_VENDOR_FILES} (/nonexistent)", f"unset {_VENDOR_FILES}"),
        ),
    ],
)
def test_variables_that_prevent_rendering_are_named(backend, variables, cause, fix):
    answer = probe_with(backend, **variables)
    assert not answer.renders
    assert cause in answer.cause
    assert fix in answer.fix


def test_driver_that_draws_nothing_fails():
    usual = probe("egl")
    if not usual.software:
        pytest.skip(f"only Mesa can be told to draw nothing, not {usual.gl_renderer}")
    answer = probe_with("egl", GALLIUM_NOOP="1")
    assert not answer.renders
    assert "The driver renders incorrect frames." in answer.cause


DEAF = "import signal; signal.pthread_sigmask(0, range(1, 64)); signal.pause()"


@pytest.mark.parametrize(
    ("code", "timeout", "cause"),
    [
        ("import ctypes; ctypes.string_at(0)", 120, "The driver crashed (SIGSEGV)"),
        # The message of an unknown error is shown unchanged.
        ("raise SystemExit('the moon is in another quarter')", 120, "the moon is in"),
        (DEAF, 0.2, "The driver hangs"),
    ],
)
def test_end_of_the_child_is_explained(tmp_path, code, timeout, cause, monkeypatch):
    """A child that hangs and ignores signals is killed."""
    (tmp_path / "sitecustomize.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    answer = probe_environment({**os.environ, "MUJOCO_GL": "egl"}, timeout=timeout)
    assert cause in answer.cause


def test_software_rendering_despite_a_gpu_is_a_warning(tmp_path, monkeypatch):
    software = Probe("egl", renders=True, gl_renderer="llvmpipe (LLVM 15)")
    hardware = Probe("egl", renders=True, gl_renderer="NVIDIA H200/PCIe/SSE2")
    assert (software.software, hardware.software) == (True, False)
    monkeypatch.setattr(choice, "gpu_device_files", list)
    assert software.warning() == ""
    device = tmp_path / "nvidia0"
    device.touch()
    monkeypatch.setattr(choice, "gpu_device_files", lambda: [str(device)])
    warning = software.warning()
    assert "llvmpipe (LLVM 15)" in warning
    assert str(device) in warning
    assert hardware.warning() == ""


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (np.zeros_like, r"Every pixel of the frame is \(0, 0, 0\)"),
        (lambda p: p[:, ::-1], "red on the left"),
        (lambda p: np.random.default_rng(0).integers(0, 255, p.shape), "on the left"),
    ],
    ids=["black", "mirrored", "noise"],
)
def test_wrong_frames_are_failures(spoil, message):
    frame = np.full((480, 480, 3), 60, np.uint8)
    frame[250:350, 50:160] = (255, 0, 0)
    frame[250:350, 320:430] = (0, 0, 255)
    frame[125:210, 200:280] = (0, 255, 0)
    gl_probe.check_frame(frame)
    with pytest.raises(gl_probe.WrongFrame, match=message):
        gl_probe.check_frame(spoil(frame))


# In a mount namespace, this directory is replaced by links to all other libraries.
_LIBRARIES = Path("/usr/lib", sysconfig.get_config_var("MULTIARCH") or "nowhere")
_VENDORS = "/usr/share/glvnd/egl_vendor.d"
_HIDE = r"""
set -e
libraries=$1 place=$2 vendors=$3 hidden=$4 added=$5
shift 5
mkdir "$place/all" "$place/view" "$place/empty"
mount --rbind "$libraries" "$place/all"
cd "$place/view"
ln -s "$place"/all/* .
rm -f -- $hidden
[ -z "$added" ] || touch "$added"
mount --bind "$place/view" "$libraries"
[ -z "$vendors" ] || mount --bind "$place/empty" "$vendors"
cd /
exec "$@"
"""
_PROBE = """
import dataclasses, json, sys
from mjrec.gl.choice import probe
print(json.dumps(dataclasses.asdict(probe(sys.argv[1]))))
"""


@pytest.fixture(scope="module")
def namespaces():
    """Return `unshare` if this user may create mount namespaces."""
    tried = subprocess.run(
        "unshare -Urm mount --bind /usr /usr", shell=True, capture_output=True
    )
    if tried.returncode != 0:
        pytest.skip(f"hiding a library takes a mount namespace: {tried.stderr}")
    if not (_LIBRARIES / "libEGL.so.1").exists():
        pytest.skip(f"libEGL.so.1 is not in {_LIBRARIES}, where it could be hidden")
    return "unshare"


@pytest.mark.parametrize(
    ("backend", "hidden", "added", "vendors", "causes"),
    [
        ("egl", "libEGL.so*", "", "", ["EGL's library, libEGL.so.1, is not"]),
        ("egl", "libEGL_mesa.so*", "", "", ["libEGL_mesa.so.0, named in"]),
        ("egl", "", "", _VENDORS, ["without a driver"]),
        # Since Mesa 24.2, all drivers are in one library, which libEGL_mesa needs.
        (
            *("egl", "dri libgallium-*", "", ""),
            ["Mesa's driver swrast is not installed", "libEGL_mesa.so.0, named in"],
        ),
        ("osmesa", "libOSMesa.so*", "", "", ["OSMesa's library, libOSMesa.so.8, is"]),
        # Mesa 25.1.3 no longer has OSMesa.
        ("osmesa", "libOSMesa.so*", "libgallium-25.1.3-1.so", "", ["has no OSMesa"]),
    ],
)
def test_missing_library_is_named_with_its_packages(
    namespaces, backend, hidden, added, vendors, causes, tmp_path
):
    hide = [str(_LIBRARIES), str(tmp_path), vendors, hidden, added]
    under = [namespaces, "-Urm", "bash", "-c", _HIDE, "hide", *hide]
    answer = json.loads(run_python(_PROBE, backend, under=under).stdout)
    assert not answer["renders"]
    assert any(cause in answer["cause"] for cause in causes), answer
    assert ("libosmesa6" if not added and backend == "osmesa" else _EGL_PACKAGES) in (
        answer["fix"]
    )
