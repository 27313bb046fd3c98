# SPDX-License-Identifier: Apache-2.0
"""Episodes are listed one by one, of open, closed, dead and gym's monitors."""

import tracemalloc

import pytest
from parts import parametrize
from result_files import entry, write_journal, write_saved
from trajectories_by_hand import write_finished, write_log

import mjrec
from mjrec.errors import UnreadableFile
from mjrec.formats.manifest import read_manifest
from mjrec.reporting.gathering import gather


def video(directory, infix, episode_id, suffix):
    path = directory / f"openaigym.video.{infix}.video{episode_id:06d}{suffix}"
    path.touch()
    return path


def test_an_episode_of_a_journal_has_its_files(tmp_path):
    """Numbers, seeds and flags as the monitor knew them; no other monitor's video."""
    facts = {"type": "e", "options": {"x": 1}, "terminated": False, "truncated": True}
    write_journal(tmp_path, "0.7", entry(27, **facts), 28)
    # The same monitor's statistics hold less of each.
    write_saved(tmp_path, "0.7", 27, 28)
    mp4, meta = (video(tmp_path, "0.7", 27, end) for end in (".mp4", ".meta.json"))
    for infix, end in (("0.7", ".side.mp4"), ("0.7", ".framehash"), ("1.7", ".mp4")):
        video(tmp_path, infix, 28, end)
    first, second = mjrec.iter_episodes(str(tmp_path))
    assert first == mjrec.Episode(
        episode_id=27,
        length=37,
        reward=27.0,
        start_time=126.5,
        end_time=127.0,
        seed=27,
        monitor="0.7",
        video=mp4,
        metadata=meta,
        **facts,
    )
    assert (second.episode_id, second.video, second.metadata) == (28, None, None)


@pytest.mark.parametrize("has_journal", [True, False])
def test_pending_is_what_was_promised_and_is_not_there(tmp_path, has_journal):
    """In flight or finished; neither what is there, nor what failed or is live."""
    pending = []
    if has_journal:
        kinds = ["deferred"] * 4 + ["live"]
        entries = [entry(n, recording=kind) for n, kind in enumerate(kinds)]
        write_journal(tmp_path, "0.7", *entries, run={"env_info": {}})
    else:
        names = [f"openaigym.video.0.7.video00000{n}.mp4" for n in range(4)]
        pending = [{"episode_id": n, "video": name} for n, name in enumerate(names)]
    details = {"next_episode_id": 5, "pending": pending}
    write_saved(tmp_path, "0.7", *range(5), details=details)
    trajectories = [write_log(tmp_path, 0, infix="0.7")]
    trajectories += [write_finished(tmp_path, n, infix="0.7") for n in range(1, 5)]
    video(tmp_path, "0.7", 2, ".mp4")
    video(tmp_path, "0.7", 3, ".meta.json")
    episodes = list(mjrec.iter_episodes(tmp_path))
    assert [each.pending for each in episodes] == [True, True, False, False, False]
    assert [each.trajectory for each in episodes] == trajectories


def test_gyms_episodes_have_what_gym_wrote(tmp_path):
    """Numbered by their index; the rest is None. A gym may die before its manifest."""
    write_saved(tmp_path, "0.7", 1, 2, types="te").unlink()
    text, meta = (video(tmp_path, "0.7", 1, end) for end in (".json", ".meta.json"))
    _, episode = mjrec.iter_episodes(tmp_path)
    assert episode == mjrec.Episode(
        episode_id=1,
        length=12,
        reward=2.0,
        type="e",
        end_time=102.0,
        monitor="0.7",
        video=text,
        metadata=meta,
    )


@pytest.mark.parametrize(
    ("types", "linked"), [(None, True), ("ttt", True), ("tttt", False)]
)
def test_a_video_is_never_shown_for_another_episode(tmp_path, types, linked):
    """Gym numbers videos by resets; more of them than ends and a next are in doubt."""
    write_saved(tmp_path, "0.7", 1, 2, types=types)
    video(tmp_path, "0.7", 0, ".mp4")
    first, second = mjrec.iter_episodes(tmp_path)
    assert (first.video is not None) == linked
    assert (first.type, second.type) == ("t", "t")


def test_monitors_come_in_the_order_of_their_numbers(tmp_path):
    """10 after 9; a missing directory is an error before the first episode."""
    infixes = ["0.9", "0.10", "1.7", "9.7", "10.7"]
    for infix in reversed(infixes):
        write_journal(tmp_path, infix, 0)
    assert [episode.monitor for episode in mjrec.iter_episodes(tmp_path)] == infixes
    with pytest.raises(UnreadableFile, match="directory does not exist"):
        mjrec.iter_episodes(tmp_path / "missing")


# --- memory --------------------------------------------------------------------------


def peak_of(read, path):
    """Return the most bytes that were held while something was read."""
    # The first time, things are loaded that stay.
    read(path)
    tracemalloc.start()
    try:
        read(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def list_episodes(directory):
    """Return how many episodes there are."""
    return sum(1 for _ in mjrec.iter_episodes(directory))


def test_memory_does_not_grow_with_the_episodes(tmp_path):
    """Episodes are read as they are asked for."""
    items = (entry(number, options="x" * 1000) for number in range(5000))
    path = write_journal(tmp_path, "0.7", *items)
    assert peak_of(list_episodes, tmp_path) < path.stat().st_size / 10


@parametrize("read", [mjrec.load_results, list_episodes, gather])
def test_manifests_are_not_kept(tmp_path, read):
    """What many say of packages takes no more than what a few do."""
    packages = {
        f"package-{n}": {"version": "1.0", "hash": "0" * 64} for n in range(999)
    }
    large, small = tmp_path / "large", tmp_path / "small"
    for directory, said in ((large, packages), (small, {})):
        directory.mkdir()
        for number in range(40):
            details = {"provenance": {"packages": said}}
            path = write_saved(directory, f"{number}.1", 1, details=details)
    one = peak_of(read_manifest, large / path.name)
    assert peak_of(read, large) - peak_of(read, small) < 4 * one
