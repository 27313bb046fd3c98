# SPDX-License-Identifier: Apache-2.0
"""When recording fails, the simulation stops or continues, as the user chose."""

import contextlib
import os
import shutil
from unittest import mock

import gymnasium
import pytest
from full_disk import file_size_limit
from recordings import (
    frames_in,
    in_flight,
    journal_of,
    manifest_of,
    metadata_of,
    stats_of,
)
from waiting import wait_until

import mjrec
from mjrec import EncoderError, FileNotWritten, Monitor, RenderError
from mjrec.formats.span_writer import SpanWriter

both_ways = pytest.mark.parametrize("on_error", ["raise", "warn"])


@pytest.fixture
def out(tmp_path):
    """Return the directory for recordings."""
    return tmp_path / "run"


@pytest.fixture
def pendulum(out):
    """Return a function that makes monitored pendulums that stay up for eight steps."""

    def make(schedule=lambda _: True, **options):
        size = {"height": 32, "width": 48, "max_episode_steps": 8}
        env = gymnasium.make("InvertedPendulum-v5", render_mode="rgb_array", **size)
        return Monitor(env, out, schedule, **options)

    return make


def run(monitor, steps=8):
    """Reset, then take some steps."""
    monitor.reset(seed=0)
    go_on(monitor, steps)


def go_on(monitor, steps):
    """Take more steps without a reset."""
    for _ in range(steps):
        monitor.step(monitor.action_space.sample() * 0)


def raised(on_error, kind, match):
    """Expect an error with `on_error="raise"`, and none with "warn"."""
    if on_error == "raise":
        return pytest.raises(kind, match=match)
    return contextlib.nullcontext()


def faults_of(directory):
    found = manifest_of(directory)["mjrec"]["faults"]
    assert all(fault["reason"] for fault in found)
    return [(fault["episode_id"], fault["what"]) for fault in found]


# --- live videos ---------------------------------------------------------------------


def test_a_schedule_that_raises_breaks_no_finished_video(pendulum, out):
    """The previous episode has ended, and its video stays whole."""

    def schedule(episode):
        if episode == 1:
            raise RuntimeError("no idea")
        return True

    with pendulum(schedule, render="live", on_error="warn") as monitor:
        for _ in range(3):
            run(monitor)
    assert [len(frames_in(out, episode)) for episode in (0, 2)] == [9, 9]
    details = manifest_of(out)["mjrec"]
    assert details["broken"] == []
    assert [fault["reason"] for fault in details["faults"]] == ["no idea"]


def test_a_trigger_that_raises_stops_no_simulation(pendulum, out):
    """The trigger is asked again at the next step."""

    def trigger(steps):
        if steps == 2:
            raise RuntimeError("no idea")
        return steps == 4

    options = {"step_trigger": trigger, "video_length": 2}
    with pendulum(None, on_error="warn", workers=1, **options) as monitor:
        run(monitor)
    assert [path.name[-14:] for path in out.glob("*.mp4")] == ["step000004.mp4"]
    assert [f["reason"] for f in manifest_of(out)["mjrec"]["faults"]] == ["no idea"]


def test_a_dead_encoder(pendulum, out, kill_ffmpeg, caplog):
    """There is one error or one warning, and the next video is whole."""
    monitor = pendulum(render="live")
    run(monitor, 4)
    assert kill_ffmpeg() == 1
    with pytest.raises(EncoderError, match="exit status: -9"):
        go_on(monitor, 4)
    monitor.close()
    monitor = pendulum(render="live", on_error="warn", force=True)
    run(monitor, 4)
    assert kill_ffmpeg() == 1
    go_on(monitor, 4)
    run(monitor)
    monitor.close()
    assert faults_of(out) == [(0, "video")]
    assert "-9" in metadata_of(out, 0)["broken_reason"]
    assert len(frames_in(out, 1)) == 9
    details = manifest_of(out)
    assert (len(details["videos"]), len(details["mjrec"]["broken"])) == (1, 1)
    assert stats_of(out)["episode_lengths"] == [8, 8]
    assert caplog.text.count("Incomplete recording") == 1


@both_ways
def test_an_environment_that_cannot_be_drawn_any_more(
    on_error, pendulum, out, monkeypatch
):
    """The video ends, and a reset lets the simulation continue after an error."""
    monitor = pendulum(render="live", on_error=on_error)
    run(monitor, 4)
    why = "the window is gone"
    with monkeypatch.context() as patch, raised(on_error, RuntimeError, why):
        error = mock.Mock(side_effect=RuntimeError(why))
        patch.setattr(monitor.unwrapped, "render", error)
        go_on(monitor, 4)
    run(monitor)
    monitor.close()
    metadata = metadata_of(out, 0)
    if on_error == "raise":
        assert metadata["exception"]["message"] == why
    else:
        assert metadata["broken_reason"] == why
        assert len(frames_in(out, 0)) == 5


@both_ways
def test_videos_that_cannot_be_rendered(on_error, pendulum, out, monkeypatch, caplog):
    """The videos stay pending, and the trajectories exist."""
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    monitor = pendulum(workers=1, on_error=on_error)
    run(monitor)
    with raised(on_error, RenderError, "video"):
        monitor.close()
    assert on_error == "raise" or "could not be rendered" in caplog.text
    pending = manifest_of(out)["mjrec"]["pending"]
    assert [each["episode_id"] for each in pending] == [0]
    assert list(out.glob("*.h5"))


# --- full disks ----------------------------------------------------------------------


@both_ways
def test_a_full_disk_while_an_episode_is_recorded(on_error, pendulum, out):
    """The trajectory ends at that step, and earlier recordings stay whole."""
    monitor = pendulum(workers=0, on_error=on_error)
    run(monitor)
    # A background thread must store the model while there is room.
    wait_until(lambda: list(out.glob("*.mjb.gz")))
    with file_size_limit(200), raised(on_error, FileNotWritten, "Cannot write"):
        run(monitor)
    while not monitor.stats_recorder.done:
        go_on(monitor, 1)
    run(monitor)
    monitor.close()
    assert stats_of(out)["episode_lengths"] == [8, 8, 8]
    assert (1, "trajectory") in faults_of(out)
    # An episode without rows leaves no file, even with room when it ended.
    assert not list(out.glob("*episode000001*"))
    pending = manifest_of(out)["mjrec"]["pending"]
    assert [each["episode_id"] for each in pending] == [0, 2]
    [path] = out.glob("*episode000002.h5")
    assert len(mjrec.load_trajectory(path).rewards) == 8


@both_ways
def test_a_full_disk_at_the_journal(on_error, pendulum, out):
    """Missing lines are written as soon as there is room again."""
    monitor = pendulum(render="off", trajectory_callable=False, on_error=on_error)
    run(monitor)
    [journal] = out.glob("*.jsonl")
    limit = file_size_limit(journal.stat().st_size + 20)
    with limit, raised(on_error, OSError, "episodes"):
        run(monitor)
    run(monitor)
    monitor.close()
    assert stats_of(out)["episode_lengths"] == [8, 8, 8]
    assert [entry["episode_id"] for entry in journal_of(out)] == [0, 1, 2]
    assert faults_of(out) == [(1, "journal")]


@both_ways
@pytest.mark.parametrize("what", ["note", "metadata"])
def test_a_full_disk_at_a_live_video(what, on_error, make_corridor, out):
    """After closing with room again, metadata is complete and nothing is left to do."""
    options = {"on_error": on_error, "name_prefix": "rl-video"}
    monitor = Monitor(make_corridor(4), out, lambda _: True, **options)
    run(monitor, 4)
    [metadata] = out.glob("openaigym.*.meta.json")
    errors = []
    with file_size_limit(metadata.stat().st_size - 10 if what == "metadata" else 300):
        monitor.reset()
        for _ in range(4):
            try:
                go_on(monitor, 1)
            except FileNotWritten as error:
                errors.append(error)
    assert bool(errors) == (on_error == "raise")
    run(monitor, 4)
    monitor.close()
    manifest = manifest_of(out)
    is_whole = what == "metadata"
    assert len(manifest["videos"]) == 2 + is_whole
    assert len(manifest["mjrec"]["broken"]) == 1 - is_whole
    assert (1, "video") in faults_of(out)
    assert metadata_of(out, 1)["complete"] is True
    assert (out / "rl-video-episode-1.mp4").exists() == is_whole
    assert not list(out.glob(".*"))
    assert not mjrec.recover(out)


@both_ways
def test_a_full_disk_is_named_though_the_process_ends(on_error, out):
    """The recovered trajectory of a completed episode names the full disk."""
    child = os.fork()
    if child == 0:
        env = gymnasium.make("HalfCheetah-v5", max_episode_steps=300)
        monitor = Monitor(env, out, mode="evaluation", workers=0, on_error=on_error)
        # The first step creates the log.
        run(monitor, 1)
        full = FileNotWritten(out, "full")
        # There is room for journal lines, but not for rows.
        with (
            file_size_limit(100_000),
            mock.patch.object(SpanWriter, "end", side_effect=full),
        ):
            for _ in range(299):
                with contextlib.suppress(FileNotWritten):
                    go_on(monitor, 1)
        os._exit(0)
    os.waitpid(child, 0)
    mjrec.recover(out)
    assert stats_of(out)["episode_lengths"] == [300]
    [path] = out.glob("*.h5")
    facts = mjrec.load_trajectory(path).facts
    assert (facts["complete"], facts["reason"]) == (False, "exception")
    assert ".log" in facts["exception"]["message"]
    assert (0, "trajectory") in faults_of(out)


def test_a_disk_without_any_room(pendulum, out):
    """Nothing stays pending, and results are written once there is room."""
    monitor = pendulum(workers=0, on_error="warn")
    with file_size_limit(0):
        run(monitor)
        with pytest.raises(FileNotWritten):
            monitor.close()
    monitor.close()
    assert stats_of(out)["episode_lengths"] == [8]
    assert (0, "trajectory") in faults_of(out)
    assert manifest_of(out)["mjrec"]["pending"] == []
    assert in_flight(out) == []
    before = manifest_of(out)
    mjrec.render_videos(out, workers=1)
    assert manifest_of(out) == before


# --- removed directories -------------------------------------------------------------


@pytest.mark.parametrize(
    ("render", "on_error"), [("live", "warn"), ("deferred", "warn"), (None, "raise")]
)
def test_a_directory_that_is_removed_during_the_run(render, on_error, pendulum, out):
    """An error names the file that cannot be written, or the simulation continues."""
    monitor = pendulum(render=render, workers=0, on_error=on_error)
    run(monitor)
    # A thread may be writing a model there.
    while out.exists():
        shutil.rmtree(out, ignore_errors=True)
    with raised(on_error, FileNotWritten, "Cannot write"):
        run(monitor)
        run(monitor, 3)
    with pytest.raises(FileNotWritten, match=r"stats\.json|\.jsonl"):
        monitor.close()
    assert not out.exists()
    out.mkdir()
    monitor.close()
    assert stats_of(out)["episode_lengths"] == [8, 8][: 1 + (on_error == "warn")]
