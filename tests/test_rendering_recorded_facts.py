# SPDX-License-Identifier: Apache-2.0
"""What a trajectory says of itself is looked at before anything relies on it."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import pytest
from trajectories_by_hand import (
    INFIX,
    Painter,
    add_row,
    grey,
    new_logs,
    write_finished,
)

from mjrec import UnreadableFile
from mjrec.formats.monitor_directory import trajectory_prefix
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.rendering import again
from mjrec.rendering.again import Variant, render_again
from mjrec.rendering.recorded_facts import open_for_rendering


def write_saying(directory: Path, **facts: Any) -> Path:
    """Write a log of one frame that says these facts, of any kind."""
    usual = write_finished(directory, 1)
    with open_trajectory(usual) as reader:
        header = reader.header
    usual.unlink()
    header = dataclasses.replace(header, facts={**header.facts, **facts})
    logs = new_logs(directory)
    span = logs.begin(trajectory_prefix(INFIX, 1), header)
    for step in range(2):
        add_row(span, step, snapshot=grey(step))
    logs.close()
    return usual


VIDEO = {"name": "x.mp4", "recording": "deferred"}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("rate", "1e20000000"),
        ("rate", "abc"),
        ("rate", "0"),
        ("rate", "1/0"),
        ("rate", 20),
        ("rate", "1" * 13),
        ("timestep", "nan"),
        ("stride", 0),
        ("stride", "2"),
        ("stride", 2.0),
        ("stride", None),
        ("kept", 1),
        ("candidate", "yes"),
        ("scene", "all"),
        ("model", []),
        ("model", {"mjb": "x" * 300}),
        ("model", {"xml": "../x.zip"}),
        ("refusal", 5),
        ("video", "x"),
        ("video", {**VIDEO, "name": 5}),
        ("video", {**VIDEO, "quality": "best"}),
        ("video", {**VIDEO, "recording": None}),
        ("video", {**VIDEO, "fps": "1e20000000"}),
        ("video", {**VIDEO, "fps": "0.00001"}),
        ("video", {**VIDEO, "max_fps": 30}),
    ],
)
def test_a_fact_that_cannot_be_is_named(key: str, value: Any, tmp_path: Path) -> None:
    """With its file, at once."""
    path = write_saying(tmp_path, **{key: value})
    start = time.monotonic()
    with pytest.raises(UnreadableFile, match=key) as caught:
        open_for_rendering(path)
    assert caught.value.path == path
    assert time.monotonic() - start < 5


@pytest.mark.parametrize(
    "facts",
    [
        {"rate": None, "timestep": None, "video": None, "scene": None, "model": None},
        {"rate": "30000/1001", "stride": 3},
        {"video": {**VIDEO, "fps": "29.97", "max_fps": "5/2"}},
        {"video": {**VIDEO, "fps": "8435894437147607/281474976710656"}},
    ],
)
def test_what_recorders_write_is_accepted(
    facts: dict[str, Any], tmp_path: Path
) -> None:
    """Also what is not known yet in a recording that broke off."""
    with open_for_rendering(write_saying(tmp_path, **facts)) as reader:
        assert reader.frame_count == 2


def test_a_hostile_trajectory_stops_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is told, and the next one is rendered."""

    class Painters(Painter):
        def __init__(self, count: int) -> None:
            super().__init__()

        def __enter__(self) -> Painter:
            return self

        def __exit__(self, *error: object) -> None: ...

    monkeypatch.setattr(again, "WorkerPool", Painters)
    paths = [write_saying(tmp_path, video="x"), write_finished(tmp_path, 2)]
    outcomes = list(render_again(paths, Variant(max_fps=10), workers=1))
    assert "video" in str(outcomes[0].failure)
    assert outcomes[1].failure is None
    assert outcomes[1].frame_count == 3
