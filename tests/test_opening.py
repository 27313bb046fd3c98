# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from trajectories_by_hand import write_log

import mjrec
from mjrec import (
    DifferentEnvironment,
    DirectoryInUse,
    DirectoryNotWritable,
    ExistingRecordings,
    InvalidArgument,
    UnreadableFile,
)
from mjrec.formats.journal import JournalEntry, JournalWriter
from mjrec.formats.manifest import Manifest, write_manifest
from mjrec.formats.monitor_directory import (
    Infix,
    journal_name,
    lock_name,
    manifest_name,
)
from mjrec.recorder.opening import OpenDirectory, open_directory

ENV_INFO = {"gym_version": "mjrec-1", "env_id": "(unknown:Corridor)"}


def open_(directory: Path, **options: Any) -> OpenDirectory:
    wanted = {"force": False, "resume": False, "uid": None, "env_info": ENV_INFO}
    return open_directory(directory, **(wanted | options))


def write_video(directory: Path, infix: str, episode: int) -> None:
    (directory / f"openaigym.video.{infix}.video{episode:06d}.mp4").touch()


def record(
    directory: Path, make_corridor: Any, play: Callable[..., None], **options: Any
) -> Any:
    """Record two episodes without videos."""
    with mjrec.Monitor(
        make_corridor(), directory, video_callable=False, **options
    ) as env:
        play(env, 2)
    return env


def test_makes_the_directory_and_its_parents(tmp_path: Path) -> None:
    """A directory that is not there is made."""
    place = open_(tmp_path / "a" / "b")
    assert place.path.is_dir()
    assert place.first_episode_id == 0
    place.lock.release()


def test_relative_directory_is_fixed_at_opening(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A later chdir changes nothing."""
    monkeypatch.chdir(tmp_path)
    place = open_(Path("a"))
    assert place.path == tmp_path / "a"
    place.lock.release()


def test_existing_recordings_need_force_or_resume(
    tmp_path: Path, make_corridor: Any, play: Any
) -> None:
    """The error lists files and the ways out."""
    record(tmp_path, make_corridor, play)
    with pytest.raises(ExistingRecordings, match=r"(?s)manifest.*resume=True.*force"):
        open_(tmp_path)


def test_videos_without_a_manifest_are_recordings_too(tmp_path: Path) -> None:
    """What a crashed run left is not silently added to."""
    write_video(tmp_path, "0.1", 0)
    with pytest.raises(ExistingRecordings):
        open_(tmp_path)


def test_other_peoples_files_are_no_recordings(tmp_path: Path) -> None:
    """Only names that monitors give count."""
    (tmp_path / "notes.txt").touch()
    (tmp_path / "openaigym.notes.txt").touch()
    open_(tmp_path).lock.release()


def test_force_deletes_monitor_files_only(
    tmp_path: Path, make_corridor: Any, play: Any, names: Any
) -> None:
    """Notes and directories stay, whatever their names begin with."""
    record(tmp_path, make_corridor, play)
    (tmp_path / "openaigym.notes.txt").touch()
    (tmp_path / "openaigym.manifest.1.1.manifest.json").mkdir()
    open_(tmp_path, force=True).lock.release()
    assert names(tmp_path) == [
        "openaigym.manifest.1.1.manifest.json",
        "openaigym.notes.txt",
    ]


def test_force_does_not_delete_under_an_open_monitor(
    tmp_path: Path, make_corridor: Any
) -> None:
    """Another monitor's files are not pulled from under it."""
    with mjrec.Monitor(make_corridor(), tmp_path), pytest.raises(DirectoryInUse):
        open_(tmp_path, force=True)


def test_resume_goes_on_after_the_highest_number(
    tmp_path: Path, make_corridor: Any, play: Any
) -> None:
    """Two episodes were recorded, so the next is number 2."""
    record(tmp_path, make_corridor, play)
    place = open_(tmp_path, resume=True)
    assert place.first_episode_id == 2
    place.lock.release()


def test_resume_counts_videos_of_a_dead_monitor(tmp_path: Path) -> None:
    """A run that was killed before its manifest has its videos to count by."""
    write_video(tmp_path, "0.1", 7)
    place = open_(tmp_path, resume=True)
    assert place.first_episode_id == 8
    place.lock.release()


def test_resume_counts_an_episode_in_flight(tmp_path: Path) -> None:
    """The unfinished video of a killed run has a number too."""
    write_video(tmp_path, "0.1", 0)
    (tmp_path / ".openaigym.video.0.1.video000001.mp4.0a1b2c3d.part").touch()
    place = open_(tmp_path, resume=True)
    assert place.first_episode_id == 2
    place.lock.release()


def test_resume_counts_the_same_uid_only(tmp_path: Path) -> None:
    """With a uid each run has numbers of its own; without, the directory's."""
    write_video(tmp_path, "0.alice", 7)
    write_video(tmp_path, "0.bob", 3)
    for uid, expected in (("bob", 4), ("alice", 8), ("carol", 0), (None, 8)):
        place = open_(tmp_path, resume=True, uid=uid)
        assert place.first_episode_id == expected
        place.lock.release()


def test_resume_never_takes_a_used_name(tmp_path: Path) -> None:
    """The same uid, or a pid that was used before, gets another monitor id."""
    for number in range(50):
        write_video(tmp_path, f"{number}.same", 0)
    places = [open_(tmp_path, resume=True, uid="same") for _ in range(2)]
    taken = {str(place.infix) for place in places}
    assert len(taken) == 2
    assert not taken & {f"{number}.same" for number in range(50)}
    for place in places:
        place.lock.release()


def test_open_monitors_do_not_count(
    tmp_path: Path, make_corridor: Any, play: Any
) -> None:
    """Monitors that share a directory number independently, until they close."""
    with mjrec.Monitor(make_corridor(), tmp_path, video_callable=False) as first:
        play(first, 3)
        with mjrec.Monitor(
            make_corridor(), tmp_path, resume=True, video_callable=False
        ) as second:
            play(second, 1)
            assert (first.episode_id, second.episode_id) == (3, 1)
    place = open_(tmp_path, resume=True)
    assert place.first_episode_id == 3
    place.lock.release()


def test_killed_monitor_counts_as_dead(tmp_path: Path) -> None:
    """Its lock file stays but is not held; its journal has the numbers."""
    script = f"""
import os, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import conftest, mjrec
env = mjrec.Monitor(conftest.Corridor(), {str(tmp_path)!r}, video_callable=False)
conftest.run_episodes(env, 4)
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", script], check=False)
    assert done.returncode == -signal.SIGKILL
    place = open_(tmp_path, resume=True)
    assert place.first_episode_id == 4
    place.lock.release()


def test_torn_line_keeps_its_number(
    tmp_path: Path, make_corridor: Any, play: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Its episode is lost, and the next one is not taken for it; the log says so."""
    record(tmp_path, make_corridor, play)
    (journal,) = tmp_path.glob("*.jsonl")
    for path in tmp_path.glob("*.json"):
        path.unlink()
    lines = journal.read_bytes().splitlines(keepends=True)
    last = next(n for n, line in enumerate(lines) if b'"episode_id": 1' in line)
    journal.write_bytes(b"".join(lines[: last + 1])[:-20])
    place = open_(tmp_path, resume=True)
    assert place.first_episode_id == 2
    assert f"line {last + 1} (episode 1): it was cut off" in caplog.text
    place.lock.release()


@pytest.mark.parametrize("next_id", [None, True, -1, 1.5, "7", 10**4000, {}])
def test_impossible_next_number_is_an_error(tmp_path: Path, next_id: object) -> None:
    """A manifest may come from anybody; numbers go into names of files."""
    stats = "openaigym.episode_batch.0.7.stats.json"
    path = tmp_path / "openaigym.manifest.0.7.manifest.json"
    details = {"next_episode_id": next_id}
    write_manifest(path, Manifest(stats, (), ENV_INFO, details))
    with pytest.raises(UnreadableFile, match=rf"{path.name}.*next_episode_id"):
        open_(tmp_path, resume=True)


def test_name_with_an_impossible_number_does_not_count(tmp_path: Path) -> None:
    """It would make names that no file can have."""
    write_video(tmp_path, "0.7", 10**150)
    write_video(tmp_path, "0.7", 4)
    place = open_(tmp_path, resume=True)
    assert place.first_episode_id == 5
    place.lock.release()


def test_resume_over_a_journal_of_another_environment_is_an_error(
    tmp_path: Path,
) -> None:
    """Where the monitor was killed and its lock was not copied along."""
    writer = JournalWriter(
        tmp_path / "openaigym.episodes.0.7.jsonl",
        run={"env_info": ENV_INFO | {"env_id": "Ant-v5"}},
    )
    writer.append(JournalEntry(0, 1, 1.0, "t", 0.0, 1.0, 0, None, True, False))
    writer.close()
    with pytest.raises(DifferentEnvironment, match=r"Ant-v5.*Corridor"):
        open_(tmp_path, resume=True)


def test_resume_over_another_environment_is_an_error(
    tmp_path: Path, make_corridor: Any, play: Any
) -> None:
    """The error shows both names."""
    record(tmp_path, make_corridor, play)
    with pytest.raises(DifferentEnvironment, match=r"Corridor\).*Ant-v5"):
        open_(tmp_path, resume=True, env_info=ENV_INFO | {"env_id": "Ant-v5"})


def test_resume_over_another_open_environment_is_an_error(
    tmp_path: Path, make_corridor: Any
) -> None:
    """Also before the other monitor wrote anything."""
    with (
        mjrec.Monitor(make_corridor(), tmp_path),
        pytest.raises(DifferentEnvironment),
    ):
        open_(tmp_path, resume=True, env_info=ENV_INFO | {"env_id": "Ant-v5"})


@pytest.mark.parametrize("uid", ["", "a/b", ".hidden", "a b", "é", "x" * 101])
def test_uid_must_make_a_file_name(tmp_path: Path, uid: str) -> None:
    """Else nothing is made."""
    with pytest.raises(InvalidArgument, match="uid"):
        open_(tmp_path / "new", uid=uid)
    assert not (tmp_path / "new").exists()


def test_file_in_place_of_the_directory_is_an_error(tmp_path: Path) -> None:
    """The error names the path."""
    (tmp_path / "file").touch()
    with pytest.raises(DirectoryNotWritable, match="file"):
        open_(tmp_path / "file")


def test_name_that_is_too_long_is_an_error(tmp_path: Path) -> None:
    """The system's own words are in it."""
    with pytest.raises(DirectoryNotWritable, match="too long"):
        open_(tmp_path / ("x" * 300))


@pytest.mark.parametrize("path", ["/proc/self", "/proc/mjrec/recordings"])
def test_unwritable_directory_is_an_error(path: str) -> None:
    """Where not even root may write, be the directory there or not."""
    with pytest.raises(DirectoryNotWritable, match=path):
        open_(Path(path))


def test_failed_opening_removes_what_it_made(tmp_path: Path) -> None:
    """Directories made on the way go again."""
    with pytest.raises(TypeError):
        open_directory(
            tmp_path / "a" / "b", force=False, resume=False, uid=None, env_info=None
        )  # type: ignore[arg-type]  # a failure on purpose
    assert not (tmp_path / "a").exists()


def test_joining_looks_at_nobody_elses_files(tmp_path: Path) -> None:
    """Whatever is there, also what cannot be read, and numbers begin with 0."""
    write_video(tmp_path, "0.elsewhere", 7)
    (tmp_path / "openaigym.manifest.1.elsewhere.manifest.json").write_text("{")
    other = ENV_INFO | {"env_id": "Ant-v5"}
    place = open_(tmp_path, resume="join", env_info=other)
    assert place.first_episode_id == 0
    place.lock.release()


def test_joining_takes_nobody_elses_name(tmp_path: Path) -> None:
    """A manifest, a journal or a lock shows that a name was given before."""
    first = open_(tmp_path, resume="join", uid="same")
    after = [Infix(first.infix.monitor_id + n, "same") for n in (1, 2, 3)]
    (tmp_path / manifest_name(after[0])).touch()
    (tmp_path / journal_name(after[1])).touch()
    (tmp_path / lock_name(after[2])).touch()
    place = open_(tmp_path, resume="join", uid="same")
    assert place.infix.monitor_id > after[2].monitor_id
    for each in (first, place):
        each.lock.release()


def test_a_monitor_that_joins_leaves_dead_ones_as_they_are(
    tmp_path: Path,
    make_corridor: Any,
    play: Callable[..., None],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Putting them in order is left to others."""
    env_id = ENV_INFO["env_id"]
    dead = write_log(tmp_path, infix=Infix(0, "1"), ended=False, env_id=env_id)
    left = [path for path in tmp_path.iterdir() if ".states." in path.name]
    before = [path.read_bytes() for path in left]
    record(tmp_path, make_corridor, play, resume="join")
    assert [path.read_bytes() for path in left] == before
    assert not dead.exists()
    record(tmp_path, make_corridor, play, resume=True)
    assert not any(path.exists() for path in left)
    assert dead.exists()
    assert "Not recovered" not in caplog.text


@pytest.mark.parametrize("resume", ["yes", 1, None])
def test_resume_is_one_of_three(
    resume: Any, tmp_path: Path, make_corridor: Any
) -> None:
    """A slip is not taken for yes."""
    with pytest.raises(InvalidArgument, match='True, False, or "join"'):
        mjrec.Monitor(make_corridor(), tmp_path / "a", False, resume=resume)
    assert not (tmp_path / "a").exists()
