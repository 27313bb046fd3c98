# SPDX-License-Identifier: Apache-2.0
"""Test the output of rendering progress without a terminal."""

import io
from types import SimpleNamespace

import gymnasium
import pytest
import rich.console

import mjrec
from mjrec.monitors import progress
from mjrec.monitors.progress import render_progress
from mjrec.rendering.jobs import Progress

MOMENTS = {0: 1, 4: 2, 6: 3, 20: 4, 35: 5, 37: 6}
LINES = [
    "Rendering: 3 of 9 videos done, 1,203 of 2,700 frames.",
    "Rendering: 6 of 9 videos done, 1,206 of 2,700 frames.",
]


@pytest.mark.parametrize("where", ["log", "console", "quiet"])
def test_log_gets_a_line_after_5_seconds_then_every_30(
    where, monkeypatch, caplog, capsys
):
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: clock.now))
    console = None
    if where != "log":
        console = rich.console.Console(file=io.StringIO(), quiet=where == "quiet")
    with render_progress(console) as show:
        for clock.now, done in MOMENTS.items():
            frames = 1200 + done
            show(Progress(videos_done=done, videos=9, frames_done=frames, frames=2700))
    expected = LINES if where != "quiet" else []
    assert (caplog.messages or capsys.readouterr().err.splitlines()) == expected


def test_close_logs_that_it_waits_for_rendering(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(progress, "_FIRST_LINE_S", 0.0)
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=4)
    with mjrec.Monitor(env, tmp_path, height=32, width=32, workers=1) as monitor:
        monitor.reset(seed=0)
        for _ in range(4):
            monitor.step([0.0])
    (line,) = [text for text in caplog.messages if text.startswith("Rendering: ")]
    assert " of 1 video done" in line
