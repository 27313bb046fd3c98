# SPDX-License-Identifier: Apache-2.0
"""Test rendering on an assigned GPU, which is looked up among EGL's devices."""

import re
from dataclasses import replace

import pytest
from other_python import run_python, without_gl

from mjrec.errors import InvalidArgument
from mjrec.gl import render_on_given_gpu
from mjrec.gl.choice import probe
from mjrec.gl.devices import device_of_gpu, visible_gpus
from mjrec.gl.egl import EglDevice

# EGL described an NVIDIA H100 (driver 580.159.04) like this while
# CUDA_VISIBLE_DEVICES was unset, "0" or the UUID of the GPU.
H100 = EglDevice(index=0, device_file="", cuda_id=0, software=False, in_use=True)
H100 = replace(H100, uuid="GPU-f3544f26-6dc5-5ba3-2ea8-e7c7c99e765b")
# With the variable empty, "1", "-1" or another UUID, EGL reported this instead.
HIDDEN = replace(H100, cuda_id=None)
# The order of the vendor files decides whether llvmpipe precedes the GPU.
LLVMPIPE = replace(HIDDEN, software=True, in_use=False, uuid="")
OTHER = replace(HIDDEN, index=1, uuid="GPU-0f3e5d1c-2b4a-4968-8877-665544332211")


def run(code, **variables):
    """Run `code` in a new Python with only these OpenGL variables."""
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
        # A GPU is found by its CUDA number anywhere in EGL's list; the number may
        # count all GPUs or only the visible ones.
        ([H100], "0", H100),
        ([LLVMPIPE, OTHER, SHOWN], "0", SHOWN),
        # EGL knows UUIDs even if CUDA hides every GPU; a prefix is enough.
        ([HIDDEN, OTHER], OTHER.uuid, OTHER),
        ([HIDDEN, OTHER], "GPU-F3544F26", HIDDEN),
        # No device or more than one device matches.
        ([], "0", None),
        ([LLVMPIPE], "0", None),
        ([HIDDEN, OTHER], "GPU-", None),
        ([HIDDEN], "MIG-f3544f26-6dc5-5ba3-2ea8-e7c7c99e765b", None),
        ([H100, replace(H100, index=1)], "0", None),
    ],
)
def test_egl_device_is_found_by_cuda_number_or_uuid(devices, gpu, expected):
    assert device_of_gpu(devices, gpu) is expected


def test_visible_gpus_are_those_of_cudas_variable_or_openable_files(tmp_path):
    """CUDA ignores the first invalid entry of the variable and all later ones."""
    cases = {" 2 , GPU-1a2b ": ["2", "GPU-1a2b"], "": [], "-1": [], "0,-1,2": ["0"]}
    for text, expected in cases.items():
        assert visible_gpus({"CUDA_VISIBLE_DEVICES": text}) == expected
    for name in ("nvidia2", "nvidia5", "nvidiactl", "nvidia-uvm", "null"):
        (tmp_path / name).touch()
    # A directory, like a GPU that was not assigned, cannot be opened for writing.
    (tmp_path / "nvidia6").mkdir()
    assert visible_gpus({}, devices=tmp_path) == ["0", "1"]
    assert visible_gpus({}, devices=tmp_path / "none") == []


@pytest.mark.parametrize("gpu", ["", "cuda:0", "0,1", "GPU-1,GPU-2", "-1"])
def test_invalid_gpus_are_rejected(gpu):
    with pytest.raises(InvalidArgument, match="CUDA_VISIBLE_DEVICES"):
        render_on_given_gpu(gpu)


@pytest.mark.parametrize(
    ("gpu", "variables", "message"),
    [
        ("None", {"CUDA_VISIBLE_DEVICES": ""}, "This process was not assigned a GPU"),
        ("None", {"CUDA_VISIBLE_DEVICES": "-1"}, "This process was not assigned a GPU"),
        # `MUJOCO_GL` takes precedence, but a warning is logged.
        ("'0'", {"MUJOCO_GL": "osmesa"}, "GPU 0 was assigned for rendering, but"),
        ("'77'", {}, r"GPU 77 was assigned for rendering, but (EGL has only|none of)"),
    ],
)
def test_unusable_gpu_is_a_warning_or_an_error_if_required(gpu, variables, message):
    """No environment variable is changed in either case."""
    done = run(
        f"before = dict(os.environ)\nassert render_on_given_gpu({gpu}) is None\n"
        f"assert dict(os.environ) == before\n"
        f"render_on_given_gpu({gpu}, required=True)",
        **variables,
    )
    assert done.stderr.count("WARNING") == 1
    assert re.search(f"WARNING:mjrec.gl.devices:{message}", done.stderr)
    assert re.search(f"GLError: {message}", done.stderr)


@pytest.mark.skipif("not has_gpu()", reason="EGL can draw on no GPU here")
@pytest.mark.parametrize("key", [lambda d: "0", lambda d: d.uuid, lambda d: d.uuid[:9]])
def test_mujoco_draws_on_the_given_gpu(key):
    gpu = key(next(d for d in probe("egl").devices if d.cuda_id == 0))
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
