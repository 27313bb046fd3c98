# SPDX-License-Identifier: Apache-2.0
"""Recovering a directory loses nothing of the processes that were killed."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from other_python import run_python
from recordings import (
    events_of,
    frames_in,
    hashes_at,
    in_flight,
    journal_of,
    manifest_of,
    metadata_of,
    stats_of,
    videos_in,
)
from trajectories_by_hand import INFIX, write_log
from waiting import wait_until

import mjrec
from mjrec.formats.locks import Lock, is_locked, try_lock
from mjrec.formats.monitor_directory import (
    infix_of,
    lock_name,
    log_name,
    video_prefix,
)

# A corridor or a cheetah runs for 12 steps; `code` says what to do.
PROGRAM = f"""
import os, signal, sys, time
sys.path.insert(0, {str(Path(__file__).parent)!r})
import mjrec
from conftest import Corridor

def always(episode): return True

def monitor(env=None, **options):
    env = env or Corridor(length=12)
    return mjrec.Monitor(env, sys.argv[1], always, env_id="Corridor-v0", **options)

def run(env, steps=12):
    env.action_space.seed(5)
    env.reset(seed=3)
    for _ in range(steps):
        env.step(env.action_space.sample())

def encoding(env):
    # What was captured has gone to the encoder, all of it.
    clips = env._recorder._clips
    recorder = clips._clip.live.recorders[0] if clips else env.video_recorder
    writer = recorder._sink._writer
    while writer._encoding._encoded < writer.frame_count:
        time.sleep(0.001)
    return writer._encoding

def die(env=None):
    env and encoding(env)
    os.kill(os.getpid(), signal.SIGKILL)

"""


def kill(code, directory):
    """Run a program that kills itself, and return its directory."""
    others = held_in(directory)
    run_python(PROGRAM + code, directory, status=-signal.SIGKILL)
    # Between fork and exec, a child briefly holds its parent's lock.
    wait_until(lambda: held_in(directory) <= others)
    return directory


def held_in(directory):
    return set(filter(is_locked, directory.glob(".*.lock")))


@pytest.fixture(scope="module")
def cut_off(tmp_path_factory):
    """Return a run with two live episodes, 7 steps of a third, and provenance."""
    directory = tmp_path_factory.mktemp("cut") / "run"
    kill(
        "from mjrec.provenance import look_around\nenv = monitor()\nrun(env)\n"
        "look_around().found(wait=True)\nrun(env)\nrun(env, 7)\ndie(env)",
        directory,
    )
    # The encoder briefly outlives its process, and a half-written copy is useless.
    wait_until(lambda: not any(map(is_locked, directory.glob(".*.part"))))
    return directory


@pytest.fixture
def cut(cut_off, tmp_path):
    """Return a copy of `cut_off`."""
    return Path(shutil.copytree(cut_off, tmp_path / "cut"))


def results_of(directory):
    """Return the results without the names of their source files."""
    results = mjrec.load_results(directory)
    assert results is not None
    del results["manifests"]
    return {**results, "videos": sorted(results["videos"])}


def assert_in_order(directory):
    """Check that nothing is left to do and no log or hidden file remains."""
    before = {path.name: path.read_bytes() for path in directory.iterdir()}
    again = mjrec.recover(directory)
    assert not again
    assert str(again) == f"Nothing to recover in {directory}."
    assert {path.name: path.read_bytes() for path in directory.iterdir()} == before
    ends = (".log", ".tail", ".looks")
    assert not [name for name in before if name.startswith(".") or name.endswith(ends)]


# --- live ----------------------------------------------------------------------------


def test_a_live_video_is_whole_up_to_the_kill(cut):
    """Every frame that reached the encoder is there, in order, with its hash."""
    before = results_of(cut)
    recovery = mjrec.recover(cut)
    assert not recovery.failures, str(recovery)
    assert "video000002.mp4: 8 frames, incomplete: killed" in str(recovery)
    after = results_of(cut)
    assert {**after, "videos": after["videos"][:2]} == before
    assert videos_in(cut) == [0, 1, 2]
    shown = [(frame[0, :, 0] > 128).sum() for frame in frames_in(cut, 2)]
    assert shown == [*range(4, 36, 4)]
    metadata, whole = metadata_of(cut, 2), metadata_of(cut, 1)
    assert (metadata["complete"], metadata["reason"]) == (False, "killed")
    assert (metadata["frame_count"], metadata["frame_steps"]) == (8, [[0, 7]])
    assert set(whole) - set(metadata) == {"terminated", "truncated"}
    assert metadata["length"] == 7
    differs = {key for key in whole if metadata.get(key) != whole[key]}
    assert differs - {"length", "reward", "terminated", "truncated"} == {
        *("episode_id", "complete", "frame_count", "frame_steps", "encoder_version"),
        *("file_sha256", "decoded_sha256"),
    }
    texts = [path.read_text().splitlines() for path in sorted(cut.glob("*.framehash"))]
    assert texts[2] == texts[1][: 9 + 8]
    # Everything known about the run is there, including its provenance.
    assert stats_of(cut)["timestamps"] == [e["end_time"] for e in journal_of(cut)]
    manifest = manifest_of(cut)
    assert manifest["env_info"] == {"gym_version": "mjrec-1", "env_id": "Corridor-v0"}
    assert [video for video, _ in manifest["videos"]] == sorted(
        path.name for path in cut.glob("*.mp4")
    )
    [provenance] = events_of(cut, "provenance")
    assert provenance["packages"]
    assert manifest["mjrec"].pop("versions")["mjrec"] == mjrec.__version__
    assert manifest["mjrec"] == {
        "provenance": provenance,
        "format_version": 1,
        "schedule": {"name": "always", "recorded": [0, 1, 2]},
        "first_episode_id": 0,
        "next_episode_id": 3,
        "pending": [],
        "broken": [],
        "faults": [],
        "recovered": True,
    }
    assert_in_order(cut)


@pytest.mark.parametrize("encoded", [0, 5])
def test_hashes_of_frames_that_never_reached_the_encoder_are_left_out(
    encoded, tmp_path
):
    """A video without frames is empty, not broken."""
    directory = kill(
        "import mjrec.formats.video_file as v\n"
        "write, count = v.FfmpegProcess.write, iter(range(9))\n"
        "def some(process, data):\n"
        "    is_frame = not isinstance(data, bytes)\n"
        f"    is_last = is_frame and next(count) == {encoded}\n"
        "    die() if is_last else write(process, data)\n"
        "v.FfmpegProcess.write = some\nenv = monitor()\nrun(env)\n"
        "env.video_recorder.close()\n",
        tmp_path / "run",
    )
    mjrec.recover(directory)
    metadata = metadata_of(directory, 0)
    assert videos_in(directory) == [0] * bool(encoded)
    assert manifest_of(directory)["mjrec"]["broken"] == []
    if encoded:
        [hashes] = directory.glob("*.framehash")
        assert len(frames_in(directory, 0)) == len(hashes_at(hashes)) == encoded
        assert metadata["frame_steps"] == [[0, encoded - 1]]
    else:
        assert metadata["empty"]
        assert "broken" not in metadata
    assert_in_order(directory)


def test_a_text_recording_that_was_cut_off_is_finished(tmp_path):
    """The file has every frame, and the facts of a whole one."""
    directory = kill(
        "env = monitor(Corridor(12, 'ansi'))\nrun(env)\nrun(env, 7)\ndie()",
        tmp_path / "run",
    )
    recovery = mjrec.recover(directory)
    paths = sorted(directory.glob("*.video00000?.json"))
    whole, cut = (json.loads(path.read_text()) for path in paths)
    assert (cut.keys(), cut["stdout"]) == (whole.keys(), whole["stdout"][:8])
    metadata, known = metadata_of(directory, 1), metadata_of(directory, 0)
    assert (metadata["complete"], metadata["reason"]) == (False, "killed")
    assert (metadata["fps"], metadata["frame_steps"]) == ("10", [[0, 7]])
    assert known.keys() - metadata.keys() == {"terminated", "truncated"}
    assert "8 frames, incomplete: killed" in str(recovery)
    assert_in_order(directory)


def test_a_text_recording_without_metadata_gets_it(tmp_path):
    """The process was killed after the file got its final name."""
    directory = kill(
        "import mjrec.formats.video_sink as s\ns.write_metadata = lambda *_: die()"
        "\nenv = monitor(Corridor(12, 'ansi'))\nrun(env)",
        tmp_path / "run",
    )
    recovery = mjrec.recover(directory)
    assert "video000000.json: 13 frames" in str(recovery)
    metadata = metadata_of(directory, 0)
    assert (metadata["complete"], metadata["frame_steps"]) == (True, [[0, 12]])
    assert_in_order(directory)


@pytest.mark.parametrize(
    ("options", "then", "is_fed"),
    [
        ("", "encoding.temporary.write_bytes(b'ftyp' + bytes(900))", True),
        ("video_length=60", "encoding.temporary.write_bytes(b'')", True),
        # The end of an episode must not be taken for the end of a clip.
        ("video_length=60", "encoding._hashes.truncate(0)", False),
    ],
)
def test_a_killed_encoder_is_reported(options, then, is_fed, tmp_path):
    """There is no video, its metadata says why, and its bytes are kept.

    An encoder that was given no frame is not reported as killed.
    """
    directory = kill(
        f"env = monitor({options})\nrun(env)\nrun(env, 7)\n"
        "encoding = encoding(env)\nos.kill(encoding._process.pid, signal.SIGKILL)\n"
        f"{then}\ndie()",
        tmp_path / "run",
    )
    recovery = mjrec.recover(directory)
    number = 0 if options else 1
    assert videos_in(directory) == [0][:number]
    metadata = metadata_of(directory, number)
    assert metadata["empty"]
    assert ("its encoder" in metadata.get("broken_reason", "")) is is_fed
    assert (metadata["complete"], metadata["reason"]) == (False, "killed")
    for part in directory.glob(".*.mp4.????????.part"):
        assert part.name in str(recovery)
    assert not mjrec.recover(directory)
    assert any(directory.glob(".*.mp4.????????.part")) is is_fed
    assert len(manifest_of(directory)["mjrec"]["broken"]) == ("ftyp" in then)


def test_an_encoder_that_outlives_its_process_is_waited_for(tmp_path):
    """A recovery with a short timeout reports a failure while another one waits."""
    directory = kill(
        "env = monitor()\nrun(env, 7)\npid = encoding(env)._process.pid\n"
        "os.kill(pid, signal.SIGSTOP)\nopen(sys.argv[1] + '.pid', 'w')"
        ".write(str(pid))\n"
        "die()",
        tmp_path / "run",
    )
    with ThreadPoolExecutor() as threads:
        patient = threads.submit(mjrec.recover, directory, timeout=60)
        try:
            recovery = mjrec.recover(directory, timeout=0.1)
            assert len(recovery.failures) == 1
            assert "still finishing" in str(recovery)
            assert videos_in(directory) == []
            assert not patient.done()
        finally:
            os.kill(int(directory.with_suffix(".pid").read_text()), signal.SIGCONT)
        assert patient.result().failures == ()
    assert len(frames_in(directory, 0)) == 8
    assert len(manifest_of(directory)["videos"]) == 1
    assert_in_order(directory)


# --- deferred ------------------------------------------------------------------------


def test_a_closed_monitors_logs_become_trajectories(tmp_path, halfcheetah):
    """Pending videos stay, and the journal restores a damaged manifest."""
    monitor = mjrec.Monitor(halfcheetah, tmp_path, workers=0)
    monitor.reset(seed=0)
    monitor.step(monitor.action_space.sample())
    monitor.close(wait=False)
    before, manifest = results_of(tmp_path), manifest_of(tmp_path)
    [path] = in_flight(tmp_path)
    assert mjrec.recover(tmp_path)
    assert path.exists()
    assert not list(tmp_path.glob("openaigym.states.*"))
    assert manifest_of(tmp_path) == manifest
    assert_in_order(tmp_path)
    next(tmp_path.glob("*.manifest.json")).write_text("{garbage")
    assert mjrec.recover(tmp_path)
    assert results_of(tmp_path) == before
    assert len(manifest_of(tmp_path)["mjrec"]["pending"]) == 1
    assert_in_order(tmp_path)


def test_a_killed_deferred_run_keeps_its_provenance(tmp_path):
    """The list of packages and the policy's digest survive recovery and rendering."""
    policy = tmp_path / "policy.pt"
    policy.write_bytes(b"weights")
    directory = kill(
        "import gymnasium\nfrom mjrec.provenance import look_around\n"
        "env = gymnasium.make('InvertedPendulum-v5', max_episode_steps=2, width=48,"
        f" height=32)\nenv = monitor(env, workers=0, policy_file={str(policy)!r})\n"
        "look_around().found(wait=True)\nrun(env, 2)\nrun(env, 1)\ndie()",
        tmp_path / "run",
    )
    recovery = mjrec.recover(directory)
    assert "1 step, incomplete: killed" in str(recovery)
    pending = manifest_of(directory)["mjrec"]["pending"]
    assert [each["episode_id"] for each in pending] == [0, 1]
    assert not mjrec.render_videos(directory, workers=1).failures
    assert [len(frames_in(directory, number)) for number in (0, 1)] == [3, 2]
    assert metadata_of(directory, 1)["reason"] == "killed"
    provenance = manifest_of(directory)["mjrec"]["provenance"]
    assert provenance["packages"]
    digest = hashlib.sha256(b"weights").hexdigest()
    assert provenance["policy"] == {"file": str(policy), "sha256": digest}
    assert_in_order(directory)


def test_recovery_does_not_wait_for_rendering(tmp_path):
    """Another process may be rendering a pending video of the killed monitor."""
    directory = kill(
        "import gymnasium\nenv = gymnasium.make('InvertedPendulum-v5', width=48,"
        " height=32, max_episode_steps=2)\n"
        "run(monitor(env, workers=0), 2)\ndie()",
        tmp_path,
    )
    [log] = directory.glob("openaigym.states.*.log")
    infix = infix_of(log.name)
    # The process that renders a video holds this lock.
    with try_lock(directory / f".{video_prefix(infix, 0)}.lock"):
        mjrec.recover(directory, timeout=3600)
    # The renderer finishes its own recording.
    assert manifest_of(directory)["videos"] == []


# --- journal and logs ----------------------------------------------------------------


def test_an_older_manifest_is_brought_up_to_date(tmp_path):
    """Facts that no other file has are kept."""
    code = "env = monitor(write_upon_reset=True)\nrun(env)\nrun(env)\ndie()"
    directory = kill(code, tmp_path / "run")
    assert stats_of(directory)["episode_lengths"] == [12]
    start = stats_of(directory)["initial_reset_timestamp"]
    mjrec.recover(directory)
    assert stats_of(directory)["episode_lengths"] == [12, 12]
    assert stats_of(directory)["initial_reset_timestamp"] == start
    details = manifest_of(directory)["mjrec"]
    assert details["schedule"] == {"name": "always", "recorded": [0, 1]}
    assert details["recovered"] is True
    assert_in_order(directory)


def test_a_log_of_unknown_rows_stays_and_is_reported(tmp_path):
    """A log that no journal mentions stays; one without rows is removed."""
    write_log(tmp_path, 0)
    [journal] = tmp_path.glob("*.jsonl")
    journal.write_bytes(b"")
    unknown, empty, stray = (tmp_path / log_name(INFIX, number) for number in range(3))
    empty.touch()
    stray.with_suffix(".tail").touch()
    recovery = mjrec.recover(tmp_path)
    for log in (empty, stray):
        assert f"{log.name}: nothing in flight, removed" in str(recovery)
    assert [path.name for path in tmp_path.glob("*.states.*")] == [unknown.name]
    assert [file.name for file in recovery.failures] == [unknown.name]
    assert unknown.stat().st_size
    mjrec.clear_monitor_files(tmp_path)
    assert not list(tmp_path.iterdir())


# --- others --------------------------------------------------------------------------


def test_only_the_killed_monitors_files_are_touched(cut, corridor, play):
    """A living monitor in the same directory is not disturbed."""

    def own(infix):
        return {p.name: p.read_bytes() for p in cut.iterdir() if infix in p.name}

    with mjrec.Monitor(
        corridor, cut, lambda _: True, resume=True, env_id="Corridor-v0"
    ) as living:
        # Resuming has recovered the dead monitor.
        assert videos_in(cut) == [0, 1, 2]
        assert living.episode_id == 3
        play(living, 1)
        kill("env = monitor(resume=True)\nrun(env, 5)\ndie(env)", cut)
        before = own(living.infix)
        recovery = mjrec.recover(cut)
        assert recovery.files
        assert recovery.open_monitors == (living.infix,)
        assert living.infix in str(recovery)
        assert own(living.infix) == before
        play(living, 1)
    assert_in_order(cut)


def test_unfinished_files_of_a_dead_renderer_are_removed(tmp_path):
    """Unfinished files of a living renderer are kept."""
    for number in (0, 1):
        write_log(tmp_path, number)
    mjrec.recover(tmp_path)
    dead, living = (
        [
            tmp_path / f".{video_prefix(INFIX, number)}.{kind}.0123abcd.part"
            for kind in ("framehash", "mp4", "mp4.note.part")
        ]
        for number in (0, 1)
    )
    side = tmp_path / f".{video_prefix(INFIX, 0)}.side.mp4.0123abcd.part"
    for part in [*dead, *living]:
        part.touch()
    renderer = try_lock(tmp_path / f".{video_prefix(INFIX, 1)}.lock")
    assert renderer is not None
    drawn = Lock(side, "")
    # This file may belong to an open monitor.
    model = tmp_path / ".openaigym.model.0123456789abcdef.zip.0123abcd.part"
    model.touch()
    monitor = Lock(tmp_path / lock_name("1.7"), "")
    recovery = mjrec.recover(tmp_path, timeout=0)
    assert sorted(file.name for file in recovery.files) == [p.name for p in dead]
    assert not any(part.exists() for part in dead)
    assert all(part.exists() for part in [*living, side, model])
    renderer.release()
    drawn.let_go()
    # Release the lock like a killed monitor that had recorded nothing.
    monitor.let_go()
    mjrec.recover(tmp_path)
    assert not [p.name for p in [*living, side, model] if p.exists()]
    assert_in_order(tmp_path)


def test_two_recoveries_at_once_do_the_work_once(cut):
    """The second recovery waits for the first and finds nothing to do."""
    command = [sys.executable, "-m", "mjrec", "recover", str(cut)]
    both = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)
    ]
    said = sorted(process.communicate()[0] for process in both)
    assert [process.returncode for process in both] == [0, 0]
    assert said[0] == f"Nothing to recover in {cut}.\n"
    assert said[1].count("video000002.mp4") == 1
    assert_in_order(cut)


def test_what_cannot_be_recovered_is_one_error(cut):
    """Each bad directory or timeout is an error, and nothing is half done."""
    with pytest.raises(mjrec.InvalidArgument, match="not a directory"):
        mjrec.recover(cut / "missing")
    for wrong in (-1, float("nan"), "5", True):
        with pytest.raises(mjrec.InvalidArgument, match="timeout"):
            mjrec.recover(cut, timeout=wrong)
    before = sorted(cut.iterdir())
    # Permissions do not stop root, so put a directory where the lock file belongs.
    blocker = cut / ".openaigym.recover.lock"
    blocker.mkdir()
    with pytest.raises(mjrec.DirectoryNotWritable, match=str(cut)):
        mjrec.recover(cut)
    blocker.rmdir()
    assert sorted(cut.iterdir()) == before


def test_gyms_own_directories_are_left_alone(tmp_path):
    """Gym manifests cannot be restored, and HDF5 is not even loaded."""
    names = [
        "openaigym.episode_batch.0.77.stats.json",
        "openaigym.video.0.77.video000000.meta.json",
        "openaigym.video.0.77.video000000.mp4",
    ]
    for name in names:
        (tmp_path / name).write_text("{}")
    code = "print(bool(mjrec.recover(sys.argv[1])), 'h5py' in sys.modules)"
    assert run_python(f"import sys, mjrec\n{code}", tmp_path).stdout == "False False\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == names
