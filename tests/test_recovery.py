# SPDX-License-Identifier: Apache-2.0
"""Recovering a directory: processes are killed, and nothing of theirs is lost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import (
    events_of,
    frames_in,
    in_flight,
    journal_of,
    manifest_of,
    metadata_of,
    stats_of,
    videos_in,
)
from trajectories_by_hand import INFIX, write_log

import mjrec
from mjrec.commands import main
from mjrec.formats.journal import JournalEntry, JournalWriter
from mjrec.formats.locks import Lock, try_lock
from mjrec.formats.monitor_directory import (
    journal_name,
    lock_name,
    states_name,
    video_lock_name,
    video_prefix,
)
from mjrec.formats.trajectory_file import open_trajectory

TESTS = Path(__file__).parent

# A corridor of 12 steps, or a cheetah's 12 steps; what it is told to do comes in words.
PROGRAM = """
import os, signal, sys, time
sys.path.insert(0, sys.argv[3])
import gymnasium, mjrec
from conftest import Corridor

def drained(writer):
    # What was captured has gone to the encoder, all of it.
    while writer._encoding._encoded < writer.frame_count:
        time.sleep(0.001)

def monitor(**options):
    env = Corridor(length=12)
    return mjrec.Monitor(env, sys.argv[1], lambda episode: True, env_id="Corridor-v0",
                         **options)

def cheetah(**options):
    env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array", width=64, height=48,
                         max_episode_steps=12)
    return mjrec.Monitor(env, sys.argv[1], lambda episode: True, **options)

def run(env, steps=12, reset=True):
    env.action_space.seed(5)
    if reset:
        env.reset(seed=3)
    for _ in range(steps):
        env.step(env.action_space.sample())

def die(env=None):
    if env is not None:
        drained(env.video_recorder._sink._writer)
    os.kill(os.getpid(), signal.SIGKILL)

"""


@pytest.fixture
def killed(tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that runs a program, which kills itself, on a directory."""

    def run(program: str, directory: Path | None = None) -> Path:
        directory, said = directory or tmp_path / "run", tmp_path / "said"
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM + program, directory, said, TESTS],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == -signal.SIGKILL, done.stderr
        return directory

    return run


def results_of(directory: Path) -> dict[str, Any]:
    """Return the results but for what says which files they are from."""
    results = mjrec.load_results(directory)
    assert results is not None
    results["videos"] = sorted(results["videos"])
    return {key: value for key, value in results.items() if key != "manifests"}


def done(recovery: mjrec.Recovery) -> dict[str, str]:
    """Return what became of each file, by the end of its name."""
    assert not recovery.failures, str(recovery)
    return {file.name.rpartition(".0.")[2]: file.what for file in recovery.files}


def assert_in_order(directory: Path) -> None:
    """Nothing is left to do, and no old or hidden file is there."""
    before = {path.name: path.read_bytes() for path in directory.iterdir()}
    again = mjrec.recover(directory)
    assert not again
    assert str(again) == f"Nothing to recover in {directory}."
    assert {path.name: path.read_bytes() for path in directory.iterdir()} == before
    hidden = [name for name in before if name.startswith(".")]
    in_flight = [name for name in before if name.endswith((".spans", ".log", ".tail"))]
    assert not hidden + in_flight


def expected(frame: int) -> Any:
    """Return a corridor's picture."""
    picture = np.zeros((32, 48, 3), np.uint8)
    picture[:, : 4 * frame + 4] = (200, 40, 10)
    return picture


def test_a_live_video_cut_off_in_mid_episode_is_whole_up_to_there(
    killed: Callable[[str], Path],
) -> None:
    """Every frame that its encoder was given is there, in order, with its hash."""
    directory = killed("env = monitor()\nrun(env)\nrun(env, 7)\ndie(env)")
    before = results_of(directory)
    recovery = mjrec.recover(directory)
    after = results_of(directory)
    assert {**after, "videos": after["videos"][:1]} == before
    assert videos_in(directory) == [0, 1]
    frames = frames_in(directory, 1)
    assert len(frames) == 8
    for number, frame in enumerate(frames):
        assert abs(frame.astype(int) - expected(number)).mean() < 6
    metadata = metadata_of(directory, 1)
    whole = metadata_of(directory, 0)
    assert (metadata["complete"], metadata["reason"]) == (False, "killed")
    assert (metadata["frame_count"], metadata["frame_steps"]) == (8, [[0, 7]])
    assert set(whole) - set(metadata) == {"terminated", "truncated"}
    assert metadata["length"] == 7
    differs = {key for key in whole if metadata.get(key) != whole[key]}
    assert differs - {"length", "reward", "terminated", "truncated"} == {
        *("episode_id", "complete", "frame_count", "frame_steps", "encoder_version"),
        *("file_sha256", "decoded_sha256"),
    }
    hashes = [
        path.read_text().splitlines() for path in sorted(directory.glob("*.framehash"))
    ]
    assert hashes[1] == hashes[0][: len(hashes[1])]
    assert len(hashes[1]) == 9 + 8
    assert done(recovery)[f"{_uid(directory)}.video000001.mp4"] == (
        "8 frames, incomplete: killed"
    )
    assert_in_order(directory)


def test_hashes_of_frames_that_never_reached_the_encoder_are_left_out(
    killed: Callable[[str], Path],
) -> None:
    """The process was killed between the two."""
    directory = killed(
        "import mjrec.formats.video_writer as v\n"
        "write, count = v.FfmpegProcess.write, iter(range(9))\n"
        "def fifth(*arguments):\n"
        "    die() if next(count) == 5 else write(*arguments)\n"
        "v.FfmpegProcess.write = fifth\nenv = monitor()\nrun(env)\n"
        "env.video_recorder.close()\n"
    )
    mjrec.recover(directory)
    [hashes] = directory.glob("*.framehash")
    assert len(frames_in(directory, 0)) == 5
    assert len(hashes.read_text().splitlines()) == 9 + 5
    assert metadata_of(directory, 0)["frame_steps"] == [[0, 4]]
    assert_in_order(directory)


def test_what_was_recovered_stands_in_the_manifest(
    killed: Callable[[str], Path],
) -> None:
    """With all that is known of the run."""
    directory = killed("env = monitor()\nrun(env)\nrun(env)\nrun(env, 7)\ndie(env)")
    recovery = mjrec.recover(directory)
    assert recovery.failures == ()
    assert stats_of(directory)["episode_lengths"] == [12, 12]
    assert stats_of(directory)["timestamps"] == [
        entry["end_time"] for entry in journal_of(directory)
    ]
    manifest = manifest_of(directory)
    assert manifest["env_info"] == {"gym_version": "mjrec-1", "env_id": "Corridor-v0"}
    assert [video for video, _ in manifest["videos"]] == sorted(
        path.name for path in directory.glob("*.mp4")
    )
    details = manifest["mjrec"]
    assert details.pop("versions")["mjrec"] == mjrec.__version__
    details.pop("surroundings")
    assert details == {
        "format_version": 1,
        "schedule": {"name": "monitor.<locals>.<lambda>", "recorded": [0, 1, 2]},
        "first_episode_id": 0,
        "next_episode_id": 3,
        "pending": [],
        "broken": [],
        "faults": [],
        "recovered": True,
    }
    assert_in_order(directory)


def test_deferred_episodes_become_trajectories_and_stay_pending(
    killed: Callable[[str], Path],
) -> None:
    """The one in flight too, marked as killed; rendered, it shows what was recorded."""
    directory = killed(
        "env = cheetah(workers=0)\nrun(env)\nrun(env, 6)\n"
        "env._recorder._subject.states.finish()\ndie()"
    )
    before = results_of(directory)
    mjrec.recover(directory)
    assert results_of(directory) == before
    facts = []
    for path in sorted(directory.glob("*.h5")):
        with open_trajectory(path) as reader:
            facts.append({**reader.header.facts, "steps": reader.step_count})
    assert [f["complete"] for f in facts] == [True, False]
    assert [f["steps"] for f in facts] == [12, 6]
    assert (facts[1]["reason"], facts[1]["length"]) == ("killed", 6)
    pending = manifest_of(directory)["mjrec"]["pending"]
    assert [entry["episode_id"] for entry in pending] == [0, 1]
    assert_in_order(directory)
    assert main(["render", str(directory)]) == 0
    # Both began alike, and did alike.
    first, second = frames_in(directory, 0), frames_in(directory, 1)
    assert (len(first), len(second)) == (13, 7)
    for one, other in zip(first, second, strict=False):
        assert abs(one.astype(int) - other).mean() < 3
    assert metadata_of(directory, 1)["reason"] == "killed"
    assert manifest_of(directory)["mjrec"]["pending"] == []
    assert_in_order(directory)


def test_a_manifest_that_is_older_than_its_journal_is_brought_up_to_date(
    killed: Callable[[str], Path],
) -> None:
    """What it knew and nothing else says stays."""
    directory = killed(
        "env = monitor(write_upon_reset=True)\nrun(env)\nrun(env)\ndie()"
    )
    assert stats_of(directory)["episode_lengths"] == [12]
    start = stats_of(directory)["initial_reset_timestamp"]
    name = manifest_of(directory)["mjrec"]["schedule"]["name"]
    mjrec.recover(directory)
    assert stats_of(directory)["episode_lengths"] == [12, 12]
    assert stats_of(directory)["initial_reset_timestamp"] == start
    details = manifest_of(directory)["mjrec"]
    assert details["schedule"] == {"name": name, "recorded": [0, 1]}
    assert details["recovered"] is True
    assert_in_order(directory)


def test_only_the_dead_monitors_files_are_touched(
    killed: Callable[..., Path], corridor: Any, play: Callable[..., None]
) -> None:
    """A living one in the same directory goes on as if nothing had been."""
    directory = killed("env = monitor()\nrun(env)\nrun(env, 5)\ndie(env)")
    with mjrec.Monitor(
        corridor, directory, lambda _: True, resume=True, env_id="Corridor-v0"
    ) as living:
        # Resuming has recovered the dead one.
        assert videos_in(directory) == [0, 1]
        assert living.episode_id == 2
        play(living, 1)
        killed("env = monitor(resume=True)\nrun(env, 5)\ndie(env)", directory)
        own = {
            path.name: path.read_bytes()
            for path in directory.iterdir()
            if living.infix in path.name
        }
        recovery = mjrec.recover(directory)
        assert recovery.files
        assert recovery.open_monitors == (living.infix,)
        assert living.infix in str(recovery)
        assert own == {
            path.name: path.read_bytes()
            for path in directory.iterdir()
            if living.infix in path.name
        }
        play(living, 1)
    assert_in_order(directory)


def test_a_live_video_without_a_frame_is_no_broken_one(
    killed: Callable[[str], Path],
) -> None:
    """Its encoder was begun, and had been given nothing when all was over."""
    directory = killed(
        "import mjrec.formats.video_writer as v\n"
        "v._Encoding._encode = lambda *_: die()\n"
        "env = monitor()\nrun(env)\n"
    )
    mjrec.recover(directory)
    assert videos_in(directory) == []
    metadata = metadata_of(directory, 0)
    assert metadata["empty"]
    assert "broken" not in metadata
    assert manifest_of(directory)["mjrec"]["broken"] == []
    assert_in_order(directory)


def test_a_text_recording_that_was_cut_off_is_finished(
    killed: Callable[[str], Path],
) -> None:
    """It holds every frame, and what a whole one says of them."""
    directory = killed(
        "env = mjrec.Monitor(Corridor(12, 'ansi'), sys.argv[1], lambda _: True,\n"
        "                    env_id='Corridor-v0')\n"
        "run(env)\nrun(env, 7)\ndie()"
    )
    recovery = mjrec.recover(directory)
    whole, cut = (
        json.loads(path.read_text())
        for path in sorted(directory.glob("*.video00000?.json"))
    )
    assert cut["stdout"] == whole["stdout"][:8]
    assert set(cut) == set(whole)
    metadata, other = metadata_of(directory, 1), metadata_of(directory, 0)
    assert (metadata["complete"], metadata["reason"]) == (False, "killed")
    assert (metadata["fps"], metadata["frame_steps"]) == ("10", [[0, 7]])
    assert metadata["content_type"] == other["content_type"]
    assert len(manifest_of(directory)["videos"]) == 2
    assert "8 frames, incomplete: killed" in str(recovery)
    assert_in_order(directory)


def test_an_encoder_that_was_killed_too_is_told(killed: Callable[[str], Path]) -> None:
    """The video is not there, its metadata says why, and what there is is kept."""
    directory = killed(
        "env = monitor()\nrun(env)\nrun(env, 7)\nw = env.video_recorder._sink._writer\n"
        "drained(w)\nos.kill(w._encoding._process.pid, signal.SIGKILL)\n"
        "w._encoding.temporary.write_bytes(b'ftyp' + bytes(900))\ndie()"
    )
    recovery = mjrec.recover(directory)
    assert videos_in(directory) == [0]
    metadata = metadata_of(directory, 1)
    assert metadata["broken"]
    assert metadata["empty"]
    assert "its encoder" in metadata["broken_reason"]
    assert (metadata["complete"], metadata["reason"]) == (False, "killed")
    [part] = directory.glob(".*.mp4.????????.part")
    assert part.name in str(recovery)
    assert manifest_of(directory)["mjrec"]["broken"] == [
        f"{video_prefix(_infix(directory), 1)}.meta.json"
    ]
    assert not mjrec.recover(directory)
    assert part.exists()


def test_an_encoder_that_outlives_its_process_is_waited_for(
    killed: Callable[[str], Path], tmp_path: Path
) -> None:
    """As long as was asked for; then it is told, and the next time it is done."""
    directory = killed(
        "env = monitor()\nrun(env, 7)\ndrained(env.video_recorder._sink._writer)\n"
        "pid = env.video_recorder._sink._writer._encoding._process.pid\n"
        "os.kill(pid, signal.SIGSTOP)\n"
        "open(sys.argv[2], 'w').write(str(pid))\ndie()"
    )
    encoder = int((tmp_path / "said").read_text())
    try:
        recovery = mjrec.recover(directory, timeout=0.1)
        [failure] = recovery.failures
        assert failure.name.endswith("video000000.mp4")
        assert "still finishing" in str(recovery)
        assert videos_in(directory) == []
    finally:
        os.kill(encoder, signal.SIGCONT)
    assert mjrec.recover(directory).failures == ()
    assert len(frames_in(directory, 0)) == 8
    assert len(manifest_of(directory)["videos"]) == 1
    assert_in_order(directory)


def test_a_video_that_got_its_name_gets_its_metadata(
    killed: Callable[[str], Path],
) -> None:
    """Its process was killed between the two."""
    directory = killed(
        "import mjrec.formats.video_metadata as v\nv.write_text = lambda *_: die()\n"
        "env = monitor(max_fps=2)\nrun(env)\n"
    )
    assert videos_in(directory) == [0]
    assert not list(directory.glob("*.meta.json"))
    mjrec.recover(directory)
    metadata = metadata_of(directory, 0)
    assert (metadata["complete"], metadata["terminated"]) == (True, True)
    # The last one is always taken.
    assert (metadata["stride"], metadata["frame_steps"]) == (5, [[0, 10], [12, 12]])
    assert metadata["length"] == 12
    assert len(manifest_of(directory)["videos"]) == 1
    assert_in_order(directory)


def test_a_complete_episode_that_the_journal_lacks_is_added(tmp_path: Path) -> None:
    """The machine failed before the line was on the disk; its trajectory has it all."""
    facts = {
        "complete": True,
        "terminated": True,
        "truncated": False,
        "length": 4,
        "reward": 2.5,
        "start_time": 10.0,
        "end_time": 12.0,
    }
    write_log(tmp_path, 0, ended=False, **facts)
    write_log(tmp_path, 1, ended=False, **facts)
    journal = tmp_path / journal_name(INFIX)
    writer = JournalWriter(journal)
    writer.append(JournalEntry(0, 4, 2.5, "t", 10.0, 12.0, 5, None, True, False))
    writer.close()
    with journal.open("ab") as file:
        file.write(b'{"episode_id": 1, "length": 4, "rew')
    recovery = mjrec.recover(tmp_path)
    assert recovery.failures == ()
    assert [e.episode_id for e in mjrec.iter_episodes(tmp_path)] == [0, 1]
    assert stats_of(tmp_path)["episode_lengths"] == [4, 4]
    assert_in_order(tmp_path)


def test_a_log_whose_episode_is_in_the_journal_is_complete(tmp_path: Path) -> None:
    """All its rows are there, and its process was killed before the last words."""
    write_log(tmp_path, 0, steps=4, ended=False)
    writer = JournalWriter(tmp_path / journal_name(INFIX))
    writer.append(JournalEntry(0, 4, 2.5, "t", 10.0, 12.0, 5, None, True, False))
    writer.close()
    mjrec.recover(tmp_path)
    [path] = tmp_path.glob("*.h5")
    with open_trajectory(path) as reader:
        facts = reader.header.facts
    assert (facts["complete"], facts["terminated"], facts["reward"]) == (
        True,
        True,
        2.5,
    )
    assert "reason" not in facts


def test_logs_that_hold_nothing_do_not_come_back(tmp_path: Path) -> None:
    """An empty list is removed, and one that nobody can read is set aside."""
    write_log(tmp_path, 0)
    empty, garbage = (tmp_path / states_name(INFIX, number) for number in (1, 2))
    empty.touch()
    garbage.write_bytes(b'{"format": "else"}\n' + bytes(203))
    recovery = mjrec.recover(tmp_path)
    assert f"{empty.name}: nothing in flight, removed" in str(recovery)
    assert f"{garbage.name}.damaged" in str(recovery)
    assert not empty.exists()
    assert garbage.with_name(f"{garbage.name}.damaged").stat().st_size == 222
    assert_in_order(tmp_path)
    mjrec.clear_monitor_files(tmp_path)
    assert not list(tmp_path.iterdir())


def test_rows_that_nothing_describes_are_kept(tmp_path: Path) -> None:
    """A machine that failed may have lost the list's first line, and no row."""
    write_log(tmp_path, 0)
    [spans] = tmp_path.glob("*.spans")
    spans.write_bytes(b"")
    recovery = mjrec.recover(tmp_path)
    assert f"{spans.name}.damaged" in str(recovery)
    assert spans.with_suffix(".log").stat().st_size
    assert not mjrec.recover(tmp_path)


def test_a_log_of_a_newer_version_is_left_as_it_is(tmp_path: Path) -> None:
    """It is not damaged, and a newer mjrec can recover it."""
    write_log(tmp_path, 0)
    [log] = tmp_path.glob("*.spans")
    content = log.read_bytes().replace(b'"version": 1', b'"version": 9', 1)
    log.write_bytes(content)
    recovery = mjrec.recover(tmp_path)
    assert [file.name for file in recovery.failures] == [log.name]
    assert log.read_bytes() == content


def test_unfinished_files_of_a_dead_renderer_are_removed(tmp_path: Path) -> None:
    """Those of a living one stay."""
    write_log(tmp_path, 0)
    write_log(tmp_path, 1)
    mjrec.recover(tmp_path)
    parts = [
        tmp_path / f".{video_prefix(INFIX, n)}.{kind}.0123abcd.part"
        for n in (0, 1)
        for kind in ("mp4", "framehash")
    ]
    side = tmp_path / f".{video_prefix(INFIX, 0)}.side.mp4.0123abcd.part"
    for part in parts:
        part.touch()
    renderer = try_lock(tmp_path / video_lock_name(INFIX, 1), "")
    again = Lock(side, "")
    assert renderer is not None
    recovery = mjrec.recover(tmp_path, timeout=0)
    assert [file.name for file in recovery.files] == [p.name for p in sorted(parts[:2])]
    assert [part.exists() for part in parts] == [False, False, True, True]
    assert side.exists()
    renderer.release()
    again.let_go()
    mjrec.recover(tmp_path)
    assert not any(part.exists() for part in [*parts, side])
    assert_in_order(tmp_path)


def test_a_note_that_was_being_rewritten_leaves_nothing(tmp_path: Path) -> None:
    """The unfinished file of a note is no note."""
    part = tmp_path / f".{video_prefix(INFIX, 0)}.mp4.note.part.0123abcd.part"
    part.touch()
    recovery = mjrec.recover(tmp_path)
    assert [file.name for file in recovery.files] == [part.name]
    assert not part.exists()
    assert not mjrec.recover(tmp_path)


@pytest.mark.thorough
def test_a_renderer_that_was_killed_leaves_its_video_pending(
    killed: Callable[[str], Path],
) -> None:
    """Recovering removes what it had begun, and rendering does it anew."""
    directory = killed("env = cheetah(workers=0)\nrun(env)\nenv.close()\ndie()")
    command = [sys.executable, "-m", "mjrec", "render", str(directory), "--workers=1"]
    manifest = manifest_of(directory)
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as renderer:
        while not list(directory.glob(".*.mp4.*.part")):
            assert renderer.poll() is None
        renderer.kill()
    end = time.monotonic() + 20
    # An encoder that was being started holds its locks for a moment more.
    while list(directory.glob(".*.part")):
        assert time.monotonic() < end
        assert not mjrec.recover(directory).failures
    # Its monitor had closed, and written all that there was to be written.
    assert manifest_of(directory) == manifest
    assert len(manifest["mjrec"]["pending"]) == 1
    assert main(["render", str(directory)]) == 0
    assert len(frames_in(directory, 0)) == 13
    assert manifest_of(directory)["mjrec"]["pending"] == []


def test_unfinished_models_go_when_nobody_records(tmp_path: Path) -> None:
    """While somebody does, they may be theirs."""
    part = tmp_path / ".openaigym.model.0123456789abcdef.zip.0123abcd.part"
    part.touch()
    lock = Lock(tmp_path / lock_name(INFIX), "")
    assert not mjrec.recover(tmp_path)
    lock.let_go()
    assert mjrec.recover(tmp_path)
    assert not list(tmp_path.iterdir())


def test_two_recoveries_at_once_do_the_work_once(
    killed: Callable[[str], Path],
) -> None:
    """The second waits for the first, and finds nothing to do."""
    directory = killed("env = monitor()\nrun(env)\nrun(env, 5)\ndie(env)")
    command = [sys.executable, "-m", "mjrec", "recover", str(directory)]
    both = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)
    ]
    said = sorted(process.communicate()[0] for process in both)
    assert [process.returncode for process in both] == [0, 0]
    assert said[0] == f"Nothing to recover in {directory}.\n"
    assert said[1].count("video000001.mp4") == 1
    assert_in_order(directory)


def test_a_directory_that_cannot_be_written_to_is_one_error(
    killed: Callable[[str], Path],
) -> None:
    """Nothing is half done."""
    directory = killed("env = monitor()\nrun(env, 5)\ndie(env)")
    before = sorted(directory.iterdir())
    # For root, whom no permission stops, a file stands where the lock belongs.
    blocker = directory / ".openaigym.recover.lock"
    blocker.mkdir()
    try:
        with pytest.raises(mjrec.DirectoryNotWritable, match=str(directory)):
            mjrec.recover(directory)
    finally:
        blocker.rmdir()
    assert sorted(directory.iterdir()) == before


def test_there_must_be_a_directory(tmp_path: Path) -> None:
    """And a time to wait that is a number."""
    with pytest.raises(mjrec.InvalidArgument, match="no directory"):
        mjrec.recover(tmp_path / "missing")
    for wrong in (-1, float("nan"), "5", True):
        with pytest.raises(mjrec.InvalidArgument, match="timeout"):
            mjrec.recover(tmp_path, timeout=wrong)  # type: ignore[arg-type]  # as said


def test_gyms_own_directories_are_left_alone(tmp_path: Path) -> None:
    """A manifest of gym's cannot be made again, and is not."""
    names = [
        "openaigym.video.0.77.video000000.mp4",
        "openaigym.video.0.77.video000000.meta.json",
        "openaigym.episode_batch.0.77.stats.json",
    ]
    for name in names:
        (tmp_path / name).write_text("{}")
    assert not mjrec.recover(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)


def test_nothing_to_recover_loads_no_hdf5(tmp_path: Path) -> None:
    """A simulation that goes on where a closed one left off stays small."""
    code = "import sys, mjrec; mjrec.recover(sys.argv[1]); print('h5py' in sys.modules)"
    said = subprocess.run(
        [sys.executable, "-c", code, tmp_path],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert said == "False\n"


def _infix(directory: Path) -> Any:
    from mjrec.formats.monitor_directory import Infix, infix_of

    [journal] = directory.glob("openaigym.episodes.*")
    return Infix.parse(infix_of(journal.name) or "")


def _uid(directory: Path) -> str:
    return str(_infix(directory).uid)


def test_logs_of_a_monitor_that_did_not_wait(
    killed: Callable[[str], Path],
) -> None:
    """They become trajectories, and the rest of a closed monitor stays as it is."""
    directory = killed(
        "env = cheetah(workers=0)\nrun(env)\nenv.close(wait=False)\ndie()"
    )
    manifest = manifest_of(directory)
    [path] = in_flight(directory)
    assert mjrec.recover(directory)
    assert path.exists()
    assert not list(directory.glob("openaigym.states.*"))
    assert manifest_of(directory) == manifest
    assert not mjrec.recover(directory)


def test_a_damaged_manifest_is_made_again(killed: Callable[[str], Path]) -> None:
    """Of the journal, as where there was none."""
    directory = killed("env = cheetah(workers=0)\nrun(env)\nenv.close()\ndie()")
    [path] = directory.glob("*.manifest.json")
    before = mjrec.load_results(directory)
    path.write_text("{garbage")
    assert mjrec.recover(directory)
    after = mjrec.load_results(directory)
    assert before is not None
    assert after is not None
    assert after["episode_rewards"] == before["episode_rewards"]
    assert len(manifest_of(directory)["mjrec"]["pending"]) == 1
    assert not mjrec.recover(directory)


def test_provenance_of_a_manifest_is_kept(killed: Callable[[str], Path]) -> None:
    """Packages, machine and policy stay known though the monitor was killed later."""
    directory = killed(
        "from mjrec.provenance import look_around\n"
        "env = monitor()\nrun(env)\nlook_around().found(wait=True)\n"
        "run(env)\nrun(env)\ndie(env)"
    )
    assert mjrec.recover(directory)
    [around] = events_of(directory, "surroundings")
    assert around["packages"]
    assert manifest_of(directory)["mjrec"]["surroundings"] == around
