# SPDX-License-Identifier: Apache-2.0
"""Kill a recorder or a finisher between any two changes to its files."""

import itertools
import shutil
import signal
from pathlib import Path

import gymnasium
import pytest
from other_python import run_python
from parts import parametrize
from recordings import frames_in, manifest_of, metadata_of, stats_of
from result_files import entry, write_journal
from trajectories_by_hand import INFIX, write_log
from waiting import wait_until

import mjrec
from mjrec.formats.locks import is_locked
from mjrec.formats.monitor_directory import lock_name
from mjrec.rendering.finish import finish

START = f"""
import os, signal, sys, time
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parent)!r})
import mjrec
from processes import kill_self as die
directory, place = sys.argv[1], sys.argv[2]

def before(owner, name, when=lambda *_: True):
    known = getattr(owner, name)
    def function(*arguments, **options):
        if when(*arguments):
            die()
        return known(*arguments, **options)
    setattr(owner, name, function)

"""


def run(program, directory, place):
    """Run a program, and return whether it was killed before it finished."""
    done = run_python(START + program, directory, place, status=None)
    assert done.returncode in (0, -signal.SIGKILL), done.stderr
    # An encoder briefly outlives its process.
    wait_until(lambda: not any(map(is_locked, directory.glob(".*.part"))))
    return done.returncode != 0


# This kills the process before a rename, link, removal or opening for writing.
COUNT = """
left = int(place)

def count(event, arguments):
    global left
    changes = event in ("os.rename", "os.remove", "os.link") or (
        event == "open" and isinstance(arguments[2], int) and arguments[2] & os.O_CREAT
    )
    if changes and str(arguments[0]).startswith(directory):
        if not left:
            die()
        left -= 1

sys.addaudithook(count)
"""
FINISH = f"""
from mjrec.rendering import finish
from trajectories_by_hand import Painter

finish.WorkerPool = lambda count, **rest: Painter()
{COUNT}
for result in finish.finish(Path(directory), workers=1):
    assert not result.failures, result
"""


FINISH_REALLY = """
from mjrec.formats import video_file, video_sink
from mjrec.rendering import finish, pool

def is_video(path, to):
    return str(to).endswith(".mp4")

owner, name, *when = {
    "before the video's name": (Path, "replace", is_video),
    "before drawing": (pool.WorkerPool, "frames"),
    "while a worker draws": (video_sink.VideoSink, "write"),
    "before ffmpeg's end": (video_file.Encoding, "finish"),
    "between ffmpeg's end and the names": (video_file.Encoding, "_checked"),
    "between the video's name and the metadata": (video_sink, "write_metadata"),
    "before the manifest": (finish, "update_manifests"),
}[place]
before(owner, name, *when)
list(finish.finish(Path(directory), workers=1))
"""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Return a directory with a pending video, and a rendered copy."""
    pending = tmp_path_factory.mktemp("rendered") / "pending"
    env = gymnasium.make("InvertedPendulum-v5", height=32, width=48)
    with mjrec.Monitor(env, pending, workers=0) as monitor:
        monitor.reset(seed=0)
        for _ in range(4):
            monitor.step([0.0])
    done = pending.with_name("done")
    shutil.copytree(pending, done)
    assert not mjrec.render_videos(done, workers=1).failures
    return pending, done


# Takes more than five seconds: two finishers with a worker each.
@parametrize(
    "place",
    [
        "before the video's name",
        "before drawing",
        "while a worker draws",
        "before ffmpeg's end",
        "between ffmpeg's end and the names",
        "between the video's name and the metadata",
        "before the manifest",
    ],
    part=pytest.mark.crashes,
)
def test_a_finisher_killed_beside_its_worker_is_taken_up_again(
    place, tmp_path, rendered
):
    """The next finisher leaves the same files as one that was never killed."""
    pending, done = rendered
    directory = tmp_path / "run"
    shutil.copytree(pending, directory)
    assert run(FINISH_REALLY, directory, place)
    assert manifest_of(directory)["mjrec"]["pending"]
    assert not mjrec.render_videos(directory, workers=1).failures
    assert contents(directory) == contents(done)
    assert manifest_of(done)["mjrec"]["pending"] == []


EVERY_EIGHTH = [range(first, 100, 8) for first in range(8)]


# Takes more than five seconds: a process finishes for each moment.
@parametrize("moments", EVERY_EIGHTH, part=pytest.mark.crashes)
def test_a_finisher_killed_at_any_change_of_a_file_is_taken_up_again(
    moments, tmp_path, painter
):
    """The monitor is dead, and only one of its two trajectories is kept."""
    for moment in moments:
        directory = tmp_path / str(moment)
        directory.mkdir()
        (directory / lock_name(INFIX)).touch()
        lines = []
        for number, kept in ((0, True), (1, False)):
            write_log(directory, number, kept=kept, start_time=9.0)
            facts = {"terminated": False, "truncated": True, "recording": "deferred"}
            lines.append(entry(number, length=4, reward=2.0, chosen=True, **facts))
        # The dead monitor had not yet written the second line.
        write_journal(directory, str(INFIX), lines[0])
        was_killed = run(FINISH, directory, moment)
        assert not any(each.failures for each in finish(directory, workers=1))
        assert [len(frames_in(directory, number)) for number in (0, 1)] == [5, 5]
        assert all(metadata_of(directory, number)["complete"] for number in (0, 1))
        assert len(list(directory.glob("*.framehash"))) == 2
        assert [p.name[-4:] for p in directory.glob("*.h5")] == ["0.h5"]
        manifest = manifest_of(directory)
        assert len(manifest["videos"]) == 2
        assert manifest["mjrec"]["pending"] == []
        assert not list(directory.glob(".*")) + list(directory.glob("*.states.*"))
        assert not mjrec.recover(directory)
        if not was_killed:
            break
    else:
        pytest.fail("there were more changes than moments")


# This records one episode and part of another, and waits for the encoder.
CUT = """
from conftest import Corridor
env = mjrec.Monitor(
    Corridor(4, place), directory, lambda _: True, env_id="Short-v0", name_prefix="a"
)
for steps in (4, 2):
    env.reset(seed=0)
    for _ in range(steps):
        env.step(1)
writer = env.video_recorder._sink._writer
while place == "rgb_array" and writer._encoding._encoded < writer.frame_count:
    time.sleep(0.001)
die()
"""
RECOVER = f"""
{COUNT}
assert not mjrec.recover(directory).failures
"""


def contents(directory):
    """Return each file's content without the journal's line about a recovery."""
    files = {path.name: path.read_bytes() for path in directory.iterdir()}
    said = b'{"recovered": {}}\n'
    return {name: content.replace(said, b"") for name, content in files.items()}


# Takes more than five seconds: a process recovers for each moment.
@parametrize(
    ("mode", "moments"),
    itertools.product(("rgb_array", "ansi"), EVERY_EIGHTH),
    part=pytest.mark.crashes,
)
def test_a_recovery_killed_at_any_change_of_a_file_is_taken_up_again(
    mode, moments, tmp_path
):
    """The next recovery leaves the same files as one that was never killed."""

    def copied(name):
        shutil.copytree(tmp_path / "cut", tmp_path / name)
        # A hard link becomes a separate file when copied.
        for link in (tmp_path / name).glob("a-*"):
            link.unlink()
        return tmp_path / name

    assert run(CUT, tmp_path / "cut", mode)
    whole = copied("whole")
    assert not mjrec.recover(whole).failures
    assert len(manifest_of(whole)["videos"]) == 2
    for moment in moments:
        directory = copied(str(moment))
        was_killed = run(RECOVER, directory, moment)
        assert not mjrec.recover(directory).failures
        assert contents(directory) == contents(whole)
        assert not mjrec.recover(directory)
        if not was_killed:
            break
    else:
        pytest.fail("there were more changes than moments")


RECORD = """
import gymnasium
from conftest import Corridor
import mjrec.formats.row_log
from mjrec.formats import video_file, video_metadata, video_sink
from mjrec.formats.journal import JournalWriter

def half_a_line(descriptor, line):
    if bytes(line).startswith(b'{"episode_id": 1,'):
        written(descriptor, line[:40])
        die()
    return written(descriptor, line)

def fed(encoding):
    # What waits for the encoder is lost with the process.
    while encoding._encoded < 3:
        time.sleep(0.001)
    return True

second = lambda *arguments: "video000001" in str(
    [getattr(each, "path", each) for each in arguments]
)
if place == "before the journal's line":
    before(JournalWriter, "append", lambda _, entry: entry.episode_id == 1)
elif place == "in the journal's line":
    written = os.write
    os.write = half_a_line
elif place == "before the tail is written":
    before(mjrec.formats.row_log.RowLog, "write")
elif place == "where no tail is mapped":
    mjrec.formats.row_log._may_be_mapped = lambda _: False
    before(JournalWriter, "append", lambda _, entry: entry.episode_id == 1)
elif place == "before ffmpeg's end":
    before(video_file.Encoding, "finish", lambda e: second(e._file) and fed(e))
elif place == "between ffmpeg's end and the names":
    before(video_file.Encoding, "_checked", lambda e: second(e._file))
elif place == "between the hashes' name and the video's":
    before(Path, "replace", lambda p, to: second(to) and str(to).endswith(".mp4"))
elif place == "between the video's name and the metadata":
    before(video_sink, "write_metadata", second)

render = "live" if place in LIVE else "deferred"
env = Corridor(length=4)
if render == "deferred":
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=4)
with mjrec.Monitor(
    env, directory, lambda _: True, env_id="Short-v0", render=render, workers=0,
    max_fps=4 if render == "live" else None,
) as monitor:
    for _ in range(2):
        monitor.reset(seed=0)
        for _ in range(4):
            monitor.step(monitor.action_space.sample() * 0 + (render == "live"))
"""
DEFERRED = ("before the journal's line", "in the journal's line")
DEFERRED += ("before the tail is written", "where no tail is mapped")
LIVE = (
    "before ffmpeg's end",
    "between ffmpeg's end and the names",
    "between the hashes' name and the video's",
    "between the video's name and the metadata",
)


@parametrize("place", [*DEFERRED, *LIVE], default=8)
def test_a_recorder_killed_between_two_things_loses_no_episode(place, tmp_path):
    """It does not matter which of the rows, journal, encoder and names came first."""
    assert run(f"LIVE = {LIVE!r}\n{RECORD}", tmp_path, place)
    assert not mjrec.recover(tmp_path).failures
    assert not mjrec.recover(tmp_path)
    lengths = stats_of(tmp_path)["episode_lengths"]
    assert lengths == [4, 4]
    assert [each.length for each in mjrec.iter_episodes(tmp_path)] == lengths
    if place in LIVE:
        assert [len(frames_in(tmp_path, number)) for number in (0, 1)] == [3, 3]
        facts = [metadata_of(tmp_path, number) for number in (0, 1)]
        # At most four frames a second are shown, plus the last one.
        assert [each["frame_steps"] for each in facts] == [[[0, 3], [4, 4]]] * 2
    else:
        paths = sorted(tmp_path.glob("*.h5"))
        facts = [mjrec.load_trajectory(path).facts for path in paths]
    assert [(each["complete"], each["length"]) for each in facts] == [(True, 4)] * 2
    assert not list(tmp_path.glob(".*"))
