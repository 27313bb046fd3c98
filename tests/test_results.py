# SPDX-License-Identifier: Apache-2.0
"""Find, merge, list and clear results like gym."""

import tracemalloc
from pathlib import Path

import pytest
from parts import parametrize
from result_files import entry, write_journal, write_saved
from trajectories_by_hand import write_finished, write_log

import mjrec
from mjrec.errors import DirectoryInUse, UnreadableFile
from mjrec.formats.locks import Lock
from mjrec.formats.manifest import StatsFile, read_manifest
from mjrec.formats.monitor_directory import episode_of, infix_of
from mjrec.reporting.gathering import gather

VIDEO = "openaigym.video.0.1.video000027"
MONITOR_FILES = [
    "openaigym.episode_batch.0.1.stats.json",
    "openaigym.episodes.0.1.jsonl",
    "openaigym.manifest.0.1.manifest.json",
    "openaigym.model.0123456789abcdef.zip",
    "openaigym.results.0.1.monitor.csv",
    *(f"openaigym.states.0.1.000000.{end}" for end in ("log", "looks", "tail")),
    "openaigym.trajectory.0.1.episode000027.h5",
    *(f"{VIDEO}.{end}" for end in ("json", "meta.json", "mp4")),
]
HIDDEN_FILES = [
    *(".openaigym.0.1.lock", ".openaigym.manifest.0.1.lock", f".{VIDEO}.lock"),
    *(".openaigym.clip.0.1.step000000137.lock", ".openaigym.render.3.lock"),
    ".openaigym.manifest.0.1.manifest.json.0123abcd.part",
    f".{VIDEO}.mp4.01234567.part",
]
OTHER_FILES = [
    *("openaigym.notes.txt", "openaigymfoo", "policy.pt", ".hidden"),
    *("openaigym.manifest", "openaigym..manifest.json", "openaigym.states.0.1.log"),
    *("mjrec.evaluation.0.1.jsonl", "openaigym.video.0.1.video27.mp4"),
]


def touch(directory, *names):
    for name in names:
        (directory / name).touch()


def test_names_give_monitor_and_episode():
    for name in MONITOR_FILES + HIDDEN_FILES + OTHER_FILES:
        is_shared = ".model." in name or ".render." in name or name in OTHER_FILES
        assert infix_of(name) == (None if is_shared else "0.1"), name
        assert episode_of(name) == (27 if "000027" in name else None), name
    # This name exists only inside logs.
    assert infix_of("openaigym.clip.0.1.step000000137.part000000") == "0.1"


def test_detection_takes_exact_names_in_order(tmp_path):
    """Links to files count, folders do not, and `files` replaces the listing."""
    assert mjrec.detect_monitor_files(str(tmp_path / "missing")) == []
    touch(tmp_path, *MONITOR_FILES, *HIDDEN_FILES, *OTHER_FILES)
    (tmp_path / "openaigym.manifest.1.1.manifest.json").mkdir()
    links = [f"openaigym.manifest.{n}.1.manifest.json" for n in range(2, 6)]
    for name, target in zip(links, ["policy.pt", "gone", ".", links[3]], strict=True):
        (tmp_path / name).symlink_to(target)
    found = [str(tmp_path / name) for name in sorted([*MONITOR_FILES, links[0]])]
    assert mjrec.detect_monitor_files(tmp_path) == found
    (tmp_path / links[0]).unlink()
    late, early = (f"openaigym.manifest.{i}.manifest.json" for i in ("1.7", "0.7"))
    others = [f"openaigym.manifest.{i}" for i in ("", "0.8.manifest.json~", "0.9.json")]
    (tmp_path / MONITOR_FILES[2]).unlink()
    touch(tmp_path, late, early, *others)
    manifests = [str(tmp_path / early), str(tmp_path / late)]
    assert mjrec.detect_training_manifests(str(tmp_path)) == manifests
    named = mjrec.detect_training_manifests(tmp_path / "x", files=[late, "x", early])
    assert named == [str(tmp_path / "x" / early), str(tmp_path / "x" / late)]


def test_clearing_removes_only_monitor_files(tmp_path, monkeypatch):
    """Manifest and journal go first, link targets stay, and a lock prevents it all."""
    touch(tmp_path, *MONITOR_FILES[:-1], *HIDDEN_FILES[1:], *OTHER_FILES)
    (tmp_path / MONITOR_FILES[-1]).symlink_to("policy.pt")
    folder = tmp_path / "openaigym.video.9.9.video000000.mp4"
    folder.mkdir()
    lock = Lock(tmp_path / HIDDEN_FILES[0], "")
    before = set(tmp_path.iterdir())
    with pytest.raises(DirectoryInUse, match=r"\.openaigym\.0\.1\.lock"):
        mjrec.clear_monitor_files(tmp_path)
    assert set(tmp_path.iterdir()) == before
    lock.let_go()  # This leaves the lock file, like a killed process.
    removed, real = [], Path.unlink
    monkeypatch.setattr(
        Path, "unlink", lambda p, **rest: (removed.append(p.name), real(p, **rest))
    )
    mjrec.clear_monitor_files(str(tmp_path))
    assert {path.name for path in tmp_path.iterdir()} == {*OTHER_FILES, folder.name}
    assert {name.split(".")[1] for name in removed[:2]} == {"manifest", "episodes"}
    assert len(removed) == len(MONITOR_FILES) + len(HIDDEN_FILES)
    mjrec.clear_monitor_files(tmp_path / "missing")


def test_merge_sorts_episodes_by_time(tmp_path):
    """The sort is stable, and each row keeps its length, reward, type and source."""
    write_saved(tmp_path, "0.7", 1, 4, start=0.5, types="te")
    # Gym notes a type at each reset, so there are more types than episodes.
    write_saved(tmp_path, "1.7", 2, 3, start=0.25, types="ette")
    write_saved(tmp_path, "2.7", 5, types=None)  # None means training.
    paths = sorted(tmp_path.glob("*.stats.json"))
    assert mjrec.merge_stats_files(paths) == (
        [0, 1, 1, 0, 2],
        [0.5, 0.25, 98.0],
        [101.0, 102.0, 103.0, 104.0, 105.0],
        [11, 12, 13, 14, 15],
        [1.0, 2.0, 3.0, 4.0, 5.0],
        ["t", "e", "t", "e", "t"],
        0.25,
    )
    assert mjrec.merge_stats_files([]) == ([], [], [], [], [], None, 0)
    for infix in ("0.7", "1.7", "2.7"):
        same = StatsFile(0.0, (1.0,) * 100, tuple(range(100)), (0.0,) * 100, None)
        write_saved(tmp_path, infix, stats=same)
    results = mjrec.load_results(tmp_path)
    assert results["data_sources"] == [0] * 100 + [1] * 100 + [2] * 100
    assert results["episode_lengths"] == [*range(100)] * 3
    assert results["episode_types"] is None


def test_monitors_keep_their_order_in_all_lists(tmp_path, caplog):
    """A directory without monitors has no results."""
    assert mjrec.load_results(tmp_path / "missing") is None
    assert mjrec.load_results(str(tmp_path)) is None
    assert f"directory {tmp_path / 'missing'} does not exist" in caplog.text
    assert f"There are no manifests or journals in {tmp_path}" in caplog.text
    first = write_saved(tmp_path, "0.7", start=None)
    second = write_saved(tmp_path, "1.7", start=0.1)
    third = write_journal(tmp_path, "2.7", 1)
    last = write_saved(tmp_path, "3.7", 0, start=0.5)
    results = mjrec.load_results(tmp_path)
    assert results["manifests"] == [str(path) for path in (first, second, third, last)]
    assert results["initial_reset_timestamps"] == [None, 0.1, 100.5, 0.5]
    assert results["data_sources"] == [3, 2]
    assert results["initial_reset_timestamp"] == 0.5


def test_newest_env_info_wins_with_one_warning(tmp_path, caplog):
    newest = {"gym_version": "mjrec-1", "extra": [1]}
    write_saved(tmp_path, "0.7", 9, start=99.0, env_info=newest)
    assert mjrec.load_results(tmp_path)["env_info"] == newest
    assert not caplog.records
    write_saved(tmp_path, "1.7", 1, env_info={"gym_version": "0.21.0"})
    results = mjrec.load_results(tmp_path)
    assert results["env_info"] == newest
    assert results["timestamps"] == [101.0, 109.0]
    [warning] = caplog.messages
    assert "0.7.manifest.json has {'gym_version': 'mjrec-1'" in warning
    assert "1.7.manifest.json has {'gym_version': '0.21.0'}" in warning


def test_videos_are_pairs_of_paths_in_order(tmp_path, caplog):
    """One warning names all missing videos."""
    pairs = [(f"v{i}.mp4", f"v{i}.meta.json") for i in range(4)]
    (tmp_path / "old").mkdir()
    write_saved(tmp_path / "old", "1.7", videos=pairs[:1])
    write_saved(tmp_path / "old", "0.7", videos=pairs[1:])
    touch(tmp_path / "old", *pairs[0], *pairs[2])
    new = (tmp_path / "old").rename(tmp_path / "new")
    assert mjrec.load_results(new)["videos"] == [
        tuple(str(new / name) for name in pairs[number]) for number in (2, 0)
    ]
    [warning] = caplog.messages
    assert "2 of the 4 videos" in warning
    assert "v1.mp4, v3.mp4" in warning


def video(directory, infix, episode_id, suffix):
    path = directory / f"openaigym.video.{infix}.video{episode_id:06d}{suffix}"
    path.touch()
    return path


def test_journal_episode_has_its_facts_and_files(tmp_path):
    """The journal adds details, and other monitors' videos are ignored."""
    facts = {"type": "e", "options": {"x": 1}, "terminated": False, "truncated": True}
    write_journal(tmp_path, "0.7", entry(27, **facts), 28)
    write_saved(tmp_path, "0.7", 27, 28)
    mp4, meta = (video(tmp_path, "0.7", 27, end) for end in (".mp4", ".meta.json"))
    for infix, end in (("0.7", ".side.mp4"), ("0.7", ".framehash"), ("1.7", ".mp4")):
        video(tmp_path, infix, 28, end)
    first, second = mjrec.iter_episodes(str(tmp_path))
    known = {"episode_id": 27, "length": 37, "reward": 27.0, "seed": 27}
    known |= {"start_time": 126.5, "end_time": 127.0, "monitor": "0.7"}
    assert first == mjrec.Episode(video=mp4, metadata=meta, **known, **facts)
    assert (second.episode_id, second.video, second.metadata) == (28, None, None)


@pytest.mark.parametrize("has_journal", [True, False])
def test_pending_videos_are_deferred_and_missing(tmp_path, has_journal):
    """An episode with metadata but no video has failed."""
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


def test_gym_episodes_have_gym_facts_only(tmp_path):
    write_saved(tmp_path, "0.7", 1, 2, types="te").unlink()
    text, meta = (video(tmp_path, "0.7", 1, end) for end in (".json", ".meta.json"))
    _, episode = mjrec.iter_episodes(tmp_path)
    known = {"episode_id": 1, "length": 12, "reward": 2.0, "type": "e"}
    known |= {"end_time": 102.0, "monitor": "0.7", "video": text, "metadata": meta}
    assert episode == mjrec.Episode(**known)


@pytest.mark.parametrize(
    ("types", "linked"), [(None, True), ("ttt", True), ("tttt", False)]
)
def test_ambiguous_gym_video_is_left_out(tmp_path, types, linked):
    """Gym numbers videos by resets, which may outnumber episodes."""
    write_saved(tmp_path, "0.7", 1, 2, types=types)
    video(tmp_path, "0.7", 0, ".mp4")
    first, second = mjrec.iter_episodes(tmp_path)
    assert (first.video is not None) == linked
    assert (first.type, second.type) == ("t", "t")


def test_monitors_are_sorted_by_number(tmp_path):
    """A missing directory is an error before the first episode."""
    infixes = ["0.9", "0.10", "1.7", "9.7", "10.7"]
    for infix in reversed(infixes):
        write_journal(tmp_path, infix, 0)
    assert [episode.monitor for episode in mjrec.iter_episodes(tmp_path)] == infixes
    with pytest.raises(UnreadableFile, match="directory does not exist"):
        mjrec.iter_episodes(tmp_path / "missing")


def peak_memory(read, path):
    """Return the peak number of bytes allocated by a second reading."""
    read(path)
    tracemalloc.start()
    try:
        read(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def count_episodes(directory):
    return sum(1 for _ in mjrec.iter_episodes(directory))


def test_memory_does_not_grow_with_the_episodes(tmp_path):
    items = (entry(number, options="x" * 1000) for number in range(5000))
    path = write_journal(tmp_path, "0.7", *items)
    assert peak_memory(count_episodes, tmp_path) < path.stat().st_size / 10


@parametrize("read", [mjrec.load_results, count_episodes, gather])
def test_manifests_are_not_kept_in_memory(tmp_path, read):
    packages = {
        f"package-{n}": {"version": "1.0", "hash": "0" * 64} for n in range(999)
    }
    large, small = tmp_path / "large", tmp_path / "small"
    for directory, listed in ((large, packages), (small, {})):
        directory.mkdir()
        for number in range(40):
            details = {"provenance": {"packages": listed}}
            path = write_saved(directory, f"{number}.1", 1, details=details)
    one = peak_memory(read_manifest, large / path.name)
    assert peak_memory(read, large) - peak_memory(read, small) < 4 * one
