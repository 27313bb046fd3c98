# SPDX-License-Identifier: Apache-2.0
"""Episodes are listed one by one, of open, closed, dead and gym's monitors."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from result_files import entry, write_journal, write_saved
from trajectories_by_hand import write_finished, write_log

import mjrec
from mjrec.errors import UnreadableFile
from mjrec.formats.monitor_directory import Infix


def video(directory: Path, infix: str, episode_id: int, suffix: str) -> Path:
    path = directory / f"openaigym.video.{infix}.video{episode_id:06d}{suffix}"
    path.touch()
    return path


def pending_in(directory: Path) -> list[bool]:
    return [episode.pending for episode in mjrec.iter_episodes(directory)]


def test_an_episode_of_a_journal_has_its_files(tmp_path: Path) -> None:
    """Numbers, seeds and flags as the monitor knew them; no other monitor's video."""
    facts = {"type": "e", "options": {"x": 1}, "terminated": False, "truncated": True}
    write_journal(tmp_path, "0.7", entry(27, **facts), 28)
    # The same monitor's statistics hold less of each.
    write_saved(tmp_path, "0.7", 27, 28)
    mp4, meta = (video(tmp_path, "0.7", 27, end) for end in (".mp4", ".meta.json"))
    for infix, end in (("0.7", ".side.mp4"), ("0.7", ".framehash"), ("1.7", ".mp4")):
        video(tmp_path, infix, 28, end)
    first, second = mjrec.iter_episodes(str(tmp_path))
    assert first == mjrec.Episode(
        episode_id=27,
        length=37,
        reward=27.0,
        start_time=126.5,
        end_time=127.0,
        seed=27,
        monitor="0.7",
        video=mp4,
        metadata=meta,
        **facts,  # type: ignore[arg-type]  # as above
    )
    assert (second.episode_id, second.video, second.metadata) == (28, None, None)


def test_an_episode_has_its_trajectory(tmp_path: Path) -> None:
    """The finished one where both are there; of a clip in flight what it will be."""
    write_journal(tmp_path, "0.7", 1, 2, 3)
    in_flight, finished = (
        write_log(tmp_path, number, infix=Infix(0, "7"), video=None)
        for number in (1, 2)
    )
    finished.touch()
    write_log(tmp_path, 3, infix=Infix(1, "7"), video=None)
    found = [episode.trajectory for episode in mjrec.iter_episodes(tmp_path)]
    assert found == [in_flight, finished, None]
    assert not in_flight.exists()


@pytest.mark.parametrize("write", [write_log, write_finished])
def test_a_manifest_lists_the_pending_videos(tmp_path: Path, write: Any) -> None:
    """Neither those that are there now, nor those that failed, nor those not wanted."""
    write_journal(tmp_path, "0.7", *range(4))
    for number in range(4):
        write(tmp_path, number, infix=Infix(0, "7"))
    pending = [{"episode_id": number} for number in (0, 1, 2)]
    details = {"next_episode_id": 4, "pending": pending}
    write_saved(tmp_path, "0.7", *range(4), details=details)
    video(tmp_path, "0.7", 1, ".mp4")
    video(tmp_path, "0.7", 2, ".meta.json")
    assert pending_in(tmp_path) == [True, False, False, False]


@pytest.mark.parametrize("details", [None, {"next_episode_id": 0}, {"pending": 7}])
def test_without_a_manifest_trajectories_show_what_is_pending(
    tmp_path: Path, details: dict[str, object] | None
) -> None:
    """Also where it is from before these episodes; h5py is not needed."""
    write_journal(tmp_path, "0.7", *range(5))
    for number, kind in enumerate(("deferred", "live", None, "deferred")):
        write_log(tmp_path, number, infix=Infix(0, "7"), video=kind)
    max(tmp_path.glob("*.spans")).write_bytes(b"?\n")
    write_log(tmp_path, 4, infix=Infix(0, "7")).touch()
    if details is not None:
        write_saved(tmp_path, "0.7", details=details)
    assert pending_in(tmp_path) == [True, False, False, False, True]


def test_gyms_episodes_have_what_gym_wrote(tmp_path: Path) -> None:
    """Numbered by their index; the rest is None. A gym may die before its manifest."""
    write_saved(tmp_path, "0.7", 1, 2, types="te").unlink()
    text, meta = (video(tmp_path, "0.7", 1, end) for end in (".json", ".meta.json"))
    _, episode = mjrec.iter_episodes(tmp_path)
    assert episode == mjrec.Episode(
        episode_id=1,
        length=12,
        reward=2.0,
        type="e",
        start_time=None,
        end_time=102.0,
        seed=None,
        options=None,
        terminated=None,
        truncated=None,
        monitor="0.7",
        video=text,
        metadata=meta,
    )


@pytest.mark.parametrize(
    ("types", "linked"), [(None, True), ("tt", True), ("ttt", True), ("tttt", False)]
)
def test_a_video_is_never_shown_for_another_episode(
    tmp_path: Path, types: str | None, linked: bool
) -> None:
    """Gym numbers videos by resets; more of them than ends and a next are in doubt."""
    write_saved(tmp_path, "0.7", 1, 2, types=types)
    video(tmp_path, "0.7", 0, ".mp4")
    first, second = mjrec.iter_episodes(tmp_path)
    assert (first.video is not None) == linked
    assert (first.type, second.type) == ("t", "t")


def test_monitors_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """10 after 9, for the monitor and for the process."""
    infixes = ["0.9", "0.10", "0.run", "1.7", "9.7", "10.7"]
    for infix in reversed(infixes):
        write_journal(tmp_path, infix, 0)
    monitors = [episode.monitor for episode in mjrec.iter_episodes(tmp_path)]
    assert sorted(monitors[:3]) == sorted(infixes[:3])
    assert monitors.index("0.9") < monitors.index("0.10")
    assert monitors[3:] == infixes[3:]


def test_a_missing_directory_is_an_error_at_once(tmp_path: Path) -> None:
    """Before the first episode is asked for; an empty one has no episodes."""
    with pytest.raises(UnreadableFile, match="no such directory"):
        mjrec.iter_episodes(tmp_path / "missing")
    assert list(mjrec.iter_episodes(tmp_path)) == []


def test_memory_does_not_grow_with_the_episodes(tmp_path: Path) -> None:
    """Episodes are read as they are asked for."""
    items = (entry(number, options="x" * 1000) for number in range(5000))
    path = write_journal(tmp_path, "0.7", *items)
    tracemalloc.start()
    count = sum(1 for _ in mjrec.iter_episodes(tmp_path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 5000
    assert peak < path.stat().st_size / 10
