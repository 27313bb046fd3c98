# SPDX-License-Identifier: Apache-2.0
"""Read the results of monitors that never closed."""

import json
from pathlib import Path

import pytest
from result_files import ENV_INFO, entry, write_journal, write_saved

import mjrec
from mjrec.errors import UnreadableFile

VIDEO = "openaigym.video.0.7.video{:06d}.mp4"
FILMED = {"chosen": True, "recording": "live"}
ENTRIES = [entry(number, **(FILMED if number in (0, 4) else {})) for number in range(5)]
READERS = (mjrec.load_results, lambda path: list(mjrec.iter_episodes(path)))


@pytest.fixture
def late(tmp_path):
    """Return files of a monitor killed after episode 5, with an older manifest."""
    names = map(VIDEO.format, (0, 4))
    videos = [(name, name.replace("mp4", "meta.json")) for name in names]
    for mp4, metadata in videos:
        (tmp_path / mp4).touch()
        (tmp_path / metadata).write_text("{}")
    details = {"next_episode_id": 4}
    write_saved(tmp_path, "0.7", *range(4), videos=videos[:1], details=details)
    write_journal(tmp_path, "0.7", *ENTRIES, run={"env_info": ENV_INFO})
    return tmp_path


def load(directory):
    """Load results and compare them with the episodes."""
    results = mjrec.load_results(directory)
    episodes = list(mjrec.iter_episodes(directory))
    assert [each.length for each in episodes] == results["episode_lengths"]
    return results


def only(directory, pattern):
    (path,) = directory.glob(pattern)
    return path


def test_journal_alone_gives_results(tmp_path, caplog):
    """The running episode does not count."""
    journal = write_journal(
        *(tmp_path, "0.7", entry(0), entry(1), entry(2, type="e", seed=None)),
        run={"env_info": ENV_INFO},
    )
    with journal.open("ab") as file:
        file.write(b'{"episode_id": 3, "len')
    results = load(tmp_path)
    assert results["manifests"] == [str(journal)]
    assert results["env_info"] == ENV_INFO
    expected = {
        "data_sources": [0, 0, 0],
        "episode_lengths": [10, 11, 12],
        "episode_rewards": [0, 1, 2],
        "episode_types": ["t", "t", "e"],
        "timestamps": [100, 101, 102],
        "initial_reset_timestamps": [99.5],
        "initial_reset_timestamp": 99.5,
        "videos": [],
    }
    assert {key: results[key] for key in expected} == expected
    assert [e.seed for e in mjrec.iter_episodes(tmp_path)] == [0, 1, None]
    assert {record.levelname for record in caplog.records} == {"WARNING"}


def test_journal_completes_an_older_manifest(late):
    """Finished videos are found, but broken ones are not."""
    manifest = only(late, "*.manifest.json")
    results = load(late)
    assert results["timestamps"] == [100, 101, 102, 103, 104]
    assert results["manifests"] == [str(manifest)]
    assert results["initial_reset_timestamp"] == 98
    assert [e.episode_id for e in mjrec.iter_episodes(late)] == [0, 1, 2, 3, 4]
    videos = results["videos"]
    assert [Path(path).name[-10:] for path, _ in videos] == ["000000.mp4", "000004.mp4"]
    manifest.unlink()
    assert load(late)["videos"] == videos
    Path(videos[0][1]).write_text('{"broken": true}')
    assert load(late)["videos"] == videos[1:]


def test_open_and_resumed_monitors_are_merged_with_killed_ones(
    late, make_corridor, play
):
    """Each episode counts once, with consecutive numbers."""
    options = {"resume": True, "video_callable": False}
    with mjrec.Monitor(make_corridor(2), late, **options) as env:
        play(env, 2)
        opened = load(late)
    closed = load(late)
    for results in (opened, closed):
        assert results["episode_lengths"] == [10, 11, 12, 13, 14, 2, 2]
        assert len(results["manifests"]) == 2
        by_source = [results["data_sources"].count(source) for source in (0, 1)]
        assert sorted(by_source) == [2, 5]
    numbers = [episode.episode_id for episode in mjrec.iter_episodes(late)]
    assert sorted(numbers) == list(range(7))


@pytest.mark.parametrize(
    ("journal", "count"), [((3, 4), 3), ((4, 5, 6), 3), ((1, 2, 3, 4), 4)]
)
def test_the_source_with_more_episodes_wins(tmp_path, journal, count):
    """The statistics file wins a tie, and duplicate lines do not count."""
    write_saved(tmp_path, "0.7", 1, 2, 3)
    write_journal(tmp_path, "0.7", *journal, *journal[-1:] * 4)
    results = mjrec.load_results(tmp_path)
    assert results["episode_lengths"] == [11, 12, 13, 14][:count]
    assert results["initial_reset_timestamps"] == [98.0]


@pytest.mark.parametrize("lock", ["dead", "link", "", "[1]"])
def test_journal_or_lock_names_the_environment(tmp_path, lock, caplog):
    """Unknown facts cause no warning, and a link in place of a lock is not read."""
    write_journal(tmp_path, "0.7", 1)
    path = tmp_path / ".openaigym.0.7.lock"
    content = json.dumps({"run": {"env_info": ENV_INFO}})
    if lock == "link":
        (tmp_path / "secret").write_text(content)
        path.symlink_to("secret")
    else:
        path.write_text(content if lock == "dead" else lock)
    known = ENV_INFO if lock == "dead" else {"gym_version": "mjrec-1"}
    assert load(tmp_path)["env_info"] == known
    write_journal(tmp_path, "1.7", 2, run={"env_info": ENV_INFO})
    assert load(tmp_path)["env_info"] == ENV_INFO
    assert not caplog.records


@pytest.mark.parametrize("pattern", ["*.manifest.json", "*.stats.json"])
@pytest.mark.parametrize("content", [None, b"{", b'{"stats": "../x"}'])
def test_journal_replaces_damaged_files(tmp_path, pattern, content, caplog):
    """A warning names the file; without a journal there is an error."""
    write_saved(tmp_path, "0.7", 1, 2)
    journal = write_journal(tmp_path, "0.7", 1, 2, run={"env_info": ENV_INFO})
    damaged = only(tmp_path, pattern)
    if content is None:
        damaged.unlink()
    else:
        damaged.write_bytes(content)
    assert load(tmp_path)["episode_lengths"] == [11, 12]
    # A missing manifest is normal after a kill.
    if content is not None or "stats" in pattern:
        assert [damaged.name in r.getMessage() for r in caplog.records] == [True] * 2
        journal.unlink()
        for read in READERS:
            with pytest.raises(UnreadableFile, match=damaged.name):
                read(tmp_path)


def test_statistics_replace_a_damaged_journal(tmp_path, caplog):
    details = {"first_episode_id": 1, "next_episode_id": 3}
    manifest = write_saved(tmp_path, "0.7", 1, 2, details=details)
    journal = write_journal(tmp_path, "0.7")
    journal.write_bytes(b"\xff\n" * 5000)
    assert load(tmp_path)["episode_lengths"] == [11, 12]
    caplog.clear()
    journal.unlink()
    journal.symlink_to("/proc/self/status")
    assert load(tmp_path)["episode_lengths"] == [11, 12]
    named = [f"{journal}: it is a link" in each for each in caplog.messages]
    assert named == [True, True]
    manifest.unlink()
    only(tmp_path, "*.stats.json").unlink()
    for read in READERS:
        with pytest.raises(UnreadableFile, match="out of its directory"):
            read(tmp_path)


@pytest.mark.parametrize("lost", [0, 3])
def test_lost_journal_line_costs_only_its_details(tmp_path, lost):
    """Statistics still have the episode, and its neighbors give its number."""
    details = {"first_episode_id": 5, "next_episode_id": 9}
    write_saved(tmp_path, "0.7", 5, 6, 7, 8, details=details)
    journal = write_journal(tmp_path, "0.7", 5, 6, 7, 8)
    lines = journal.read_bytes().splitlines(keepends=True)
    lines[lost] = b"\0" * 100 + b"\n"
    journal.write_bytes(b"".join(lines))
    (tmp_path / VIDEO.format(5 + lost)).touch()
    expected = [(n, n) for n in (5, 6, 7, 8)]
    expected[lost] = (5 + lost, None)
    episodes = list(mjrec.iter_episodes(tmp_path))
    assert [(each.episode_id, each.seed) for each in episodes] == expected
    assert (episodes[lost].length, episodes[lost].video) == (15 + lost, None)


@pytest.mark.parametrize(
    ("saved", "journal", "following", "numbers", "shown"),
    [
        # Episode 6 or 7 was reset early, and no file says which.
        ((5, 7, 8), (5, 8), 9, [5, 6, 8], [True, False, True]),
        # Without a journal, the numbers show whether all episodes were completed.
        ((5, 6), (), 7, [5, 6], [True, True]),
        ((5, 6), (), 8, [5, 6], [False, False]),
    ],
)
def test_episode_with_an_uncertain_number_shows_no_video(
    tmp_path, saved, journal, following, numbers, shown
):
    details = {"first_episode_id": 5, "next_episode_id": following}
    write_saved(tmp_path, "0.7", *saved, details=details)
    if journal:
        write_journal(tmp_path, "0.7", *journal)
    for number in range(5, 9):
        (tmp_path / VIDEO.format(number)).touch()
    episodes = list(mjrec.iter_episodes(tmp_path))
    assert [each.episode_id for each in episodes] == numbers
    assert [each.video is not None for each in episodes] == shown
