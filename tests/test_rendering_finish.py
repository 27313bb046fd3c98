# SPDX-License-Identifier: Apache-2.0
"""Pending videos are found, claimed, and rendered once."""

import time

import pytest
from recordings import add_facts, manifest_of
from trajectories_by_hand import (
    INFIX,
    write_finished,
    write_log,
    write_pending_manifest,
)

from mjrec import UnreadableFile
from mjrec.formats.locks import Lock
from mjrec.formats.monitor_directory import lock_name, video_prefix
from mjrec.formats.spans import is_in_flight
from mjrec.rendering import finish as module
from mjrec.rendering.jobs import RecordingKey
from mjrec.rendering.recorded_facts import open_for_rendering
from mjrec.rendering.recordings import claim, look_at, may_be_left
from mjrec.results.manifest_writing import write_manifest_and_stats

pytestmark = pytest.mark.usefixtures("painter")

KEY = RecordingKey(INFIX, 0)
VIDEO = "openaigym.video.0.7.video000000"


def finish(directory, workers=1):
    return list(module.finish(directory, workers=workers))


# Pending


@pytest.mark.parametrize("write", [write_log, write_finished])
def test_a_deferred_video_is_pending_until_it_and_its_metadata_exist(write, tmp_path):
    """The trajectory may be a log or finished."""
    trajectory = write(tmp_path)
    plan = look_at(tmp_path, KEY)
    assert (plan.parts, plan.frame_count) == ((trajectory,), 5)
    assert plan.videos == (tmp_path / f"{VIDEO}.mp4",)
    for _ in range(2):
        [result] = finish(tmp_path)
        assert result.videos == {f"{VIDEO}.mp4": 5}
        assert look_at(tmp_path, KEY) is None
        assert not may_be_left(tmp_path, KEY)
        (tmp_path / f"{VIDEO}.meta.json").unlink()


@pytest.mark.parametrize(("facts", "ended"), [({"candidate": True}, True), ({}, False)])
def test_running_and_undecided_episodes_are_left_to_an_open_monitor(
    facts, ended, tmp_path
):
    """They are pending once the monitor is dead."""
    log = write_log(tmp_path, ended=ended, **facts)
    write_log(tmp_path, 1)
    lock = Lock(tmp_path / lock_name(INFIX), "")
    second = "openaigym.video.0.7.video000001.mp4"
    assert [list(each.videos) for each in finish(tmp_path)] == [[second]]
    assert is_in_flight(log)
    if ended:
        add_facts(log, {"candidate": False})
        assert look_at(tmp_path, KEY) is not None
        add_facts(log, {"candidate": True})
    lock.release()
    [result] = finish(tmp_path)
    assert result.videos


def test_a_trajectory_that_is_not_kept_is_deleted_after_its_video(tmp_path):
    """While rendering fails, it stays."""
    write_log(tmp_path, kept=False)
    log = write_log(tmp_path, 1, kept=False, frames=False)
    assert [bool(each.failures) for each in finish(tmp_path)] == [False, True]
    assert (tmp_path / f"{VIDEO}.mp4").exists()
    assert [path.name for path in tmp_path.glob("*.trajectory.*")] == [log.name]


# Claims


def test_an_episode_claimed_by_another_process_is_reported_and_skipped(
    tmp_path, painter
):
    """A lock file whose process is dead does not count."""
    write_finished(tmp_path)
    lock = claim(tmp_path, KEY)
    assert lock is not None
    assert claim(tmp_path, KEY) is None
    [result] = finish(tmp_path)
    assert result.elsewhere == (f"{VIDEO}.mp4",)
    assert painter.asked == []
    lock.release()
    (tmp_path / f".{video_prefix(INFIX, 0)}.lock").write_text("4711")
    write_pending_manifest(tmp_path, 0)
    [result] = finish(tmp_path, workers=None)
    assert result.videos
    # No lock of episode, manifest or CPUs stays.
    assert not list(tmp_path.glob(".*"))


# Failures


def test_failed_episodes_have_reasons_and_stop_no_other(tmp_path, caplog, painter):
    """They stay pending."""
    write_finished(tmp_path, 0).write_bytes(b"not HDF5 at all")
    write_finished(tmp_path, 1, frames=False, refusal="a plugin draws")
    write_finished(tmp_path, 2)
    write_finished(tmp_path, 3, scene="all")
    write_finished(tmp_path, 4)
    painter.breaks_at = lambda path, *_: [][1] if "000002" in path.name else None
    *failed, last = finish(tmp_path)
    assert last.videos
    reasons = [reason for each in failed for reason in each.failures.values()]
    expected = ("Cannot read", "a plugin draws", "IndexError: ", "scene")
    for words, reason in zip(expected, reasons, strict=True):
        assert words in reason
    assert "Traceback" in caplog.text
    assert len(finish(tmp_path)) == 4


# The manifest


def test_the_manifest_of_an_open_monitor_is_left_to_it(tmp_path):
    """A later run repairs it, even with nothing to render."""
    write_finished(tmp_path)
    path = write_pending_manifest(tmp_path, 0)
    before = path.read_bytes()
    lock = Lock(tmp_path / lock_name(INFIX), "")
    finish(tmp_path)
    assert path.read_bytes() == before
    lock.release()
    assert finish(tmp_path) == []
    assert len(manifest_of(tmp_path)["videos"]) == 1


@pytest.mark.parametrize("name", ["../elsewhere/x.mp4", "/x.mp4", "", 7, None])
def test_entries_for_files_elsewhere_are_dropped_from_a_manifest(name, tmp_path):
    write_pending_manifest(tmp_path, 0, pending=[{"episode_id": 0, "video": name}])
    write_manifest_and_stats(tmp_path, INFIX)
    assert manifest_of(tmp_path)["mjrec"]["pending"] == []


# Facts, which may come from a hostile file

FACTS = {"name": "x.mp4", "recording": "deferred"}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("rate", value) for value in ("1e20000000", "abc", "0", "1/0", 20)),
        ("timestep", "nan"),
        *(("stride", value) for value in (0, "2", 2.0, None)),
        *(("kept", 1), ("candidate", "yes"), ("scene", "all"), ("refusal", 5)),
        *(("model", value) for value in ([], {"mjb": "x" * 300}, {"xml": "../x.zip"})),
        ("video", "x"),
        *(
            ("video", {**FACTS, **value})
            for value in (
                *({"name": 5}, {"quality": "best"}, {"recording": None}),
                *({"fps": "1e20000000"}, {"fps": "0.00001"}, {"max_fps": 30}),
                *({"cameras": "side"}, {"cameras": []}, {"cameras": ["a", None]}),
                *({"cameras": [1.5, "a"]}, {"cameras": [{"lookat": "x"}, "a"]}),
                *({"tiled": 1}, {"annotate": "yes"}, {"also_named": 1}),
                {"also_named": "../a-episode-1.mp4"},
                {"also_named": "openaigym-step-1.mp4"},
            )
        ),
    ],
)
def test_an_impossible_fact_is_an_error_that_names_it_and_the_file(
    key, value, tmp_path
):
    """The error comes before anything is rendered."""
    path = write_log(tmp_path)
    add_facts(path, {key: value})
    start = time.monotonic()
    with pytest.raises(UnreadableFile, match=key) as caught:
        open_for_rendering(path)
    assert caught.value.path == path
    assert time.monotonic() - start < 5
