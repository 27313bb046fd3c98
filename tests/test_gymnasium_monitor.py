# SPDX-License-Identifier: Apache-2.0
import threading
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordEpisodeStatistics
from recordings import frames_in, manifest_of, metadata_of, stats_of, videos_in

import mjrec
from mjrec import ResetNeeded, ResetNotAllowed
from mjrec.monitors.gymnasium_monitor import success_in

BAR = [4, 8, 12, 16]


def shown(directory, episode):
    """Return the length of the corridor's bar in each frame of the video."""
    frames = frames_in(directory, episode)
    return [int((frame[0, :, 0] > 128).sum()) for frame in frames]


def test_records_scheduled_episodes(corridor, tmp_path, play, names, caplog):
    with mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 10)
    assert videos_in(tmp_path) == [0, 1, 8]
    assert stats_of(tmp_path)["episode_lengths"] == [3] * 10
    assert stats_of(tmp_path)["episode_rewards"] == [1.5] * 10
    manifest = manifest_of(tmp_path)
    assert list(manifest) == ["stats", "videos", "env_info", "mjrec"]
    env_info = {"gym_version": "mjrec-1", "env_id": "(unknown:Corridor)"}
    assert manifest["env_info"] == env_info
    assert "no spec" in caplog.text
    for pair in manifest["videos"]:
        assert all((tmp_path / name).is_file() for name in pair)
    schedule = manifest["mjrec"]["schedule"]
    assert schedule == {"name": "capped_cubic_video_schedule", "recorded": [0, 1, 8]}
    # No lock file or temporary file is left.
    assert [name for name in names(tmp_path) if name.startswith(".")] == []


def test_video_has_n_plus_1_frames_and_metadata(make_corridor, tmp_path, play):
    """If the monitor is closed within an episode, its frames are kept."""
    listed = []

    class Watching(make_corridor):
        def close(self):
            listed.append(any(tmp_path.glob("openaigym.manifest.*")))

    env = mjrec.Monitor(Watching(), tmp_path, fps=50)
    assert env.episode_id == 0
    play(env, 1, seed=7)
    env.reset()
    env.step(0)
    assert isinstance(env.stats_recorder, mjrec.StatsRecorder)
    assert isinstance(env.video_recorder, mjrec.VideoRecorder)
    env.close()
    env.close()
    assert listed == [True]
    # Steps after `close` do not count; those of the unfinished episode do.
    env.reset()
    env.step(0)
    assert (env.episode_id, env.get_total_steps()) == (2, 4)
    assert (env.get_episode_lengths(), env.get_episode_rewards()) == ([3], [1.5])
    assert (shown(tmp_path, 0), shown(tmp_path, 1)) == (BAR, BAR[:2])
    metadata = metadata_of(tmp_path, 0)
    known = "episode_id length reward seed frame_count fps height width recording"
    values = [0, 3, 1.5, 7, 4, "50", 32, 48, "live"]
    assert [metadata[key] for key in known.split()] == values
    ends = [metadata[key] for key in ("complete", "terminated", "truncated")]
    assert ends == [True, True, False]
    assert metadata["content_type"] == "video/mp4"
    assert metadata["versions"].keys() >= {"mjrec", "mujoco", "gymnasium", "python"}
    cut = metadata_of(tmp_path, 1)
    assert (cut["complete"], cut["reason"]) == (False, "close")
    assert len(manifest_of(tmp_path)["videos"]) == 2


@pytest.mark.parametrize("pop_frames", [True, False])
def test_frame_collections_keep_each_frame_once(corridor, tmp_path, play, pop_frames):
    env = gymnasium.wrappers.RenderCollection(corridor, pop_frames=pop_frames)
    with mjrec.Monitor(env, tmp_path) as env:
        play(env, 2)
    assert shown(tmp_path, 0) == shown(tmp_path, 1) == BAR


def test_write_upon_reset_writes_results_at_each_reset(make_corridor, tmp_path, play):
    """A monitor without videos needs no render mode."""
    corridor = make_corridor(render_mode=None)
    with mjrec.Monitor(corridor, tmp_path, False, write_upon_reset=True) as env:
        play(env, 2)
        env.reset()
        assert stats_of(tmp_path)["episode_lengths"] == [3, 3]
        assert manifest_of(tmp_path)["stats"]


def test_steps_and_resets_out_of_order_are_errors(corridor, tmp_path, play):
    """The environment is not called, and the episode can continue."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        with pytest.raises(ResetNeeded, match="before the first reset"):
            env.step(0)
        assert corridor.position == 0
        env.reset()
        env.step(0)
        with pytest.raises(ResetNotAllowed, match="allow_early_reset=True"):
            env.reset()
        assert corridor.position == 1
        env.step(0)
        env.step(0)
        with pytest.raises(ResetNeeded, match="after the end"):
            env.step(0)
        play(env, 1)
    assert stats_of(tmp_path)["episode_lengths"] == [3, 3]
    assert shown(tmp_path, 0) == BAR


def test_schedule_is_called_once_per_episode(corridor, tmp_path, play):
    """A second reset before the first step replaces the first frame."""
    asked = []

    def even(episode_id):
        asked.append(episode_id)
        return (episode_id + 1) % 2

    with mjrec.Monitor(corridor, tmp_path, even) as env:
        env.reset()
        env.reset()
        assert env.episode_id == 1
        play(env, 3)
    assert asked == [0, 1, 2]
    assert videos_in(tmp_path) == [0, 2]
    assert shown(tmp_path, 0) == BAR
    schedule = manifest_of(tmp_path)["mjrec"]["schedule"]
    assert schedule["name"].endswith("even")
    assert schedule["recorded"] == [0, 2]


def test_gymnasiums_checker_accepts_the_monitor(tmp_path):
    env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array")
    monitor = mjrec.Monitor(env, tmp_path, video_callable=False, allow_early_reset=True)
    with warnings.catch_warnings():
        # `check_env` warns about wrappers and HalfCheetah's unbounded spaces.
        warnings.simplefilter("ignore")
        check_env(monitor, skip_render_check=True)


def test_automatic_resets_begin_episodes(make_corridor, tmp_path):
    """If `step` itself resets, as in gym, the last frame of an episode is lost."""

    class Looping(make_corridor):
        metadata = make_corridor.metadata | {"semantics.autoreset": True}

        def step(self, action):
            result = super().step(action)
            if result[2]:
                self.reset()
            return result

    autoreset = gymnasium.wrappers.Autoreset(make_corridor())
    for env, steps, bar in ((autoreset, 7, BAR), (Looping(), 6, BAR[:3])):
        with mjrec.Monitor(env, tmp_path, lambda _: True, force=True) as monitor:
            monitor.reset()
            for _ in range(steps):
                monitor.step(0)
        assert stats_of(tmp_path)["episode_lengths"] == [3, 3]
        assert shown(tmp_path, 0) == shown(tmp_path, 1) == bar
    assert metadata_of(tmp_path, 0)["final_frame"] == "missing"


@pytest.mark.parametrize("thread", ["main", "mjrec-encoder"])
def test_garbage_collection_closes_the_monitor(corridor, tmp_path, play, thread):
    """The monitor is never closed on a thread for which `close` waits."""
    holder = [mjrec.Monitor(corridor, tmp_path)]
    play(holder[0], 1)
    collector = threading.Thread(target=holder.clear, name=thread)
    collector.start()
    collector.join()
    for other in threading.enumerate():
        if other.name == "close":
            other.join()
    assert stats_of(tmp_path)["episode_lengths"] == [3]
    assert corridor.closed == 1


def test_failing_frame_is_left_out_and_its_error_raised(make_corridor, tmp_path):
    class Blinking(make_corridor):
        def render(self):
            if self.position in (2, 5):
                raise RuntimeError("on purpose")
            return super().render()

    with mjrec.Monitor(Blinking(length=5), tmp_path) as env:
        env.reset()
        for count in (1, 2):
            for _ in range(count):
                env.step(0)
            with pytest.raises(RuntimeError, match="on purpose"):
                env.step(0)
    assert metadata_of(tmp_path, 0)["frame_steps"] == [[0, 1], [3, 4]]
    assert metadata_of(tmp_path, 0)["complete"] is True
    assert stats_of(tmp_path)["episode_lengths"] == [5]


def test_failing_close_is_a_note_on_the_exception(make_corridor, tmp_path, kill_ffmpeg):
    def fail():
        with mjrec.Monitor(make_corridor(length=9), tmp_path) as env:
            env.reset()
            env.step(0)
            assert kill_ffmpeg() == 1
            raise KeyError("of the user")

    with pytest.raises(KeyError, match="of the user") as raised:
        fail()
    assert "ffmpeg" in raised.value.__notes__[0]


def infos_of(env):
    env.reset(seed=3)
    infos, done = [], False
    while not done:
        *_, terminated, truncated, info = env.step(1)
        infos.append(info)
        done = terminated or truncated
    return infos


def monitor(directory, env=None, **options):
    made = gymnasium.make("CartPole-v1") if env is None else env
    return mjrec.Monitor(made, directory, video_callable=False, **options)


def test_episode_info_equals_record_episode_statistics(tmp_path):
    theirs = RecordEpisodeStatistics(gymnasium.make("CartPole-v1"))
    expected = infos_of(theirs)[-1]["episode"]
    with monitor(tmp_path, episode_info=True) as env:
        *before, last = infos_of(env)
    assert not any("episode" in info for info in before)
    episode = last["episode"]
    assert list(episode) == list(expected) == ["r", "l", "t"]
    assert (episode["r"], episode["l"]) == (expected["r"], expected["l"])
    assert 0 < episode["t"] < 60
    # The option is off by default, because Gymnasium asserts that the key is absent.
    with monitor(tmp_path / "off") as env:
        assert infos_of(RecordEpisodeStatistics(env))[-1]["episode"]["l"] > 0
    with monitor(tmp_path / "around", theirs, episode_info=True) as env:
        episode = infos_of(env)[-1]["episode"]
    assert episode["t"] == theirs.time_queue[-1]


@pytest.mark.parametrize(
    ("info", "expected"),
    [
        ({}, None),
        ({"is_success": True}, True),
        ({"is_success": 0.0}, False),
        ({"success": np.array([False])}, False),
        ({"is_success": None, "success": True}, True),
        ({"success": "no"}, None),
        ({"success": np.zeros(2)}, None),
    ],
)
def test_success_comes_from_the_info(info, expected):
    """Values that cannot be converted to bool are ignored."""
    assert success_in(info) is expected
