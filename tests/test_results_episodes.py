# SPDX-License-Identifier: Apache-2.0
"""Episodes are listed one by one, of open, closed, dead and gym's monitors."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest
from trajectories_by_hand import write_log

import mjrec
from mjrec.errors import UnreadableFile
from mjrec.formats.journal import JournalEntry, JournalWriter
from mjrec.formats.manifest import Manifest, write_manifest
from mjrec.formats.monitor_directory import Infix
from mjrec.formats.stats_file import StatsFile, write_stats_file
from mjrec.formats.trajectory_file import finish_trajectory


def entry(episode_id: int, options: object = None) -> JournalEntry:
    return JournalEntry(
        episode_id=episode_id,
        length=10 + episode_id,
        reward=1.5,
        type="e",
        start_time=1.0,
        end_time=2.0,
        seed=7,
        options=options,
        terminated=False,
        truncated=True,
    )


def write_journal(directory: Path, infix: str, *entries: JournalEntry) -> Path:
    path = directory / f"openaigym.episodes.{infix}.jsonl"
    writer = JournalWriter(path)
    for item in entries:
        writer.append(item)
    writer.close()
    return path


def write_stats(directory: Path, infix: str, count: int, types: str | None) -> None:
    """Write what gym leaves of `count` episodes of 1, 2, 3 ... steps."""
    numbers = range(1, count + 1)
    content = StatsFile(
        initial_reset_timestamp=0.5,
        timestamps=tuple(map(float, numbers)),
        episode_lengths=tuple(numbers),
        episode_rewards=tuple(map(float, numbers)),
        episode_types=None if types is None else tuple(types),
    )
    name = f"openaigym.episode_batch.{infix}.stats.json"
    write_stats_file(directory / name, content)
    path = directory / f"openaigym.manifest.{infix}.manifest.json"
    write_manifest(path, Manifest(name, (), {}, None))


def video(directory: Path, infix: str, episode_id: int, suffix: str) -> Path:
    path = directory / f"openaigym.video.{infix}.video{episode_id:06d}{suffix}"
    path.touch()
    return path


def log(directory: Path, infix: str, episode_id: int, recording: str | None) -> Path:
    """Record an episode whose video is made in that way, or not at all."""
    known = Infix.parse(infix)
    assert known is not None
    return write_log(directory, episode_id, infix=known, video=recording)


def pending_of(directory: Path) -> list[bool]:
    return [episode.pending for episode in mjrec.iter_episodes(directory)]


def test_an_episode_has_its_trajectory(tmp_path: Path) -> None:
    """The finished one where both are there, because somebody died in between."""
    write_journal(tmp_path, "0.7", entry(1), entry(2), entry(3))
    in_flight, finished = (log(tmp_path, "0.7", number, None) for number in (1, 2))
    finished.touch()
    log(tmp_path, "1.7", 3, None)
    found = [episode.trajectory for episode in mjrec.iter_episodes(tmp_path)]
    assert found == [in_flight, finished, None]
    assert not in_flight.exists()


@pytest.mark.parametrize("is_finished", [False, True])
def test_a_manifest_says_which_videos_are_pending(
    tmp_path: Path, is_finished: bool
) -> None:
    """Neither those that are there now, nor those that failed, nor those not wanted."""
    write_journal(tmp_path, "0.7", *(entry(number) for number in range(4)))
    for number in range(4):
        path = log(tmp_path, "0.7", number, "deferred")
        if is_finished:
            finish_trajectory(path)
    promised = [{"episode_id": number} for number in (0, 1, 2)]
    details = {"next_episode_id": 4, "pending": promised}
    path = tmp_path / "openaigym.manifest.0.7.manifest.json"
    write_manifest(path, Manifest("stats.json", (), {}, details))
    video(tmp_path, "0.7", 1, ".mp4")
    video(tmp_path, "0.7", 2, ".meta.json")
    assert pending_of(tmp_path) == [True, False, False, False]


@pytest.mark.parametrize("manifest", [None, {"next_episode_id": 0}, {"pending": 7}])
def test_of_a_killed_monitor_the_trajectories_say_it(
    tmp_path: Path, manifest: dict[str, object] | None
) -> None:
    """Also where it left a manifest from before these episodes; h5py is not needed."""
    kinds = ("deferred", "live", None)
    write_journal(tmp_path, "0.7", *(entry(number) for number in range(5)))
    for number, kind in enumerate(kinds):
        log(tmp_path, "0.7", number, kind)
    log(tmp_path, "0.7", 3, "deferred")
    max(tmp_path.glob("*.spans")).write_bytes(b"?\n")
    log(tmp_path, "0.7", 4, "deferred").touch()
    if manifest is not None:
        path = tmp_path / "openaigym.manifest.0.7.manifest.json"
        write_manifest(path, Manifest("stats.json", (), {}, manifest))
    assert pending_of(tmp_path) == [True, False, False, False, True]


def test_a_journal_is_told_whole(tmp_path: Path) -> None:
    """Numbers, seeds and flags as the monitor knew them, with its video's files."""
    write_journal(tmp_path, "0.7", entry(27, {"x": 1}), entry(28))
    mp4 = video(tmp_path, "0.7", 27, ".mp4")
    meta = video(tmp_path, "0.7", 27, ".meta.json")
    video(tmp_path, "0.7", 28, ".side.mp4")
    video(tmp_path, "0.7", 28, ".framehash")
    video(tmp_path, "1.7", 28, ".mp4")
    first, second = mjrec.iter_episodes(str(tmp_path))
    assert first == mjrec.Episode(
        episode_id=27,
        length=37,
        reward=1.5,
        type="e",
        start_time=1.0,
        end_time=2.0,
        seed=7,
        options={"x": 1},
        terminated=False,
        truncated=True,
        monitor="0.7",
        video=mp4,
        metadata=meta,
    )
    assert (second.episode_id, second.video, second.metadata) == (28, None, None)


def test_the_journal_counts_where_there_is_one(tmp_path: Path) -> None:
    """The statistics of the same monitor hold the same episodes and less of each."""
    write_stats(tmp_path, "0.7", 2, "tt")
    write_journal(tmp_path, "0.7", entry(27), entry(28))
    assert [episode.episode_id for episode in mjrec.iter_episodes(tmp_path)] == [27, 28]


def test_a_monitor_that_died_is_included(tmp_path: Path) -> None:
    """Its journal is enough, also with a torn end."""
    path = write_journal(tmp_path, "0.7", entry(0), entry(1))
    path.write_bytes(path.read_bytes()[:-9])
    assert [episode.episode_id for episode in mjrec.iter_episodes(tmp_path)] == [0]


def test_statistics_without_a_manifest_are_included(tmp_path: Path) -> None:
    """A gym that died between writing the two."""
    write_stats(tmp_path, "0.7", 2, "tt")
    (tmp_path / "openaigym.manifest.0.7.manifest.json").unlink()
    assert len(list(mjrec.iter_episodes(tmp_path))) == 2


def test_gyms_episodes_have_what_gym_wrote(tmp_path: Path) -> None:
    """Numbered by their index; what gym did not write is None."""
    write_stats(tmp_path, "0.7", 2, "te")
    text, meta = (video(tmp_path, "0.7", 1, end) for end in (".json", ".meta.json"))
    _, episode = mjrec.iter_episodes(tmp_path)
    assert episode == mjrec.Episode(
        episode_id=1,
        length=2,
        reward=2.0,
        type="e",
        start_time=None,
        end_time=2.0,
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
    write_stats(tmp_path, "0.7", 2, types)
    video(tmp_path, "0.7", 0, ".mp4")
    first, second = mjrec.iter_episodes(tmp_path)
    assert (first.video is not None) == linked
    assert (first.type, second.type) == ("t", "t")


def test_monitors_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """10 after 9, for the monitor and for the process."""
    infixes = ["0.9", "0.10", "0.run", "1.7", "9.7", "10.7"]
    for infix in reversed(infixes):
        write_journal(tmp_path, infix, entry(0))
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
    items = (entry(number, "x" * 1000) for number in range(5000))
    path = write_journal(tmp_path, "0.7", *items)
    tracemalloc.start()
    count = sum(1 for _ in mjrec.iter_episodes(tmp_path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 5000
    assert peak < path.stat().st_size / 10
