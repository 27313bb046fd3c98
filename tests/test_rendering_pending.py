# SPDX-License-Identifier: Apache-2.0
"""What is pending in a directory is found, shared out, and done once."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from trajectories_by_hand import (
    INFIX,
    Painter,
    write_finished,
    write_log,
    write_pending_manifest,
)

from mjrec import GLError, load_results
from mjrec.formats.in_flight import add_facts, is_in_flight
from mjrec.formats.locks import Lock
from mjrec.formats.monitor_directory import Infix, lock_name, video_lock_name
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.formats.video_metadata import is_done
from mjrec.rendering import shared_pool
from mjrec.rendering.finishing import EpisodeFinisher, finish_pending
from mjrec.rendering.outcomes import Outcome
from mjrec.rendering.pending import EpisodeKey, claim, look_at, recorded_episodes
from mjrec.rendering.progress import Progress
from mjrec.rendering.rendered_manifests import reconcile, update_manifest

KEY = EpisodeKey(INFIX, 0)
VIDEO = "openaigym.video.0.7.video000000"


@pytest.fixture(autouse=True)
def painter(monkeypatch: pytest.MonkeyPatch) -> Painter:
    """Draw without processes and without OpenGL."""
    painter = Painter()
    monkeypatch.setattr(shared_pool, "WorkerPool", lambda count: painter)
    return painter


def finish(directory: Path) -> list[Outcome]:
    return list(finish_pending(directory, recorded_episodes(directory), workers=1))


def manifest_in(directory: Path) -> dict[str, Any]:
    [path] = directory.glob("*.manifest.json")
    content: dict[str, Any] = json.loads(path.read_text())
    return content


def test_episodes_are_in_their_order(tmp_path: Path) -> None:
    """By the monitors' numbers, and then by their own; each once."""
    for infix in (Infix(10, "a"), Infix(2, "a")):
        for episode_id in (1, 0):
            write_log(tmp_path, episode_id, infix=infix)
    write_log(tmp_path, 5, infix=Infix(2, "a")).write_bytes(b"")
    assert [
        (key.infix.monitor_id, key.episode_id) for key in recorded_episodes(tmp_path)
    ] == [
        *((2, 0), (2, 1), (2, 5)),
        *((10, 0), (10, 1)),
    ]


@pytest.mark.parametrize("write", [write_log, write_finished])
def test_a_deferred_video_is_pending_until_it_is_there(
    write: Callable[..., Path], tmp_path: Path
) -> None:
    """Whether or not the trajectory has its final form."""
    trajectory = write(tmp_path)
    episode = look_at(tmp_path, KEY)
    assert episode is not None
    assert episode.trajectory == trajectory
    assert episode.video == tmp_path / f"{VIDEO}.mp4"
    assert episode.frame_count == 5
    finish(tmp_path)
    assert look_at(tmp_path, KEY) is None


def test_a_video_without_metadata_is_not_done(tmp_path: Path) -> None:
    """Somebody died between the two; it is rendered once more."""
    write_finished(tmp_path)
    finish(tmp_path)
    (tmp_path / f"{VIDEO}.meta.json").unlink()
    assert look_at(tmp_path, KEY) is not None
    [outcome] = finish(tmp_path)
    assert outcome.is_video
    assert is_done(tmp_path / f"{VIDEO}.mp4")


@pytest.mark.parametrize("video", [None, "live"])
def test_a_finished_trajectory_without_a_deferred_video_is_done(
    video: str | None, tmp_path: Path
) -> None:
    """Nobody is to draw what was drawn live, or not wanted."""
    write_finished(tmp_path, video=video)
    assert look_at(tmp_path, KEY) is None
    assert finish(tmp_path) == []


def test_a_log_without_a_video_gets_its_final_form_only(
    tmp_path: Path, painter: Painter, names: Callable[[Path], list[str]]
) -> None:
    """And nobody draws."""
    log = write_log(tmp_path, video=None)
    [outcome] = finish(tmp_path)
    assert not outcome.is_video
    assert outcome.failure is None
    assert outcome.name == log.name
    assert names(tmp_path) == [log.name]
    assert painter.asked == []


def test_a_given_up_video_is_not_pending(tmp_path: Path) -> None:
    """Its metadata says that it broke before there was a frame."""
    write_finished(tmp_path, frames=False, broken_reason="a marker")
    [outcome] = finish(tmp_path)
    assert outcome.failure is None
    assert look_at(tmp_path, KEY) is None


def test_an_undecided_episode_is_its_monitors(tmp_path: Path) -> None:
    """Its monitor may still delete it; what a dead one left undecided is pending."""
    log = write_log(tmp_path, candidate=True)
    lock = Lock(tmp_path / lock_name(INFIX), "")
    assert finish(tmp_path) == []
    assert is_in_flight(log)
    add_facts(log, {"candidate": False})
    assert look_at(tmp_path, KEY) is not None
    add_facts(log, {"candidate": True})
    lock.release()
    [outcome] = finish(tmp_path)
    assert outcome.is_video


def test_a_running_episode_is_its_monitors(tmp_path: Path) -> None:
    """While somebody holds the monitor's lock; afterwards it died."""
    write_log(tmp_path, ended=False)
    lock = Lock(tmp_path / lock_name(INFIX), "")
    assert look_at(tmp_path, KEY) is None
    lock.release()
    [outcome] = finish(tmp_path)
    assert outcome.is_video


def test_an_ended_episode_of_an_open_monitor_is_anybodys(tmp_path: Path) -> None:
    """Its log says how it ended."""
    write_log(tmp_path)
    lock = Lock(tmp_path / lock_name(INFIX), "")
    [outcome] = finish(tmp_path)
    assert outcome.is_video
    lock.release()


def test_a_trajectory_that_is_not_kept_goes_when_its_video_is_there(
    tmp_path: Path, names: Callable[[Path], list[str]]
) -> None:
    """It was there for the video only."""
    write_log(tmp_path, kept=False)
    finish(tmp_path)
    assert names(tmp_path) == [
        f"{VIDEO}.{end}" for end in ("framehash", "meta.json", "mp4")
    ]


def test_a_trajectory_that_is_not_kept_stays_while_its_video_fails(
    tmp_path: Path,
) -> None:
    """Else nobody could ever render it."""
    log = write_log(tmp_path, kept=False, frames=False)
    [outcome] = finish(tmp_path)
    assert outcome.failure is not None
    assert is_in_flight(log)


def test_an_episode_that_another_has_is_left_to_him(
    tmp_path: Path, painter: Painter
) -> None:
    """It is told, and not done twice."""
    write_finished(tmp_path)
    lock = claim(tmp_path, KEY)
    assert lock is not None
    assert claim(tmp_path, KEY) is None
    [outcome] = finish(tmp_path)
    assert outcome.is_elsewhere
    assert painter.asked == []
    lock.release()


def test_the_episode_of_a_dead_renderer_is_taken_over(
    tmp_path: Path, names: Callable[[Path], list[str]]
) -> None:
    """Its lock file is nobody's, and goes."""
    write_finished(tmp_path)
    (tmp_path / video_lock_name(INFIX, 0)).write_text("4711")
    [outcome] = finish(tmp_path)
    assert outcome.is_video
    assert not [name for name in names(tmp_path) if name.endswith(".lock")]


def test_one_that_was_done_meanwhile_is_not_done_again(
    tmp_path: Path, painter: Painter
) -> None:
    """Two look at the same directory; the slower finds nothing left."""
    write_finished(tmp_path)
    with EpisodeFinisher(tmp_path, workers=1) as slower:
        slower.add(KEY)
        finish(tmp_path)
        _, outcome = slower.finish_next()
    assert not outcome.is_video
    assert outcome.failure is None
    assert len(painter.asked) == 1


def test_what_cannot_be_rendered_stops_nothing_else(tmp_path: Path) -> None:
    """It is told with its reason, and stays pending."""
    write_finished(tmp_path, 0).write_bytes(b"not HDF5 at all")
    write_finished(tmp_path, 1, frames=False, refusal="a plugin draws")
    write_finished(tmp_path, 2)
    outcomes = finish(tmp_path)
    failures = [outcome.failure for outcome in outcomes]
    assert "Cannot read" in str(failures[0])
    assert "a plugin draws" in str(failures[1])
    assert failures[2] is None
    assert outcomes[2].is_video
    assert len(finish(tmp_path)) == 2


def test_without_gl_every_video_fails_at_once(
    tmp_path: Path, painter: Painter, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One try is enough; trajectories get their final form all the same."""
    tries: list[Path] = []

    def fail(trajectory: Path, *rest: object) -> None:
        tries.append(trajectory)
        raise GLError("nothing renders here")

    monkeypatch.setattr(painter, "frames", fail)
    logs = [write_log(tmp_path, episode_id) for episode_id in range(3)]
    outcomes = finish(tmp_path)
    assert [outcome.failure for outcome in outcomes] == ["nothing renders here"] * 3
    assert len(tries) == 1
    assert [log.exists() for log in logs] == [True] * 3


def test_an_unforeseen_error_is_told_with_its_kind(
    tmp_path: Path,
    painter: Painter,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The log has the traceback."""
    monkeypatch.setattr(painter, "frames", lambda *arguments: [][1])
    write_finished(tmp_path)
    [outcome] = finish(tmp_path)
    assert str(outcome.failure).startswith("IndexError: ")
    assert "Traceback" in caplog.text


def test_progress_counts_videos_and_frames(tmp_path: Path) -> None:
    """Those that fail count as done; trajectories without a video do not count."""
    write_finished(tmp_path, 0)
    write_finished(tmp_path, 1, frames=False)
    write_log(tmp_path, 2, video=None)
    seen: list[Progress] = []
    for _ in finish_pending(
        tmp_path, recorded_episodes(tmp_path), workers=1, on_progress=seen.append
    ):
        pass
    assert seen[-1] == Progress(videos_done=2, videos=2, frames_done=5, frames=5)
    drawn = [progress.frames_done for progress in seen]
    assert drawn == sorted(drawn)
    assert {0, 1, 2, 3, 4, 5} == set(drawn)


def test_an_episode_whose_model_is_still_being_written_waits(tmp_path: Path) -> None:
    """Another one comes first."""
    write_finished(tmp_path, 0, model={"mjb": "m.mjb.gz", "xml": None})
    with EpisodeFinisher(tmp_path, workers=1) as finisher:
        finisher.add(EpisodeKey(INFIX, 0))
        assert not finisher.is_ready()
        write_finished(tmp_path, 1)
        finisher.add(EpisodeKey(INFIX, 1))
        assert finisher.is_ready()
        assert finisher.finish_next()[0].episode_id == 1
        (tmp_path / "m.mjb.gz").write_bytes(b"")
        assert finisher.is_ready()


def test_the_manifest_of_a_closed_monitor_gets_the_videos(tmp_path: Path) -> None:
    """In the order of the episodes; what is not there yet stays pending."""
    for episode_id in (0, 1):
        write_finished(tmp_path, episode_id)
    write_pending_manifest(tmp_path, 1, 0, 2, schedule={"name": "cubic"})
    finish(tmp_path)
    manifest = manifest_in(tmp_path)
    assert manifest["videos"] == [
        [f"openaigym.video.0.7.video{k:06d}.{end}" for end in ("mp4", "meta.json")]
        for k in (0, 1)
    ]
    assert [entry["episode_id"] for entry in manifest["mjrec"]["pending"]] == [2]
    assert manifest["mjrec"]["schedule"] == {"name": "cubic"}
    assert manifest["env_info"] == {"gym_version": "mjrec-1", "env_id": "Grey-v0"}


def test_a_given_up_video_is_among_the_broken(tmp_path: Path) -> None:
    """As one that was drawn live would be."""
    write_finished(tmp_path, frames=False, broken_reason="a marker")
    write_pending_manifest(tmp_path, 0)
    finish(tmp_path)
    manifest = manifest_in(tmp_path)
    assert manifest["videos"] == []
    assert manifest["mjrec"]["pending"] == []
    assert manifest["mjrec"]["broken"] == [f"{VIDEO}.meta.json"]


def test_the_manifest_of_an_open_monitor_is_left_to_it(tmp_path: Path) -> None:
    """What a race leaves, a later run repairs."""
    write_finished(tmp_path)
    before = write_pending_manifest(tmp_path, 0).read_bytes()
    lock = Lock(tmp_path / lock_name(INFIX), "")
    finish(tmp_path)
    assert next(tmp_path.glob("*.manifest.json")).read_bytes() == before
    lock.release()
    assert finish(tmp_path) == []
    assert len(manifest_in(tmp_path)["videos"]) == 1


def test_other_manifests_are_not_rewritten(tmp_path: Path) -> None:
    """Neither gym's own, nor one in which nothing is new."""
    gyms = tmp_path / "openaigym.manifest.0.1.manifest.json"
    gyms.write_text('{"stats": "s.json", "videos": [], "env_info": {}, "more": 1}')
    other = write_pending_manifest(tmp_path, 3)
    before = [(path.read_bytes(), path.stat().st_mtime_ns) for path in (gyms, other)]
    reconcile(tmp_path)
    assert [
        (path.read_bytes(), path.stat().st_mtime_ns) for path in (gyms, other)
    ] == before


@pytest.mark.parametrize("name", ["../elsewhere/x.mp4", "/x.mp4", "", 7, None])
def test_a_manifest_names_no_video_elsewhere(name: Any, tmp_path: Path) -> None:
    """Such an entry stays as it is."""
    path = write_pending_manifest(tmp_path, 0)
    content = json.loads(path.read_text())
    content["mjrec"]["pending"][0]["video"] = name
    path.write_text(json.dumps(content))
    update_manifest(tmp_path, INFIX)
    assert manifest_in(tmp_path) == content


def test_no_lock_stays(tmp_path: Path, names: Callable[[Path], list[str]]) -> None:
    """Neither of the episode, nor of the manifest, nor of the CPUs."""
    write_finished(tmp_path)
    write_pending_manifest(tmp_path, 0)
    list(finish_pending(tmp_path, recorded_episodes(tmp_path), workers=None))
    assert not [name for name in names(tmp_path) if name.startswith(".")]


def test_results_list_the_rendered_videos(tmp_path: Path) -> None:
    """Readers see them like any others."""
    write_finished(tmp_path)
    write_pending_manifest(tmp_path, 0)
    (tmp_path / "openaigym.episode_batch.0.7.stats.json").write_text(
        '{"initial_reset_timestamp": 1, "timestamps": [2], "episode_lengths": [4], '
        '"episode_rewards": [2.0], "episode_types": ["t"]}'
    )
    finish(tmp_path)
    results = load_results(tmp_path)
    assert results is not None
    [(video, metadata)] = results["videos"]
    assert Path(video).is_file()
    assert json.loads(Path(metadata).read_text())["episode_id"] == 0


def test_a_log_beside_its_finished_trajectory_goes(tmp_path: Path) -> None:
    """Somebody died between making one and removing the other."""
    log = write_log(tmp_path)
    rows = {path: path.read_bytes() for path in tmp_path.glob("*.states.*")}
    finish(tmp_path)
    for path, content in rows.items():
        path.write_bytes(content)
    assert finish(tmp_path) == []
    assert not any(path.exists() for path in rows)
    with open_trajectory(log) as reader:
        assert reader.step_count == 4


def test_the_manifest_says_why_a_video_is_still_pending(tmp_path: Path) -> None:
    """What became of the latest try; a try that succeeds takes it away."""
    write_log(tmp_path, 0)
    write_pending_manifest(tmp_path, 0)
    [rows] = tmp_path.glob("*.log")
    hidden = rows.rename(tmp_path / "hidden")
    [outcome] = finish(tmp_path)
    [entry] = manifest_in(tmp_path)["mjrec"]["pending"]
    assert entry["reason"] == outcome.failure
    assert "Cannot read" in entry["reason"]
    hidden.rename(rows)
    assert [outcome.failure for outcome in finish(tmp_path)] == [None]
    assert manifest_in(tmp_path)["mjrec"]["pending"] == []
    assert len(manifest_in(tmp_path)["videos"]) == 1


def test_a_long_reason_is_cut_in_its_middle(tmp_path: Path) -> None:
    """Where it begins and ends is what matters."""
    write_pending_manifest(tmp_path, 0)
    reason = "It failed. " + 10**4 * "x" + " No space left."
    update_manifest(tmp_path, INFIX, reasons={f"{VIDEO}.mp4": reason})
    [entry] = manifest_in(tmp_path)["mjrec"]["pending"]
    assert len(entry["reason"]) <= 1000
    assert re.fullmatch(
        r"It failed\. x+ \[\.\.\.\] x+ No space left\.", entry["reason"]
    )


def test_what_a_killed_renderer_left_goes_with_the_next_try(tmp_path: Path) -> None:
    """Only that of the same video."""
    write_finished(tmp_path, 0)
    others = [
        f".{VIDEO}.side.mp4.0123abcd.part",
        ".openaigym.video.0.7.video000001.mp4",
    ]
    left = [
        f".{VIDEO}.{end}.0123abcd.part" for end in ("mp4", "framehash", "meta.json")
    ]
    for name in [*others, *left]:
        (tmp_path / name).touch()
    assert [outcome.failure for outcome in finish(tmp_path)] == [None]
    assert all((tmp_path / name).exists() for name in others)
    assert not any((tmp_path / name).exists() for name in left)
