# SPDX-License-Identifier: Apache-2.0
"""The cost of everything except drawing: `python -m benchmarks.cheap_frames`.

Each run takes a thousand steps in HalfCheetah-v5, from `make` to the closed mp4, with
frames that cost next to nothing (64x64, without shadows and multisampling). It runs in
a separate process, and the variants alternate. If `MUJOCO_GL` is unset, mjrec chooses
the backend. The CPU seconds include all processes of a run and their imports. On a busy
machine, compare the CPU seconds, not the elapsed time.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs import mujoco as environments

import mjrec

ROUNDS = 7
_PR_SET_CHILD_SUBREAPER = 36
STEPS = 1000
QUALITY = '<visual><quality shadowsize="0" offsamples="0"/></visual>'
VARIANTS = {
    "RecordVideo": ("record_video", "egl"),
    "mjrec": ("monitor", "egl"),
    "mjrec, MUJOCO_GL unset": ("monitor", None),
}


def record(how: str) -> float:
    """Record one episode and return the seconds from `make` to the closed video."""
    assets = Path(environments.__file__).parent / "assets"
    xml = (assets / "half_cheetah.xml").read_text()
    with tempfile.TemporaryDirectory() as directory:
        model, videos = Path(directory) / "cheap.xml", Path(directory) / "videos"
        model.write_text(xml.replace("<worldbody>", f"{QUALITY}<worldbody>", 1))
        began = time.perf_counter()
        env: Any = gymnasium.make(
            "HalfCheetah-v5",
            xml_file=str(model),
            render_mode="rgb_array",
            width=64,
            height=64,
            max_episode_steps=STEPS,
        )
        if how == "monitor":
            env = mjrec.Monitor(env, videos, lambda episode: True, workers=2)
        else:
            env = gymnasium.wrappers.RecordVideo(
                env, str(videos), episode_trigger=lambda episode: True
            )
        env.action_space.seed(0)
        env.reset(seed=0)
        for _ in range(STEPS):
            env.step(env.action_space.sample())
        env.close()
        seconds = time.perf_counter() - began
        assert len(list(videos.glob("*.mp4"))) == 1, "the video is missing"
    return seconds


def seconds_of(how: str, backend: str | None) -> tuple[float, float]:
    """Call `record` in a new process, and return its result and the CPU seconds."""
    # Python may write bytecode files, as it usually does.
    left_out = ("MUJOCO_GL", "PYTHONDONTWRITEBYTECODE")
    environ = {k: v for k, v in os.environ.items() if k not in left_out}
    if backend is not None:
        environ["MUJOCO_GL"] = backend
    before = os.times()
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.cheap_frames", how],
        env=environ,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        check=True,
    )
    # The drawing processes are killed at the end. Their CPU time is only counted after
    # waiting for them.
    with contextlib.suppress(ChildProcessError):
        while True:
            os.waitpid(-1, 0)
    now = os.times()
    used = now.children_user + now.children_system
    used -= before.children_user + before.children_system
    return float(done.stdout.split()[-1]), used


def _adopt_orphans() -> None:
    """Make this process the parent of processes whose own parent has exited."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def main() -> None:
    """Print the medians of each variant, also as multiples of RecordVideo's."""
    _adopt_orphans()
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in VARIANTS}
    for _ in range(ROUNDS):
        for name, variant in VARIANTS.items():
            found[name].append(seconds_of(*variant))
    for part, what in enumerate(("seconds", "CPU seconds")):
        columns = {name: sorted(run[part] for run in found[name]) for name in VARIANTS}
        usual = statistics.median(columns["RecordVideo"])
        for name, times in columns.items():
            median = statistics.median(times)
            each = " ".join(f"{seconds:.2f}" for seconds in times)
            print(f"{name:24}{median:6.2f} {what}  {median / usual:.2f}  ({each})")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(record(sys.argv[1]))
    else:
        main()
