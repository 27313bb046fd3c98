# SPDX-License-Identifier: Apache-2.0
"""Nothing that was completed is lost with a monitor that never closed."""

from __future__ import annotations

import io
import json
import shutil
import signal
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import pytest
from trajectories_by_hand import write_log

import mjrec
from mjrec.errors import UnreadableFile
from mjrec.formats.journal import JournalEntry, JournalWriter
from mjrec.formats.manifest import Manifest, write_manifest
from mjrec.formats.stats_file import StatsFile, write_stats_file

TESTS = Path(__file__).parent
ENV_INFO = {"gym_version": "mjrec-1", "env_id": "(unknown:Corridor)"}


def killed(directory: Path, code: str, options: str) -> Path:
    """Record in a process that kills itself after `code`, which has `env`, `play`."""
    script = (
        "import os, sys\n"
        f"sys.path.insert(0, {str(TESTS)!r})\n"
        "import mjrec\n"
        "from conftest import Corridor, run_episodes as play\n"
        f"env = mjrec.Monitor(Corridor(), {str(directory)!r}, {options})\n"
        f"{code}\n"
        "os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], check=False, capture_output=True, text=True
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    return directory


@pytest.fixture(scope="module")
def killed_early(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory in which a monitor died in its fourth episode, without manifest."""
    return killed(
        tmp_path_factory.mktemp("early"),
        "play(env, 2, seed=5); env.set_monitor_mode('evaluation'); play(env, 1)\n"
        "env.reset(); env.step(0)",
        "video_callable=False",
    )


@pytest.fixture(scope="module")
def killed_late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One in which a monitor died after its fifth episode; its manifest has four."""
    return killed(
        tmp_path_factory.mktemp("late"),
        "play(env, 5)",
        "write_upon_reset=True, video_callable=[0, 4].__contains__",
    )


@pytest.fixture
def early(killed_early: Path, tmp_path: Path) -> Path:
    """A copy of `killed_early`."""
    return Path(shutil.copytree(killed_early, tmp_path / "early"))


@pytest.fixture
def late(killed_late: Path, tmp_path: Path) -> Path:
    """A copy of `killed_late`."""
    return Path(shutil.copytree(killed_late, tmp_path / "late"))


def load(directory: Path) -> dict[str, Any]:
    results = mjrec.load_results(directory)
    assert results is not None
    return results


def only(directory: Path, pattern: str) -> Path:
    (path,) = directory.glob(pattern)
    return path


def entry(episode_id: int, end_time: float | None = None) -> JournalEntry:
    return JournalEntry(
        episode_id=episode_id,
        length=10 + episode_id,
        reward=float(episode_id),
        type="t",
        start_time=99.5 + episode_id,
        end_time=100.0 + episode_id if end_time is None else end_time,
        seed=episode_id,
        options=None,
        terminated=True,
        truncated=False,
    )


def write_journal(directory: Path, infix: str, *numbers: int, **options: Any) -> Path:
    path = directory / f"openaigym.episodes.{infix}.jsonl"
    writer = JournalWriter(path, **options)
    for number in numbers:
        writer.append(entry(number))
    writer.close()
    return path


def write_saved(
    directory: Path, infix: str, *numbers: int, details: dict[str, Any] | None = None
) -> Path:
    """Write the manifest and the statistics of the episodes of these numbers."""
    entries = [entry(number) for number in numbers]
    stats = StatsFile(
        initial_reset_timestamp=98.0,
        timestamps=tuple(e.end_time for e in entries),
        episode_lengths=tuple(e.length for e in entries),
        episode_rewards=tuple(e.reward for e in entries),
        episode_types=tuple(e.type for e in entries),
    )
    name = f"openaigym.episode_batch.{infix}.stats.json"
    write_stats_file(directory / name, stats)
    path = directory / f"openaigym.manifest.{infix}.manifest.json"
    write_manifest(path, Manifest(name, (), ENV_INFO, details))
    return path


def test_a_journal_is_enough(early: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Of a monitor that left no manifest; the episode in flight does not count."""
    results = load(early)
    journal = only(early, "*.jsonl")
    assert not list(early.glob("*.json"))
    assert results["manifests"] == [str(journal)]
    assert results["env_info"] == ENV_INFO
    assert results["data_sources"] == [0, 0, 0]
    assert results["episode_lengths"] == [3, 3, 3]
    assert results["episode_rewards"] == [1.5, 1.5, 1.5]
    assert results["episode_types"] == ["t", "t", "e"]
    assert results["timestamps"] == sorted(results["timestamps"])
    (start,) = results["initial_reset_timestamps"]
    assert start == results["initial_reset_timestamp"] < results["timestamps"][0]
    assert results["videos"] == []
    assert [e.seed for e in mjrec.iter_episodes(early)] == [5, 5, None]
    assert not caplog.records


def test_a_journal_cut_anywhere_gives_its_whole_episodes(
    early: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever byte of the last line was the last to be written; the rest is said."""
    journal = only(early, "*.jsonl")
    whole = journal.read_bytes()
    last = len(whole.splitlines(keepends=True)[-1])
    for missing in range(last + 1):
        journal.write_bytes(whole[: len(whole) - missing])
        caplog.clear()
        count = 3 if missing <= 1 else 2
        assert load(early)["episode_lengths"] == [3] * count
        assert len(list(mjrec.iter_episodes(early))) == count
        # Once by each of the two.
        assert len(caplog.records) == (2 if 1 < missing < last else 0)


def test_an_older_manifest_does_not_hide_the_last_episodes(late: Path) -> None:
    """Of a monitor with `write_upon_reset`: the journal has one more."""
    manifest = only(late, "*.manifest.json")
    saved = json.loads(only(late, "*.stats.json").read_text())
    results = load(late)
    assert len(saved["timestamps"]) == 4
    assert len(results["timestamps"]) == 5
    assert results["timestamps"][:4] == saved["timestamps"]
    assert results["manifests"] == [str(manifest)]
    assert results["initial_reset_timestamp"] == saved["initial_reset_timestamp"]
    assert [e.episode_id for e in mjrec.iter_episodes(late)] == [0, 1, 2, 3, 4]


def test_resumed_monitors_are_merged_with_the_dead(
    late: Path, make_corridor: Any, play: Any
) -> None:
    """Each once, and numbered on; closed ones by their statistics files."""
    with mjrec.Monitor(
        make_corridor(2), late, resume=True, video_callable=False
    ) as env:
        play(env, 2)
    results = load(late)
    assert results["episode_lengths"] == [3] * 5 + [2] * 2
    assert len(results["manifests"]) == 2
    by_source = [results["data_sources"].count(source) for source in (0, 1)]
    assert sorted(by_source) == [2, 5]
    numbers = [episode.episode_id for episode in mjrec.iter_episodes(late)]
    assert sorted(numbers) == list(range(7))


def test_finished_videos_of_a_killed_monitor_are_found(late: Path) -> None:
    """With an older manifest and without one; broken ones are not among them."""
    videos = load(late)["videos"]
    assert [Path(video).name[-10:] for video, _ in videos] == [
        "000000.mp4",
        "000004.mp4",
    ]
    manifest = json.loads(only(late, "*.manifest.json").read_text())
    assert [name for name, _ in manifest["videos"]] == [Path(videos[0][0]).name]
    only(late, "*.manifest.json").unlink()
    assert load(late)["videos"] == videos
    Path(videos[0][1]).write_text('{"broken": true}')
    assert load(late)["videos"] == videos[1:]


def test_an_open_monitor_counts(tmp_path: Path, corridor: Any, play: Any) -> None:
    """With what it has completed, as if it had died now."""
    with mjrec.Monitor(corridor, tmp_path, video_callable=False) as env:
        play(env, 2)
        assert load(tmp_path)["episode_lengths"] == [3, 3]
        assert load(tmp_path)["env_info"] == ENV_INFO
    assert load(tmp_path)["episode_lengths"] == [3, 3]


def test_the_source_with_more_episodes_wins(tmp_path: Path) -> None:
    """Never both; the statistics file where they are equal."""
    write_saved(tmp_path, "0.7", 1, 2, 3)
    journal = write_journal(tmp_path, "0.7", 3, 4)
    assert load(tmp_path)["episode_lengths"] == [11, 12, 13]
    journal.unlink()
    write_journal(tmp_path, "0.7", 4, 5, 6)
    assert load(tmp_path)["episode_lengths"] == [11, 12, 13]
    journal.unlink()
    write_journal(tmp_path, "0.7", 1, 2, 3, 4)
    assert load(tmp_path)["episode_lengths"] == [11, 12, 13, 14]
    assert load(tmp_path)["initial_reset_timestamps"] == [98.0]


def test_a_number_written_twice_is_no_more_episodes(tmp_path: Path) -> None:
    """A journal wins by episodes, not by lines."""
    write_saved(tmp_path, "0.7", 1, 2, 3)
    write_journal(tmp_path, "0.7", 1, 2, 2, 2, 2)
    assert load(tmp_path)["episode_lengths"] == [11, 12, 13]


def test_sources_are_in_the_order_of_their_manifests(tmp_path: Path) -> None:
    """Be they there or not: each keeps its place in every list."""
    last = write_saved(tmp_path, "2.7", 3)
    first = write_saved(tmp_path, "0.7", 2)
    middle = write_journal(tmp_path, "10.7", 1)
    results = load(tmp_path)
    assert results["manifests"] == [str(first), str(middle), str(last)]
    assert results["data_sources"] == [1, 0, 2]
    assert results["initial_reset_timestamps"] == [98.0, 100.5, 98.0]


def test_a_closed_monitors_journal_is_not_looked_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For the statistics; there may be a million lines of it."""
    write_saved(tmp_path, "0.7", 1, 2)
    journal = write_journal(tmp_path, "0.7", 1)
    journal.write_bytes(journal.read_bytes() + b"damaged\n")
    monkeypatch.delattr("mjrec.results.sources.JournalReader")
    assert load(tmp_path)["episode_lengths"] == [11, 12]


@pytest.mark.parametrize("witness", ["journal", "lock", "log", "metadata"])
def test_without_a_manifest_something_else_says_what_was_recorded(
    tmp_path: Path, witness: str
) -> None:
    """The journal, what the lock of the dead holds, states, a video's metadata."""
    env_info = ENV_INFO if witness == "journal" else None
    write_journal(tmp_path, "0.7", 1, run={"env_info": env_info})
    if witness == "lock":
        lock = tmp_path / ".openaigym.0.7.lock"
        lock.write_text(json.dumps({"pid": 1, "env_info": ENV_INFO}))
    elif witness == "log":
        write_log(tmp_path, 1, env_id=ENV_INFO["env_id"])
    elif witness == "metadata":
        path = tmp_path / "openaigym.video.0.7.video000001.meta.json"
        path.write_text(json.dumps({"env_id": ENV_INFO["env_id"]}))
    assert load(tmp_path)["env_info"] == ENV_INFO


@pytest.mark.parametrize("lock", ["", "[1]", '{"env_info": {"env_id": 7}}', "\0" * 9])
def test_what_nobody_says_is_left_out(
    tmp_path: Path, lock: str, caplog: pytest.LogCaptureFixture
) -> None:
    """And is no difference from what others say."""
    write_journal(tmp_path, "0.7", 1)
    (tmp_path / ".openaigym.0.7.lock").write_text(lock)
    assert load(tmp_path)["env_info"] == {"gym_version": "mjrec-1"}
    write_saved(tmp_path, "1.7", 2)
    assert load(tmp_path)["env_info"] == ENV_INFO
    assert not caplog.records


def test_a_link_in_place_of_a_lock_is_not_followed(tmp_path: Path) -> None:
    """A directory may come from anybody."""
    write_journal(tmp_path, "0.7", 1)
    secret = tmp_path / "secret"
    secret.write_text(json.dumps({"env_info": ENV_INFO}))
    (tmp_path / ".openaigym.0.7.lock").symlink_to(secret)
    assert load(tmp_path)["env_info"] == {"gym_version": "mjrec-1"}


@pytest.mark.parametrize("pattern", ["*.manifest.json", "*.stats.json"])
@pytest.mark.parametrize("content", [None, b"", b"{", b'{"stats": "../x"}', b"[]"])
def test_a_journal_stands_in_for_damaged_files(
    tmp_path: Path,
    pattern: str,
    content: bytes | None,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """With a warning that names the file; without a journal it is an error."""
    write_saved(tmp_path, "0.7", 1, 2)
    journal = write_journal(tmp_path, "0.7", 1, 2, run={"env_info": ENV_INFO})
    damaged = only(tmp_path, pattern)
    if content is None:
        damaged.unlink()
    else:
        damaged.write_bytes(content)
    assert load(tmp_path)["episode_lengths"] == [11, 12]
    assert len(list(mjrec.iter_episodes(tmp_path))) == 2
    # A manifest that is not there is what a killed monitor leaves.
    if content is not None or "stats" in pattern:
        assert [damaged.name in r.getMessage() for r in caplog.records] == [True] * 2
        journal.unlink()
        with pytest.raises(UnreadableFile, match=damaged.name):
            mjrec.load_results(tmp_path)
        with pytest.raises(UnreadableFile, match=damaged.name):
            list(mjrec.iter_episodes(tmp_path))


def test_statistics_stand_in_for_a_journal_that_cannot_be_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Be it damaged as a whole, with every line."""
    write_saved(tmp_path, "0.7", 1, 2, details={"first_episode_id": 1})
    write_journal(tmp_path, "0.7").write_bytes(b"\xff\n" * 5000)
    assert load(tmp_path)["episode_lengths"] == [11, 12]
    assert "1000 lines" not in caplog.text
    assert [e.length for e in mjrec.iter_episodes(tmp_path)] == [11, 12]


def test_a_journal_that_cannot_be_read_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With statistics beside it in a warning, once; without them in the error."""
    details = {"first_episode_id": 1, "next_episode_id": 3}
    manifest = write_saved(tmp_path, "0.7", 1, 2, details=details)
    (tmp_path / "openaigym.trajectory.0.7.episode000001.h5").touch()
    journal = tmp_path / "openaigym.episodes.0.7.jsonl"
    # Nothing outside of the directory is read for it.
    journal.symlink_to("/proc/self/status")
    assert load(tmp_path)["episode_lengths"] == [11, 12]
    (record,) = caplog.records
    assert f"{journal}: it is a link" in record.getMessage()
    assert [e.length for e in mjrec.iter_episodes(tmp_path)] == [11, 12]
    assert len(caplog.records) == 2
    manifest.unlink()
    only(tmp_path, "*.stats.json").unlink()
    for read in (mjrec.load_results, lambda path: list(mjrec.iter_episodes(path))):
        with pytest.raises(UnreadableFile, match="out of its directory"):
            read(tmp_path)


def numbers(directory: Path) -> list[tuple[int, int | None]]:
    """Return each episode's number and seed."""
    return [(e.episode_id, e.seed) for e in mjrec.iter_episodes(directory)]


@pytest.mark.parametrize("lost", [0, 1, 3])
def test_a_lost_line_of_a_journal_costs_its_details_only(
    tmp_path: Path, lost: int
) -> None:
    """The statistics have the episode, and its neighbours its number."""
    details = {"first_episode_id": 5, "next_episode_id": 9}
    write_saved(tmp_path, "0.7", 5, 6, 7, 8, details=details)
    journal = write_journal(tmp_path, "0.7", 5, 6, 7, 8)
    lines = journal.read_bytes().splitlines(keepends=True)
    lines[lost] = b"\0" * 100 + b"\n"
    journal.write_bytes(b"".join(lines))
    video = tmp_path / f"openaigym.video.0.7.video00000{5 + lost}.mp4"
    video.touch()
    expected: list[tuple[int, int | None]] = [(n, n) for n in (5, 6, 7, 8)]
    expected[lost] = (5 + lost, None)
    assert numbers(tmp_path) == expected
    episode = list(mjrec.iter_episodes(tmp_path))[lost]
    assert (episode.length, episode.video) == (15 + lost, video)


def test_a_number_that_is_lost_shows_no_other_episodes_video(tmp_path: Path) -> None:
    """Episode 6 or 7 was reset in mid-episode; nobody knows which."""
    write_saved(tmp_path, "0.7", 5, 7, 8, details={"next_episode_id": 9})
    write_journal(tmp_path, "0.7", 5, 8)
    for number in (6, 7):
        (tmp_path / f"openaigym.video.0.7.video00000{number}.mp4").touch()
    assert numbers(tmp_path) == [(5, 5), (6, None), (8, 8)]
    assert [e.video for e in mjrec.iter_episodes(tmp_path)] == [None] * 3


def test_a_lost_journal_leaves_numbers_where_there_is_no_doubt(tmp_path: Path) -> None:
    """Where every number of the monitor was completed."""
    details = {"first_episode_id": 5, "next_episode_id": 7}
    write_saved(tmp_path, "0.7", 5, 6, details=details)
    video = tmp_path / "openaigym.video.0.7.video000005.mp4"
    video.touch()
    assert numbers(tmp_path) == [(5, None), (6, None)]
    assert [e.video for e in mjrec.iter_episodes(tmp_path)] == [video, None]
    write_saved(tmp_path, "0.7", 5, 6, details=details | {"next_episode_id": 8})
    assert [e.video for e in mjrec.iter_episodes(tmp_path)] == [None, None]


def test_the_episode_that_outlived_the_manifest_is_pending(tmp_path: Path) -> None:
    """It had begun when the manifest was written, and was no promise yet."""
    details = {"next_episode_id": 3, "pending": []}
    write_saved(tmp_path, "0.7", 0, 1, details=details)
    write_journal(tmp_path, "0.7", 0, 1, 2)
    for number in range(3):
        name = f"openaigym.trajectory.0.7.episode00000{number}.h5"
        (tmp_path / name).touch()
    pending = [episode.pending for episode in mjrec.iter_episodes(tmp_path)]
    assert pending == [False, False, True]


def test_a_journal_alone_is_a_monitors(tmp_path: Path, corridor: Any) -> None:
    """It is found, not overwritten without a word, and cleared."""
    journal = write_journal(tmp_path, "0.7", 1)
    assert mjrec.detect_monitor_files(tmp_path) == [str(journal)]
    assert mjrec.detect_training_manifests(tmp_path) == []
    with pytest.raises(mjrec.ExistingRecordings, match=journal.name):
        mjrec.Monitor(corridor, tmp_path, video_callable=False)
    with mjrec.Monitor(corridor, tmp_path, video_callable=False, force=True):
        assert not journal.exists()


def test_clearing_removes_first_what_lists_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If it is interrupted, no results are left without their files."""
    write_saved(tmp_path, "0.7", 1)
    write_journal(tmp_path, "1.7", 1)
    (tmp_path / "openaigym.episode_batch.1.7.stats.json").touch()
    removed: list[str] = []
    monkeypatch.setattr(
        Path, "unlink", lambda path, missing_ok: removed.append(path.name)
    )
    mjrec.clear_monitor_files(tmp_path)
    assert {name.split(".")[1] for name in removed[:2]} == {"manifest", "episodes"}
    assert len(removed) == 4


def test_an_archive_holds_the_videos_of_a_killed_monitor(late: Path) -> None:
    """Not its journal: gym's archive is videos and their metadata."""
    videos = load(late)["videos"]
    archive = io.BytesIO()
    mjrec.write_archive(videos, archive)
    archive.seek(0)
    with tarfile.open(fileobj=archive) as tar:
        assert tar.getnames() == [
            *(Path(name).name for pair in videos for name in pair),
            "manifest.json",
        ]
