# SPDX-License-Identifier: Apache-2.0
"""Monitors record vector environments."""

import contextlib
import functools
import gc
import hashlib
import pickle
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics, TransformReward
from parts import parametrize
from recordings import frames_of, hashes_at
from vector_environments import (
    DISABLED,
    MODES,
    NEXT_STEP,
    SAME_STEP,
    VectorCorridor,
    metadata_at,
    path_of,
    play,
    shown,
)

import mjrec
from mjrec import (
    InvalidArgument,
    NoPictures,
    PicturesDiffer,
    ResetNeeded,
    ResetNotAllowed,
)
from mjrec.frames import grid_frame

LENGTHS = (2, 3)
pytestmark = pytest.mark.usefixtures("no_process_is_left")


@pytest.fixture
def corridors(make_corridor):
    def make(mode=NEXT_STEP, *, kind="sync", lengths=LENGTHS, size=(32, 48)):
        if kind == "one object":
            return VectorCorridor(lengths, mode)
        constructors = [functools.partial(make_corridor, n, size=size) for n in lengths]
        vector = {"sync": SyncVectorEnv, "async": AsyncVectorEnv}[kind]
        return vector(constructors, autoreset_mode=mode)

    return make


def pendulums(count):
    """Make small pendulums with episodes of two steps."""
    make = functools.partial(
        gymnasium.make, "InvertedPendulum-v5", max_episode_steps=2, height=16, width=16
    )
    return SyncVectorEnv([make] * count)


@pytest.mark.parametrize("kind", ["sync", "one object", "async"])
@pytest.mark.parametrize("mode", MODES)
def test_each_sub_environment_has_whole_videos(corridors, tmp_path, caplog, kind, mode):
    """Metadata and one warning say when a reset hides the terminal frame."""
    is_hidden = kind != "sync" and mode == SAME_STEP
    with mjrec.Monitor(corridors(mode, kind=kind), tmp_path) as env:
        play(env, 8, seed=8)
    for index, (monitor, length) in enumerate(zip(env.monitors, LENGTHS, strict=True)):
        for episode in (0, 1):
            path = path_of(monitor, episode, "mp4")
            frames = list(range(length + (not is_hidden)))
            assert shown(path, step=16 if kind == "one object" else 4) == frames
            metadata = metadata_at(path.with_suffix(".meta.json"))
            assert metadata.get("final_frame") == ("missing" if is_hidden else None)
            if episode == 0:
                assert metadata["seed"] == (8 if kind == "one object" else 8 + index)
    messages = [r.message for r in caplog.records if "last frame" in r.message]
    advice = ["functions that create them" in each for each in messages]
    assert advice == [True] * is_hidden


# Takes more than five seconds: 64 videos.
def test_sixty_four_sub_environments(tmp_path):
    """Each sub-environment has a trajectory and video; all log tails share 4 MiB."""
    with mjrec.Monitor(pendulums(64), tmp_path, workers=2, quality="draft") as env:
        env.reset(seed=1)
        env.step(env.action_space.sample())
        tails = [path.stat().st_size for path in tmp_path.glob("*.tail")]
        assert len(tails) == 64
        assert sum(tails) < 5 << 20
        env.step(env.action_space.sample())
    assert env.get_episode_lengths() == [[2]] * 64
    for monitor in env.monitors:
        name = f"openaigym.trajectory.{monitor.infix}.episode000000.h5"
        assert len(mjrec.load_trajectory(tmp_path / name).actions) == 2
        assert len(frames_of(path_of(monitor, 0, "mp4"))) == 3


def test_each_monitor_reports_its_own_failures(tmp_path):
    """The sub-environments share the rendering processes."""
    env = mjrec.Monitor(pendulums(2), tmp_path, workers=1, quality="draft")
    good, bad = env.monitors
    path_of(bad, 0, "mp4").mkdir()
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros((2, 1), np.float32))
    with pytest.raises(mjrec.RenderError) as caught:
        bad.close()
    assert [*caught.value.failures] == [path_of(bad, 0, "mp4").name]
    good.close()
    with pytest.raises(mjrec.RenderError):
        env.close()


def test_close_restores_the_sub_environments(corridors, tmp_path):
    """Each sub-environment closes once, and until then calls go through its monitor."""
    vector = corridors()
    originals = list(vector.envs)
    scaled = TransformReward(vector, lambda rewards: 10 * rewards)
    env = mjrec.Monitor(scaled, tmp_path, False, name_prefix="walk")
    assert all(a is b for a, b in zip(vector.envs, env.monitors, strict=True))
    env.set_monitor_mode("evaluation")
    env.reset()
    assert list(env.step(np.array([0, 0]))[1]) == [5.0, 5.0]
    env.step(np.array([0, 0]))
    assert vector.get_attr("length") == LENGTHS
    assert len(vector.render()) == 2
    for _ in range(2):
        env.close()
        assert vector.envs == originals
        assert [each.closed for each in originals] == [1, 1]
        env.reset()
        env.step(np.array([0, 0]))
    # Monitors record rewards before vector wrappers change them, until they close.
    assert env.get_episode_rewards() == [[1.0], []]
    assert [m.stats_recorder.episode_types for m in env.monitors] == [["e"], []]
    prefixes = [monitor._options.name_prefix for monitor in env.monitors]
    assert prefixes == ["walk-env-0", "walk-env-1"]


@pytest.mark.parametrize("resume", [False, True])
def test_failing_constructor_leaves_no_files(make_corridor, tmp_path, names, resume):
    """The constructor fails because the last sub-environment has no frames."""
    target = tmp_path / "a" / "b"
    if resume:
        mjrec.Monitor(make_corridor(), target).close()
    before = names(target if resume else tmp_path)
    vector = SyncVectorEnv([make_corridor, lambda: make_corridor(render_mode=None)])
    originals = list(vector.envs)
    with pytest.raises(NoPictures, match="render_mode"):
        mjrec.Monitor(vector, target, resume=resume)
    assert vector.envs == originals
    assert [each.closed for each in originals] == [0, 0]
    assert names(target if resume else tmp_path) == before


@pytest.mark.parametrize("kind", ["sync", "one object"])
def test_error_is_noted_in_all_running_episodes(corridors, tmp_path, kind):
    """Stepping before a reset and pickling are errors as well."""
    vector = corridors(kind=kind)

    def explode(action):
        raise RuntimeError("the motor burns")

    env = mjrec.Monitor(vector, tmp_path)
    with pytest.raises(mjrec.NotPicklable, match="VectorMonitor"):
        pickle.dumps(env)
    with pytest.raises(ResetNeeded):
        env.step(np.array([0, 0]))
    env.reset()
    (vector.envs[1].unwrapped if kind == "sync" else vector).step = explode
    with pytest.raises(RuntimeError):
        env.step(np.array([0, 0]))
    env.close()
    for monitor in env.monitors:
        metadata = metadata_at(path_of(monitor, 0, "meta.json"))
        assert metadata["exception"]["message"] == "the motor burns"


def test_different_env_ids_need_a_common_one(corridors, tmp_path):
    vector = corridors()
    vector.envs[0].spec = gymnasium.spec("CartPole-v1")
    with pytest.raises(InvalidArgument, match=r"CartPole-v1, None.*env_id="):
        mjrec.Monitor(vector, tmp_path)
    with mjrec.Monitor(vector, tmp_path, env_id="corridors") as env:
        play(env, 2)


def test_render_is_called_once_a_step_and_only_for_videos(tmp_path):
    vector = VectorCorridor((3, 3), NEXT_STEP)
    with mjrec.Monitor(vector, tmp_path, lambda n: n == 0) as env:
        play(env, 3)
        assert vector.rendered == 4
        for _ in range(8):
            env.step(np.array([0, 0]))
        env.close(reason="done")  # This argument reaches the environment.
    assert vector.rendered == 4
    assert vector.closings == [{"reason": "done"}]


def test_trajectories_hold_actions_rewards_and_observations(tmp_path):
    """The last observation is the terminal one, not that of the next reset."""
    vector = VectorCorridor(LENGTHS, SAME_STEP)
    options = {"mode": "evaluation", "observations": True}
    with mjrec.Monitor(vector, tmp_path, False, **options) as env:
        env.reset()
        for step in range(3):
            env.step(np.array([step, 8 - step]))
    paths = sorted(tmp_path.glob("*.episode000000.h5"))
    first, second = map(mjrec.load_trajectory, paths)
    assert first.actions.tolist() == [0, 1]
    assert second.actions.tolist() == [8, 7, 6]
    assert second.rewards.tolist() == [0.5] * 3
    assert second.observations[:, 0].tolist() == [0, 1, 2, 3]
    assert second.terminated.tolist() == [False, False, True]


@pytest.mark.parametrize("mode", MODES)
def test_statistics_and_episode_info_equal_those_of_gymnasium(tmp_path, mode):
    theirs = RecordEpisodeStatistics(VectorCorridor(LENGTHS, mode))
    ours = mjrec.Monitor(
        VectorCorridor(LENGTHS, mode), tmp_path, False, episode_info=True
    )
    with ours:
        for env in (ours, theirs):
            env.reset()
            env.step(np.array([0, 0]))
        (*_, info), (*_, expected) = (
            env.step(np.array([0, 0])) for env in (ours, theirs)
        )
        for name in ("r", "l"):
            assert list(info["episode"][name]) == list(expected["episode"][name])
        assert list(info["_episode"]) == list(expected["_episode"]) == [True, False]
        assert info["episode"]["t"].shape == (2,)
        if mode != DISABLED:  # Gymnasium's own wrapper loses the mask in this mode.
            for _ in range(10):
                for env in (ours, theirs):
                    env.step(np.array([0, 0]))
            counted = zip(theirs.length_queue, theirs.return_queue, strict=True)
            lengths = np.concatenate(ours.get_episode_lengths())
            rewards = np.concatenate(ours.get_episode_rewards())
            assert sorted(zip(lengths, rewards, strict=True)) == sorted(counted)
            assert len(lengths) == {NEXT_STEP: 4 + 3, SAME_STEP: 6 + 4}[mode]


def test_masked_reset_leaves_other_episodes_running(tmp_path):
    """If early resets are forbidden, they are refused before anything is reset."""
    vector = VectorCorridor(LENGTHS, DISABLED)
    with mjrec.Monitor(vector, tmp_path, allow_early_reset=False) as env:
        both, first = np.array([True, True]), np.array([True, False])
        env.reset(seed=[5, 9], options={"reset_mask": both, "a": 1})
        for _ in range(2):
            env.step(np.array([0, 0]))
        with pytest.raises(ResetNeeded):
            env.step(np.array([0, 0]))
        with pytest.raises(ResetNotAllowed, match=r"\[1\]"):
            env.reset()
        env.reset(options={"reset_mask": first})
        assert [m.episode_id for m in env.monitors] == [2, 1]
        env.step(np.array([0, 0]))
    episodes = list(mjrec.iter_episodes(tmp_path))
    facts = [(each.seed, each.options, each.length) for each in episodes]
    assert facts == [(5, {"a": 1}, 2), (9, {"a": 1}, 3)]
    assert shown(path_of(env.monitors[1], 0, "mp4"), step=16) == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("made", "options", "error", "message"),
    [
        ({}, {"render": "deferred"}, PicturesDiffer, "inside"),
        ({}, {"camera": 0}, InvalidArgument, "Create them with the camera and size"),
        ({}, {"height": 64, "width": 64}, InvalidArgument, "height, width cannot"),
        ({"render_mode": None}, {}, NoPictures, "render_mode"),
        ({"mode": None}, {}, InvalidArgument, "autoreset_mode"),
    ],
)
def test_unsupported_options_are_errors(tmp_path, made, options, error, message):
    """The error names the alternative, and no file is created."""
    with pytest.raises(error, match=message):
        mjrec.Monitor(VectorCorridor(**made), tmp_path / "run", **options)
    assert not list(tmp_path.iterdir())


def test_subprocess_environments_are_asked_for_name_and_timestep(tmp_path):
    view = {"render_mode": "rgb_array", "width": 64, "height": 64}
    # A process forked while an OpenGL context exists hangs when it uses its own.
    vector = AsyncVectorEnv(
        [lambda: gymnasium.make("Hopper-v5", **view)], context="spawn"
    )
    with mjrec.Monitor(vector, tmp_path) as env:
        play(env, 2, seed=1)
    metadata = metadata_at(path_of(env.monitors[0], 0, "meta.json"))
    assert (metadata["env_id"], metadata["fps"]) == ("Hopper-v5", "125")
    assert metadata["recording_reason"].endswith("not objects in this process")


def monitored_hopper(directory):
    def make():
        # A spawned process starts without these imports.
        import gymnasium

        import mjrec

        env = gymnasium.make("Hopper-v5", max_episode_steps=3, width=64, height=64)
        return mjrec.Monitor(env, directory, resume=True, render="deferred", workers=1)

    return make


@parametrize(
    ("context", "mode"),
    [("spawn", NEXT_STEP), ("forkserver", SAME_STEP), ("fork", DISABLED)],
)
def test_monitors_inside_subprocesses_record_whole_videos(tmp_path, context, mode):
    """Daemonic subprocesses cannot start `multiprocessing` children."""
    make = monitored_hopper(tmp_path)
    env = AsyncVectorEnv([make, make], context=context, autoreset_mode=mode)
    workers = {process.pid for process in env.processes}
    play(env, 4, seed=3)
    env.close()
    for worker in workers:
        [hashes] = tmp_path.glob(f"*.{worker}.video000000.framehash")
        assert len(hashes_at(hashes)) == 4
        assert hashes.with_suffix(".mp4").exists()
    results = mjrec.load_results(tmp_path)
    assert list(results["episode_lengths"]) == [3, 3]
    assert not list(tmp_path.glob(".*"))


def tiles_at(path, *, step):
    """Return the positions in the tiles of a 2x2 grid of 32x64 frames."""
    positions = []
    for frame in frames_of(path):
        assert frame.shape == (64, 128, 3)
        tiles = [frame[y, x : x + 64, 0] for y in (16, 48) for x in (0, 64)]
        positions.append([round(int((row > 128).sum()) / step) - 1 for row in tiles])
    return positions


@pytest.mark.parametrize("kind", ["sync", "one object"])
@pytest.mark.parametrize("mode", MODES)
def test_tiled_video_shows_all_sub_environments(corridors, tmp_path, mode, kind):
    """The video follows the first sub-environment, and metadata notes hidden frames."""
    vector = corridors(mode, kind=kind, lengths=(2, 3, 2), size=(32, 64))
    with mjrec.Monitor(vector, tmp_path, tiled=True) as env:
        play(env, 8)
    first, second = (path_of(env.monitors[0], k, "tiled.mp4") for k in (0, 1))
    last = [0, 2, 0, -1] if mode == SAME_STEP else [2, 2, 2, -1]
    # The fourth tile is padding.
    step = 4 if kind == "sync" else 16
    assert tiles_at(first, step=step) == [[0, 0, 0, -1], [1, 1, 1, -1], last]
    assert [tiles[0] for tiles in tiles_at(second, step=step)] == [0, 1, last[0]]
    metadata = metadata_at(first.with_suffix(".meta.json"))
    assert (metadata["tiled"], metadata["rows"], metadata["columns"]) == (True, 2, 2)
    assert (metadata["complete"], metadata["length"]) == (True, 2)
    assert metadata["reward"] == 1.0
    assert metadata.get("final_frame") == ("missing" if mode == SAME_STEP else None)
    assert len(hashes_at(first.with_suffix(".framehash"))) == 3
    videos = mjrec.load_results(tmp_path)["videos"]
    names = {Path(video).name for video, _ in videos}
    assert names >= {first.name, path_of(env.monitors[0], 0, "mp4").name}


@pytest.mark.parametrize("reason", ["reset", "close", "exception"])
def test_incomplete_tiled_video_has_its_reason(corridors, tmp_path, reason):
    vector = corridors(kind="one object", lengths=(2, 3, 2))
    with (
        contextlib.suppress(RuntimeError),
        mjrec.Monitor(vector, tmp_path, tiled=True) as env,
    ):
        env.reset()
        env.step(np.array([0, 0, 0]))
        if reason == "reset":
            env.reset()
        if reason == "exception":
            raise RuntimeError("enough")
    metadata = metadata_at(path_of(env.monitors[0], 0, "tiled.meta.json"))
    assert metadata["complete"] is False
    assert metadata["reason"] == reason
    assert (metadata["length"], metadata["frame_count"]) == (1, 2)


def frame_of(env):
    # Gymnasium renders into the current context.
    env.unwrapped.mujoco_renderer.viewer.make_context_current()
    return env.render()


# Takes more than five seconds: each environment is rendered alone and tiled.
def test_tiles_equal_the_frames_of_each_environment(tmp_path):
    view = {"render_mode": "rgb_array", "width": 64, "height": 64}
    several = [gymnasium.make("Hopper-v5", **view) for _ in range(2)]
    vector = SyncVectorEnv([lambda e=e: e for e in several])
    expected = []
    gc.collect()  # This frees the OpenGL contexts of earlier tests.
    with mjrec.Monitor(vector, tmp_path, tiled=True) as env:
        env.reset(seed=4)
        for _ in range(2):
            env.step(env.action_space.sample())
            drawn = grid_frame([frame_of(each) for each in several])
            expected.append(hashlib.sha256(drawn.tobytes()).hexdigest())
    path = path_of(env.monitors[0], 0, "tiled.framehash")
    assert hashes_at(path)[1:] == expected


def test_bad_frame_is_an_error_or_a_warning(tmp_path, caplog):
    """A bad tiled frame may be only a warning, but too few frames always fail."""
    vector = VectorCorridor(heights=(32, 48))
    with (
        mjrec.Monitor(vector, tmp_path / "raise", tiled=True) as env,
        pytest.raises(InvalidArgument, match="64x32, 64x48"),
    ):
        env.reset()
    with mjrec.Monitor(vector, tmp_path, tiled=True, on_error="warn") as env:
        play(env, 3)
    assert "64x32, 64x48" in caplog.text
    assert not list(tmp_path.glob("*.tiled.mp4"))
    vector.render = lambda: (np.zeros((8, 8, 3), np.uint8),)
    with (
        mjrec.Monitor(vector, tmp_path / "few") as few,
        pytest.raises(InvalidArgument, match="each of its 2 sub-environments"),
    ):
        few.reset()
    assert path_of(env.monitors[1], 0, "mp4").exists()
