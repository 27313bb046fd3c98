# SPDX-License-Identifier: Apache-2.0
"""Which names in a directory are monitors' files, and what they say."""

from __future__ import annotations

from pathlib import Path

import pytest

from mjrec.formats.monitor_directory import (
    episode_of,
    infix_of,
    iter_monitor_files,
    names_in,
    where_recordings_are,
)

VISIBLE = {
    "openaigym.manifest.0.1.manifest.json": ("0.1", None),
    "openaigym.episode_batch.0.1.stats.json": ("0.1", None),
    "openaigym.episodes.0.1.jsonl": ("0.1", None),
    "openaigym.video.0.1.video000027.mp4": ("0.1", 27),
    "openaigym.video.0.1.video000027.meta.json": ("0.1", 27),
    "openaigym.trajectory.0.1.episode000027.h5": ("0.1", 27),
    **{
        f"openaigym.states.0.1.000000.{end}": ("0.1", None)
        for end in ("spans", "log", "tail", "looks", "spans.damaged")
    },
    "openaigym.model.0123456789abcdef.zip": (None, None),
    "openaigym.results.0.1.monitor.csv": ("0.1", None),
}
HIDDEN = {
    ".openaigym.0.1.lock": ("0.1", None),
    ".openaigym.manifest.0.1.lock": ("0.1", None),
    ".openaigym.render.3.lock": (None, None),
    ".openaigym.clip.0.1.step000000137.lock": ("0.1", None),
    ".openaigym.video.0.1.video000027.lock": ("0.1", 27),
    ".openaigym.video.0.1.video000027.mp4.0123abcd.part": ("0.1", 27),
    ".openaigym.manifest.0.1.manifest.json.0123abcd.part": (None, None),
}
FOREIGN = (
    "openaigym.notes.txt",
    "openaigym.manifest",
    "openaigym..manifest.json",
    "mjrec.evaluation.0.1.jsonl",
    "openaigym.video.0.1.video27.mp4",
    "openaigym.states.0.1.log",
    "notes",
)


@pytest.mark.parametrize("name", [*VISIBLE, *HIDDEN])
def test_name_says_monitor_and_episode(name: str) -> None:
    """As far as it has them."""
    assert (infix_of(name), episode_of(name)) == {**VISIBLE, **HIDDEN}[name]


def test_a_clips_part_says_its_monitor_and_is_no_file(tmp_path: Path) -> None:
    """It is only ever in a log; its number is not that of an episode."""
    name = "openaigym.clip.0.1.step000000137.part000000"
    (tmp_path / name).touch()
    assert (infix_of(name), episode_of(name)) == ("0.1", None)
    assert list(iter_monitor_files(tmp_path, hidden=True)) == []


@pytest.mark.parametrize("name", FOREIGN)
def test_other_names_say_nothing(name: str) -> None:
    """They are somebody else's files."""
    assert (infix_of(name), episode_of(name)) == (None, None)


def test_files_are_listed_in_the_order_of_their_names(tmp_path: Path) -> None:
    """Hidden ones if asked for, and no other files, nor directories."""
    for name in (*VISIBLE, *HIDDEN, *FOREIGN):
        (tmp_path / name).touch()
    (tmp_path / "openaigym.manifest.1.1.manifest.json").mkdir()
    listed = [path.name for path in iter_monitor_files(tmp_path)]
    assert listed == sorted(VISIBLE)
    listed = [path.name for path in iter_monitor_files(tmp_path, hidden=True)]
    assert listed == sorted([*VISIBLE, *HIDDEN])
    assert set(names_in(tmp_path)) >= {*VISIBLE, *HIDDEN, *FOREIGN}


def test_links_count_where_they_lead_to_a_file(tmp_path: Path) -> None:
    """One to a file does; one to nothing, to a directory or to itself does not."""
    names = [f"openaigym.manifest.{n}.1.manifest.json" for n in range(4)]
    file, gone, folder, loop = (tmp_path / name for name in names)
    (tmp_path / "file").touch()
    file.symlink_to("file")
    gone.symlink_to("nothing")
    folder.symlink_to(".")
    loop.symlink_to(loop.name)
    assert list(iter_monitor_files(tmp_path)) == [file]


def test_directory_that_is_not_there_holds_nothing(tmp_path: Path) -> None:
    """Nobody has recorded into it."""
    assert list(iter_monitor_files(tmp_path / "none")) == []


def test_who_looks_in_the_wrong_place_is_told_of_the_folders(tmp_path: Path) -> None:
    """An evaluation has one for each task; some are named."""
    assert "mjrec record ENV --out" in where_recordings_are(tmp_path)
    for number in range(7):
        folder = tmp_path / f"task{number}"
        folder.mkdir()
        (folder / "openaigym.episodes.0.1.jsonl").touch()
    told = where_recordings_are(tmp_path)
    assert told == (
        "Its folders do (task0, task1, task2, task3, task4 and 2 more): name one of "
        "them."
    )
