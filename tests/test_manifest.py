# SPDX-License-Identifier: Apache-2.0
"""Manifest and statistics are like gym's, safe to read, and follow from the journal."""

import gymnasium
import pytest
from recordings import events_of, manifest_of, stats_of

import mjrec
from mjrec.errors import UnreadableFile
from mjrec.formats.manifest import read_manifest, read_stats_file
from mjrec.results.manifest_writing import write_manifest_and_stats

STATS_TEXT = (
    '{"initial_reset_timestamp": 10.5, "timestamps": [11.0, 12.0], '
    '"episode_lengths": [3, 4], "episode_rewards": [1.5, -2.0], '
    '"episode_types": ["t", "e"]}'
)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ('{"stats": "s", "videos": []', "not valid JSON"),
        ('{"videos": [], "env_info": {}}', "it has no 'stats'"),
        ('{"stats": 1, "videos": [], "env_info": {}}', "it must be a string"),
        ('{"stats": "s", "videos": [["a"]], "env_info": {}}', "it has 1 names"),
        ('{"stats": "..", "videos": [], "env_info": {}}', "not the name of a file"),
        ('{"stats": "s", "videos": [["a/b", "c"]], "env_info": {}}', "'a/b' is not"),
        ('{"stats": "s", "videos": [], "env_info": {}, "mjrec": 1}', "'mjrec'"),
        (STATS_TEXT.replace("[3, 4]", '"34"'), "it must be a list"),
        (STATS_TEXT.replace("[3, 4]", "[3, true]"), "not true or false"),
        (STATS_TEXT.replace("[3, 4]", "[3, 4.5]"), "'episode_lengths' is wrong"),
        (STATS_TEXT.replace("[3, 4]", "[3]"), "1 episode_lengths"),
        (STATS_TEXT.replace('["t", "e"]', '["t"]'), "1 episode_types for 2"),
        (STATS_TEXT.replace("1.5", "9" * 400), "too large for a float"),
        ('{"stats": "s", "stats": "t"}', "the key 'stats' twice"),
        ('{"stats": NaN, "videos": [], "env_info": {}}', "'stats' is wrong"),
        (None, "No such file"),
    ],
)
def test_damage_of_manifest_and_statistics_is_named(tmp_path, content, reason):
    """Each kind of damage causes one clear error."""
    path = tmp_path / "openaigym.some.0.1.json"
    read = read_manifest
    if content is not None:
        path.write_text(content)
        read = read_stats_file if "timestamps" in content else read_manifest
    with pytest.raises(UnreadableFile, match=reason) as caught:
        read(path)
    assert caught.value.path == path


# --- another process computes them ---------------------------------------------------

OPTIONS = {
    "deferred": {"video_callable": lambda episode: episode % 2 == 0},
    "not waited for": {"video_callable": lambda episode: True, "workers": 0},
    "live": {"video_callable": lambda episode: episode < 2, "render": "live"},
    "clips": {"step_trigger": lambda step: step == 3, "video_length": 4, "workers": 0},
    "live clips": {"video_length": 4, "render": "live"},
    "kept": {"keep": "best:1", "trajectory_callable": True, "workers": 0},
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_another_process_computes_the_same(options, tmp_path):
    """Existing files are already up to date, and deleted ones are restored."""
    view = {"render_mode": "rgb_array", "width": 32, "height": 32}
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=5, **view)
    with mjrec.Monitor(env, tmp_path, **options) as monitor:
        # The third episode is closed early.
        for seed, steps in enumerate((5, 5, 1)):
            monitor.reset(seed=seed)
            for _ in range(steps):
                monitor.step([0.0])
    manifest, stats = manifest_of(tmp_path), stats_of(tmp_path)
    [path] = tmp_path.glob("*.manifest.json")
    infix = monitor.infix
    listing = write_manifest_and_stats(tmp_path, infix)
    assert (listing.is_new_manifest, listing.is_new_stats) == (False, False)
    for written in (path, *tmp_path.glob("*.stats.json")):
        written.unlink()
    write_manifest_and_stats(tmp_path, infix)
    assert manifest_of(tmp_path) == manifest
    first = stats.pop("initial_reset_timestamp")
    anew = stats_of(tmp_path)
    # No episode states the time before the first reset.
    assert anew.pop("initial_reset_timestamp") >= first
    assert anew == stats


def test_an_episode_that_was_cut_is_in_the_journal(tmp_path, corridor):
    """The line gives the reason and the choice, and statistics omit the episode."""
    env = mjrec.Monitor(corridor, tmp_path, allow_early_reset=True)
    env.reset()
    # Others must not write the manifest of an open monitor.
    assert write_manifest_and_stats(tmp_path, env.infix) is None
    assert not list(tmp_path.glob("*.manifest.json"))
    env.step(0)
    env.reset()
    env.close()
    [first, second] = events_of(tmp_path, "cut")
    kind = {"chosen": True, "recording": "live"}
    assert first == {"episode_id": 0, "reason": "reset", **kind}
    assert (second["episode_id"], second["reason"]) == (1, "close")
    assert manifest_of(tmp_path)["mjrec"]["schedule"]["recorded"] == [0, 1]
    assert stats_of(tmp_path)["timestamps"] == []
