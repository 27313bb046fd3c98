# SPDX-License-Identifier: Apache-2.0
"""Statistics and manifest follow from the journal, whoever computes them."""

import gymnasium
import pytest
from recordings import events_of, manifest_of, stats_of

import mjrec
from mjrec.results.manifest_writing import write_manifest_and_stats

OPTIONS = {
    "deferred": {"video_callable": lambda episode: episode % 2 == 0},
    "not waited for": {"video_callable": lambda episode: True, "workers": 0},
    "live": {"video_callable": lambda episode: episode < 2, "render": "live"},
    "clips": {"step_trigger": lambda step: step == 3, "video_length": 4, "workers": 0},
    "live clips": {"video_length": 4, "render": "live"},
    "kept": {"keep": "best:1", "trajectory_callable": True, "workers": 0},
}


def record(directory, options):
    """Record three episodes, of which the last is closed early."""
    env = gymnasium.make(
        "InvertedPendulum-v5", render_mode="rgb_array", width=32, height=32
    )
    with mjrec.Monitor(env, directory, **options) as monitor:
        monitor.action_space.seed(1)
        for seed in range(3):
            monitor.reset(seed=seed)
            done = False
            while not done and monitor.episode_id < 3:
                action = monitor.action_space.sample()
                _, _, terminated, truncated, _ = monitor.step(action)
                done = terminated or truncated
        monitor.step(monitor.action_space.sample())


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_another_process_computes_the_same(options, tmp_path):
    """Nothing is new for it; and made from nothing, both files are the same again."""
    record(tmp_path, options)
    manifest, stats = manifest_of(tmp_path), stats_of(tmp_path)
    [path] = tmp_path.glob("*.manifest.json")
    infix = path.name.split(".manifest.")[1]
    listing = write_manifest_and_stats(tmp_path, infix)
    assert listing is not None
    assert (listing.is_new_manifest, listing.is_new_stats) == (False, False)
    for written in (path, *tmp_path.glob("*.stats.json")):
        written.unlink()
    write_manifest_and_stats(tmp_path, infix)
    assert manifest_of(tmp_path) == manifest
    first = stats.pop("initial_reset_timestamp")
    anew = stats_of(tmp_path)
    # The moment before the first reset stands in no episode.
    assert anew.pop("initial_reset_timestamp") >= first
    assert anew == stats


def test_an_episode_that_was_cut_is_in_the_journal(tmp_path, make_corridor):
    """With its reason, and whether it was chosen; it is no part of the statistics."""
    env = mjrec.Monitor(make_corridor(), tmp_path, allow_early_reset=True)
    env.reset()
    # Nobody else writes the manifest of a monitor that is open.
    infix = env.infix
    assert write_manifest_and_stats(tmp_path, infix) is None
    assert not list(tmp_path.glob("*.manifest.json"))
    env.step(0)
    env.reset()
    env.close()
    [first, second] = events_of(tmp_path, "cut")
    assert first == {
        "episode_id": 0,
        "reason": "reset",
        "chosen": True,
        "recording": "live",
    }
    assert (second["episode_id"], second["reason"]) == (1, "close")
    assert manifest_of(tmp_path)["mjrec"]["schedule"]["recorded"] == [0, 1]
    assert stats_of(tmp_path)["timestamps"] == []
