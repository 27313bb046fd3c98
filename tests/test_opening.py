# SPDX-License-Identifier: Apache-2.0
"""Test where a monitor may record, and its first episode number."""

from pathlib import Path

import pytest
from full_disk import file_size_limit
from result_files import ENV_INFO, entry, write_journal, write_saved
from trajectories_by_hand import write_log

import mjrec
from conftest import Corridor, run_episodes
from mjrec import DifferentEnvironment, DirectoryNotWritable, ExistingRecordings

ANOTHER = "Ant-v5"


def monitor(directory, **options):
    return mjrec.Monitor(Corridor(), directory, video_callable=False, **options)


def first_number(directory, **options):
    """Return the first episode number of a new monitor, and delete its files."""
    opened = monitor(directory, **{"resume": True, **options})
    opened.close()
    for path in directory.glob(f"*{opened.infix}*"):
        path.unlink()
    return int(opened.episode_id)


def record(directory, episodes=2, **options):
    with monitor(directory, **options) as env:
        run_episodes(env, episodes)


def write_video(directory, infix, episode):
    (directory / f"openaigym.video.{infix}.video{episode:06d}.mp4").touch()


def test_force_deletes_monitor_files_only(tmp_path, names):
    """Other files stay, even if their names start like those of monitor files."""
    others = ["notes.txt", "openaigym.manifest.1.1.manifest.json", "openaigym.txt"]
    (tmp_path / others[1]).mkdir()
    for name in (others[0], others[2]):
        (tmp_path / name).touch()
    record(tmp_path)
    with monitor(tmp_path, force=True) as env:
        assert [name for name in names(tmp_path) if env.infix not in name] == others
        with pytest.raises(mjrec.DirectoryInUse):
            monitor(tmp_path, force=True)


def test_resume_continues_after_the_highest_number(tmp_path):
    """With a uid, only runs with this uid count; "join" reads no files at all."""
    write_video(tmp_path, "0.1", 0)
    # Videos without other files count as recordings.
    with pytest.raises(ExistingRecordings, match=r"(?s)mp4.*resume=True.*force"):
        monitor(tmp_path)
    record(tmp_path, resume=True)
    assert first_number(tmp_path) == 3
    write_video(tmp_path, "0.alice", 7)
    write_video(tmp_path, "0.bob", 3)
    # Numbers that are too long for a file name are ignored.
    write_video(tmp_path, "0.x", 10**150)
    for uid, expected in (("bob", 4), ("alice", 8), ("carol", 0), (None, 8)):
        assert first_number(tmp_path, uid=uid) == expected
    (tmp_path / "openaigym.manifest.1.elsewhere.manifest.json").write_text("{")
    assert first_number(tmp_path, resume="join", env_id=ANOTHER) == 0


def test_resume_never_reuses_a_monitor_id(tmp_path):
    used = {f"{number}.same" for number in range(50)}
    for infix in used:
        write_video(tmp_path, infix, 0)
    options = {"resume": True, "uid": "same"}
    with monitor(tmp_path, **options) as one, monitor(tmp_path, **options) as other:
        assert len({one.infix, other.infix} - used) == 2


def test_torn_line_keeps_its_number(tmp_path, caplog):
    """The episode of a torn line is lost, and a warning is logged."""
    journal = write_journal(tmp_path, "0.7", 0, 1, run={"env_info": ENV_INFO})
    journal.write_bytes(journal.read_bytes()[:-20])
    assert first_number(tmp_path) == 2
    assert "skipped 1 line: line 3 (episode 1)" in caplog.text


@pytest.mark.parametrize("number", [True, -1, 1.5, "7", 10**4000, {}])
def test_invalid_next_number_is_an_error(tmp_path, number):
    path = write_saved(tmp_path, "0.7", details={"next_episode_id": number})
    with pytest.raises(mjrec.UnreadableFile, match=rf"{path.name}.*next_episode_id"):
        monitor(tmp_path, resume=True)


def test_resume_over_another_environment_is_an_error(tmp_path):
    """The error names both environments, even if a monitor is open or was killed."""
    again = {"resume": True, "env_id": ANOTHER}
    with monitor(tmp_path / "a") as env:
        with pytest.raises(DifferentEnvironment, match=rf"Corridor\).*{ANOTHER}"):
            monitor(tmp_path / "a", **again)
        run_episodes(env, 1)
    with pytest.raises(DifferentEnvironment, match=rf"Corridor\).*{ANOTHER}"):
        monitor(tmp_path / "a", **again)
    run = {"env_info": {**ENV_INFO, "env_id": ANOTHER}}
    (tmp_path / "b").mkdir()
    write_journal(tmp_path / "b", "0.7", entry(0), run=run)
    with pytest.raises(DifferentEnvironment, match=rf"{ANOTHER}.*Corridor"):
        monitor(tmp_path / "b", resume=True)


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        *((path, path.removeprefix("{}")) for path in ("{}/file", "/proc/self")),
        ("/proc/mjrec/recordings", "/proc/mjrec/recordings"),
        ("{}/" + "x" * 300, "too long"),
    ],
)
def test_unwritable_directory_is_an_error(path, reason, tmp_path):
    """If the disk is full, no directory is left."""
    (tmp_path / "file").touch()
    with pytest.raises(DirectoryNotWritable, match=reason):
        monitor(Path(path.format(tmp_path)))
    with file_size_limit(0), pytest.raises(DirectoryNotWritable):
        monitor(tmp_path / "a" / "b")
    assert not (tmp_path / "a").exists()


def test_join_leaves_killed_monitors_alone(tmp_path, caplog):
    """Only `resume=True` recovers the recordings of killed monitors."""
    env_id = ENV_INFO["env_id"]
    dead = write_log(tmp_path, infix="0.1", ended=False, env_id=env_id)
    left = [path for path in tmp_path.iterdir() if ".states." in path.name]
    before = [path.read_bytes() for path in left]
    record(tmp_path, resume="join")
    assert [path.read_bytes() for path in left] == before
    assert not dead.exists()
    record(tmp_path, resume=True)
    assert not any(path.exists() for path in left)
    assert dead.exists()
    assert "Not recovered" not in caplog.text
