# SPDX-License-Identifier: Apache-2.0
"""Rendering on a given GPU: found among EGL's devices, and said where there is none."""

import re
from dataclasses import replace

import pytest
from other_python import run_python, without_gl

from mjrec.errors import InvalidArgument
from mjrec.gl import render_on_given_gpu
from mjrec.gl.choice import probe
from mjrec.gl.devices import device_of_gpu, visible_gpus
from mjrec.gl.egl import EglDevice

# As EGL told of them on a machine with one NVIDIA H100 (driver 580.159.04) while
# CUDA_VISIBLE_DEVICES was not set, "0" or its UUID.
H100 = EglDevice(index=0, device_file="", cuda_id=0, software=False, in_use=True)
H100 = replace(H100, uuid="GPU-f3544f26-6dc5-5ba3-2ea8-e7c7c99e765b")
# There, while it was empty, "1", "-1" or another UUID.
HIDDEN = replace(H100, cuda_id=None)
# There, in front of the GPU or behind it as the vendor files were ordered.
LLVMPIPE = replace(HIDDEN, software=True, in_use=False, uuid="")
OTHER = replace(HIDDEN, index=1, uuid="GPU-0f3e5d1c-2b4a-4968-8877-665544332211")


def run(code, **variables):
    """Run `code` in a Python whose environment chooses no OpenGL but these."""
    head = (
        "import logging, os, sys; logging.basicConfig(level='INFO')\n"
        "from mjrec.gl import render_on_given_gpu\n"
    )
    env = without_gl(**variables)
    if "CUDA_VISIBLE_DEVICES" not in variables:
        env.pop("CUDA_VISIBLE_DEVICES", None)
    return run_python(head + code, env=env, status=None)


def has_gpu():
    return any(not device.software for device in probe("egl").devices)


SHOWN = replace(H100, index=2, cuda_id=3)


@pytest.mark.parametrize(
    ("devices", "gpu", "expected"),
    [
        # The one that has a number for CUDA, wherever it is in EGL's list; the number
        # may count all GPUs, or those that are shown.
        ([H100], "0", H100),
        ([LLVMPIPE, OTHER, SHOWN], "0", SHOWN),
        # EGL tells UUIDs also where CUDA shows nothing; the beginning is enough.
        ([HIDDEN, OTHER], OTHER.uuid, OTHER),
        ([HIDDEN, OTHER], "GPU-F3544F26", HIDDEN),
        # Where none or several would do, it is none.
        ([], "0", None),
        ([LLVMPIPE], "0", None),
        ([HIDDEN, OTHER], "GPU-", None),
        ([HIDDEN], "MIG-f3544f26-6dc5-5ba3-2ea8-e7c7c99e765b", None),
        ([H100, replace(H100, index=1)], "0", None),
    ],
)
def test_egls_device_of_a_gpu(devices, gpu, expected):
    """It is found by CUDA's number or the UUID, and never guessed."""
    assert device_of_gpu(devices, gpu) is expected


def test_visible_gpus(tmp_path):
    """As CUDA reads its variable, up to the first entry that it does not understand.

    Without it, it counts those that may be opened, whatever their files are called.
    """
    for text, expected in {
        " 2 , GPU-1a2b ": ["2", "GPU-1a2b"],
        "": [],
        "-1": [],
        "0,-1,2": ["0"],
    }.items():
        assert visible_gpus({"CUDA_VISIBLE_DEVICES": text}) == expected
    for name in ("nvidia2", "nvidia5", "nvidiactl", "nvidia-uvm", "null"):
        (tmp_path / name).touch()
    # Nobody may open a directory for writing, as nobody a GPU that is not granted.
    (tmp_path / "nvidia6").mkdir()
    assert visible_gpus({}, devices=tmp_path) == ["0", "1"]
    assert visible_gpus({}, devices=tmp_path / "none") == []


@pytest.mark.parametrize("gpu", ["", "cuda:0", "0,1", "GPU-1,GPU-2", "-1"])
def test_what_is_no_entry_is_refused(gpu):
    """Before anything is tried."""
    with pytest.raises(InvalidArgument, match="CUDA_VISIBLE_DEVICES"):
        render_on_given_gpu(gpu)


@pytest.mark.parametrize(
    ("gpu", "variables", "said"),
    [
        ("None", {"CUDA_VISIBLE_DEVICES": ""}, "This process was not assigned a GPU"),
        ("None", {"CUDA_VISIBLE_DEVICES": "-1"}, "This process was not assigned a GPU"),
        # `MUJOCO_GL` stands, and what that means is said.
        ("'0'", {"MUJOCO_GL": "osmesa"}, "GPU 0 was assigned for rendering, but"),
        ("'77'", {}, r"GPU 77 was assigned for rendering, but (EGL has only|none of)"),
    ],
)
def test_where_it_cannot_be_there_is_one_warning(gpu, variables, said):
    """No variable changes; it is an error where the GPU is required."""
    done = run(
        f"before = dict(os.environ)\nassert render_on_given_gpu({gpu}) is None\n"
        f"assert dict(os.environ) == before\n"
        f"render_on_given_gpu({gpu}, required=True)",
        **variables,
    )
    assert done.stderr.count("WARNING") == 1
    assert re.search(f"WARNING:mjrec.gl.devices:{said}", done.stderr)
    assert re.search(f"GLError: {said}", done.stderr)


@pytest.mark.skipif("not has_gpu()", reason="EGL can draw on no GPU here")
@pytest.mark.parametrize(
    "name", [lambda d: "0", lambda d: d.uuid, lambda d: d.uuid[:9]]
)
def test_the_given_gpu_draws(name):
    """By its number and by its UUID; mujoco then draws on that device."""
    gpu = name(next(d for d in probe("egl").devices if d.cuda_id == 0))
    done = run(
        f"device = render_on_given_gpu({gpu!r}, required=True)\n"
        "import mujoco\n"
        "from mjrec.simulation.gl_context import current_gl_facts\n"
        "context = mujoco.GLContext(16, 16); context.make_current()\n"
        "import OpenGL.GL\n"
        "facts = current_gl_facts()\n"
        "assert facts['gl_device']['index'] == device.index, facts\n"
        "assert facts['gl_device'].get('uuid', '') == device.uuid, facts"
    )
    assert done.returncode == 0, done.stderr
    assert f"Rendering on GPU {gpu}: EGL device" in done.stderr
