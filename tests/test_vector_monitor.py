# SPDX-License-Identifier: Apache-2.0
import functools
import gc
import json
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics, TransformReward
from processes import children
from recordings import frames_of
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

LENGTHS = (2, 3)


@pytest.fixture
def corridors(make_corridor):
    """Make corridors that are 2 and 3 steps long, in a list or in one object."""

    def make(mode=NEXT_STEP, *, inside=True):
        if not inside:
            return VectorCorridor(LENGTHS, mode)
        each = [functools.partial(make_corridor, length) for length in LENGTHS]
        return SyncVectorEnv(each, autoreset_mode=mode)

    return make


@pytest.mark.parametrize(
    ("inside", "mode"),
    [*((True, mode) for mode in MODES), (False, NEXT_STEP), (False, DISABLED)],
)
def test_every_sub_environment_has_whole_videos(corridors, tmp_path, inside, mode):
    """Each shows its reset and all its steps, the terminal one included."""
    with mjrec.Monitor(corridors(mode, inside=inside), tmp_path) as env:
        play(env, 8)
    for monitor, length in zip(env.monitors, LENGTHS, strict=True):
        for episode in (0, 1):
            path = path_of(monitor, episode, "mp4")
            assert shown(path, step=4 if inside else 16) == list(range(length + 1))
            assert "final_frame" not in metadata_at(path.with_suffix(".meta.json"))


def test_a_frame_that_nobody_sees_is_said_to_be_missing(tmp_path, caplog):
    """In SAME_STEP the metadata says so, and one warning for all."""
    with mjrec.Monitor(VectorCorridor(LENGTHS, SAME_STEP), tmp_path) as env:
        play(env, 8)
    for monitor, length in zip(env.monitors, LENGTHS, strict=True):
        path = path_of(monitor, 1, "mp4")
        assert shown(path, step=16) == list(range(length))
        assert metadata_at(path.with_suffix(".meta.json"))["final_frame"] == "missing"
    [warning] = [r.message for r in caplog.records if "last frame" in r.message]
    assert "Monitor inside each of the functions" in warning
    caplog.clear()
    vector = VectorCorridor(LENGTHS, SAME_STEP)
    with mjrec.Monitor(vector, tmp_path / "no videos", False) as env:
        play(env, 4)
    assert "frame" not in caplog.text


@pytest.mark.parametrize("mode", MODES)
def test_statistics_are_those_of_gymnasium(tmp_path, mode):
    """Lengths and returns are those that RecordEpisodeStatistics has."""
    counted = RecordEpisodeStatistics(VectorCorridor((2, 3, 5), mode))
    with mjrec.Monitor(counted, tmp_path, False) as env:
        play(env, 12)
    ours = sorted(
        (length, reward)
        for monitor in env.monitors
        for length, reward in zip(
            monitor.get_episode_lengths(), monitor.get_episode_rewards(), strict=True
        )
    )
    if mode != DISABLED:  # whose mask Gymnasium's own wrapper loses
        theirs = zip(counted.length_queue, counted.return_queue, strict=True)
        assert ours == sorted((int(n), float(r)) for n, r in theirs)
    expected = {NEXT_STEP: 4 + 3 + 2, SAME_STEP: 6 + 4 + 2, DISABLED: 6 + 4 + 2}
    assert len(ours) == expected[mode]


# Takes more than five seconds: 64 videos.
def test_sixty_four_sub_environments(tmp_path):
    """Each has its trajectory and its video; their logs' tails have 4 MiB together."""
    make = functools.partial(
        gymnasium.make, "InvertedPendulum-v5", max_episode_steps=2, height=16, width=16
    )
    vector = SyncVectorEnv([make] * 64)
    with mjrec.Monitor(vector, tmp_path, workers=2, quality="draft") as env:
        env.reset(seed=1)
        env.step(env.action_space.sample())
        tails = [path.stat().st_size for path in tmp_path.glob("*.tail")]
        assert len(tails) == 64
        assert sum(tails) < 5 << 20
        env.step(env.action_space.sample())
    assert env.get_episode_lengths() == [[2]] * 64
    for monitor in env.monitors:
        name = f"openaigym.{{}}.{monitor.infix}.{{}}000000.{{}}"
        trajectory = tmp_path / name.format("trajectory", "episode", "h5")
        assert len(mjrec.load_trajectory(trajectory).actions) == 2
        assert len(frames_of(tmp_path / name.format("video", "video", "mp4"))) == 3


def test_each_monitor_reports_its_own_failures(tmp_path):
    """Although the sub-environments share the processes that render."""
    make = functools.partial(
        gymnasium.make, "InvertedPendulum-v5", max_episode_steps=2, height=16, width=16
    )
    env = mjrec.Monitor(SyncVectorEnv([make] * 2), tmp_path, workers=1, quality="draft")
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


def test_closing_puts_the_environments_back(corridors, tmp_path):
    """Each is closed once; until then calls reach them through their monitors."""
    vector = corridors()
    originals = list(vector.envs)
    scaled = TransformReward(vector, lambda rewards: 10 * rewards)
    env = mjrec.Monitor(scaled, tmp_path, False, name_prefix="walk")
    assert all(a is b for a, b in zip(vector.envs, env.monitors, strict=True))
    env.set_monitor_mode("evaluation")
    env.reset(seed=40)
    assert list(env.step(np.array([0, 0]))[1]) == [5.0, 5.0]
    env.step(np.array([0, 0]))
    assert vector.get_attr("length") == LENGTHS
    assert len(vector.render()) == 2
    env.close()
    env.close()
    assert vector.envs == originals
    assert [each.closed for each in originals] == [1, 1]
    env.reset()
    env.step(np.array([0, 0]))
    # Rewards are those below vector wrappers; after close nothing is recorded.
    assert env.get_episode_rewards() == [[1.0], []]
    assert [m.stats_recorder.episode_types for m in env.monitors] == [["e"], []]
    for index, monitor in enumerate(env.monitors):
        # Links of two sub-environments have different names.
        assert monitor._options.name_prefix == f"walk-env-{index}"
        journal = tmp_path / f"openaigym.episodes.{monitor.infix}.jsonl"
        assert ('"seed": 40' in journal.read_text()) is (index == 0)


@pytest.mark.parametrize("resume", [False, True])
def test_a_failing_constructor_leaves_no_trace(make_corridor, tmp_path, names, resume):
    """The last sub-environment cannot be drawn: nothing was made of the first."""
    target = tmp_path / "a" / "b"
    if resume:
        with mjrec.Monitor(make_corridor(), target) as env:
            env.reset()
    before = names(target) if resume else None
    vector = SyncVectorEnv([make_corridor, lambda: make_corridor(render_mode=None)])
    originals = list(vector.envs)
    with pytest.raises(NoPictures, match="render_mode"):
        mjrec.Monitor(vector, target, resume=resume)
    assert vector.envs == originals
    assert [each.closed for each in originals] == [0, 0]
    if resume:
        assert names(target) == before
    else:
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("inside", [True, False])
def test_errors_are_noted_in_all_running_episodes(corridors, tmp_path, inside):
    """Their videos say what has ended them; nothing can be pickled or misused."""
    vector = corridors(inside=inside)

    def explode(action):
        raise RuntimeError("the motor burns")

    env = mjrec.Monitor(vector, tmp_path)
    with pytest.raises(mjrec.NotPicklable, match="VectorMonitor"):
        pickle.dumps(env)
    with pytest.raises(ResetNeeded):
        env.step(np.array([0, 0]))
    env.reset()
    (vector.envs[1].unwrapped if inside else vector).step = explode
    with pytest.raises(RuntimeError):
        env.step(np.array([0, 0]))
    env.close()
    for monitor in env.monitors:
        said = metadata_at(path_of(monitor, 0, "meta.json"))
        assert said["exception"]["message"] == "the motor burns"


def test_an_unknown_autoreset_mode_is_refused(tmp_path):
    """The error says what to set; nothing is made."""
    target = tmp_path / "run"
    with pytest.raises(InvalidArgument, match="autoreset_mode"):
        mjrec.Monitor(VectorCorridor(mode=None), target)
    assert not target.exists()


def test_sub_environments_of_different_names_need_a_common_one(corridors, tmp_path):
    """Results of one directory belong to one environment."""
    vector = corridors()
    vector.envs[0].spec = gymnasium.spec("CartPole-v1")
    with pytest.raises(InvalidArgument, match=r"CartPole-v1, None.*env_id="):
        mjrec.Monitor(vector, tmp_path)
    with mjrec.Monitor(vector, tmp_path, env_id="corridors") as env:
        play(env, 2)


def test_it_draws_once_a_step_and_only_for_videos(tmp_path):
    """One call of `render` is for all; without a running video there is none."""
    vector = VectorCorridor((3, 3), NEXT_STEP)
    with mjrec.Monitor(vector, tmp_path, lambda n: n == 0) as env:
        play(env, 3)
        assert vector.rendered == 4
        for _ in range(8):
            env.step(np.array([0, 0]))
        # Arguments of the environment's own `close` are passed on.
        env.close(reason="done")
    assert vector.rendered == 4
    assert vector.closings == [{"reason": "done"}]


def test_trajectories_hold_what_can_be_seen(tmp_path):
    """Actions, rewards and observations; the last one is the episode's own."""
    vector = VectorCorridor(LENGTHS, SAME_STEP)
    with mjrec.Monitor(
        vector, tmp_path, False, mode="evaluation", observations=True
    ) as env:
        env.reset()
        for step in range(3):
            env.step(np.array([step, 8 - step]))
    first, second = (
        mjrec.load_trajectory(
            tmp_path / f"openaigym.trajectory.{m.infix}.episode000000.h5"
        )
        for m in env.monitors
    )
    assert first.actions.tolist() == [0, 1]
    assert second.actions.tolist() == [8, 7, 6]
    assert second.rewards.tolist() == [0.5] * 3
    assert second.observations[:, 0].tolist() == [0, 1, 2, 3]
    assert second.terminated.tolist() == [False, False, True]


@pytest.mark.parametrize("mode", MODES)
def test_episode_info_is_that_of_gymnasium(tmp_path, mode):
    """The step that ends episodes says their return and length, as a wrapper does."""
    arguments = {"episode_info": True, "video_callable": False}
    ours = mjrec.Monitor(VectorCorridor(LENGTHS, mode), tmp_path, **arguments)
    theirs = RecordEpisodeStatistics(VectorCorridor(LENGTHS, mode))
    with ours:
        for env in (ours, theirs):
            env.reset()
            env.step(np.array([0, 0]))
        infos = [env.step(np.array([0, 0]))[4] for env in (ours, theirs)]
    for name in ("r", "l"):
        assert list(infos[0]["episode"][name]) == list(infos[1]["episode"][name])
    assert list(infos[0]["_episode"]) == list(infos[1]["_episode"]) == [True, False]
    assert infos[0]["episode"]["t"].shape == (2,)


def test_a_list_of_seeds_is_told_one_by_one(tmp_path):
    """A single seed, for one generator of all, is what each is told."""
    with mjrec.Monitor(VectorCorridor((2, 2), DISABLED), tmp_path, False) as env:
        for seed in ([5, 9], 3):
            env.reset(seed=seed, options={"reset_mask": np.array([True, True]), "a": 1})
            for _ in range(2):
                env.step(np.array([0, 0]))
    said = []
    for monitor in env.monitors:
        lines = (tmp_path / f"openaigym.episodes.{monitor.infix}.jsonl").read_text()
        entries = [json.loads(line) for line in lines.splitlines()]
        said.append([e["seed"] for e in entries if "seed" in e])
        assert [e["options"] for e in entries if "seed" in e] == [{"a": 1}] * 2
    assert said == [[5, 3], [9, 3]]


def test_a_masked_reset_leaves_the_others_alone(tmp_path):
    """Their episodes go on. Others are refused before anything is reset, if asked."""
    with mjrec.Monitor(
        VectorCorridor(LENGTHS, DISABLED), tmp_path, allow_early_reset=False
    ) as env:
        env.reset()
        for _ in range(2):
            env.step(np.array([0, 0]))
        with pytest.raises(ResetNeeded):
            env.step(np.array([0, 0]))
        with pytest.raises(ResetNotAllowed, match=r"\[1\]"):
            env.reset()
        env.reset(options={"reset_mask": np.array([True, False])})
        assert [m.episode_id for m in env.monitors] == [2, 1]
        env.step(np.array([0, 0]))
    assert env.get_episode_lengths() == [[2], [3]]
    assert shown(path_of(env.monitors[1], 0, "mp4"), step=16) == [0, 1, 2, 3]


def test_frames_must_be_one_for_each(tmp_path):
    """Said at the first reset."""
    vector = VectorCorridor()
    vector.render = lambda: (np.zeros((8, 8, 3), np.uint8),)
    with (
        mjrec.Monitor(vector, tmp_path) as env,
        pytest.raises(InvalidArgument, match="each of its 2 sub-environments"),
    ):
        env.reset()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"render": "deferred"}, PicturesDiffer, "inside"),
        ({"camera": 0}, InvalidArgument, "Create them with the camera and size"),
        ({"height": 64, "width": 64}, InvalidArgument, "height, width cannot"),
        ({}, NoPictures, "render_mode"),
    ],
)
def test_what_cannot_be_had_from_outside(tmp_path, options, error, message):
    """The error says where it can be had, and nothing is left."""
    vector = VectorCorridor(render_mode="rgb_array" if options else None)
    with pytest.raises(error, match=message):
        mjrec.Monitor(vector, tmp_path / "run", **options)
    assert not list(tmp_path.iterdir())
    with mjrec.Monitor(vector, tmp_path / "run", render="off") as env:
        play(env, 2)


@pytest.mark.parametrize("mode", MODES)
def test_environments_of_other_processes(make_corridor, tmp_path, mode):
    """Videos of all their frames, but the last where nobody sees it."""
    each = [lambda length=n: make_corridor(length) for n in LENGTHS]
    vector = AsyncVectorEnv(each, autoreset_mode=mode)
    with mjrec.Monitor(vector, tmp_path) as env:
        play(env, 3, seed=8)
    for index, (monitor, length) in enumerate(zip(env.monitors, LENGTHS, strict=True)):
        frames = length if mode == SAME_STEP else length + 1
        path = path_of(monitor, 0, "mp4")
        assert shown(path) == list(range(frames))
        assert metadata_at(path.with_suffix(".meta.json"))["seed"] == 8 + index
    assert vector.closed


def test_what_other_processes_know(tmp_path):
    """Their name and the time of their steps are asked for."""
    vector = AsyncVectorEnv(
        [
            lambda: gymnasium.make(
                "Hopper-v5", render_mode="rgb_array", width=64, height=64
            )
        ],
        # What was forked from a process with an OpenGL context hangs in its own.
        context="spawn",
    )
    with mjrec.Monitor(vector, tmp_path) as env:
        play(env, 2, seed=1)
    said = metadata_at(path_of(env.monitors[0], 0, "meta.json"))
    assert said["env_id"] == "Hopper-v5"
    assert said["fps"] == "125"
    assert said["recording_reason"].endswith("not objects in this process")


@pytest.fixture(autouse=True)
def no_process_is_left():
    """See that every test ends its processes."""
    before = children()
    yield
    gc.collect()
    assert children() <= before
