# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
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
from mjrec import InvalidArgument, NoPictures, PicturesDiffer, ResetNeeded
from mjrec.recorder.tracking import Tracker

LENGTHS = (2, 3)


@pytest.mark.parametrize("mode", [NEXT_STEP, DISABLED])
def test_whole_videos_where_the_end_can_be_seen(tmp_path: Path, mode: Any) -> None:
    """Each sub-environment's video has its reset and all steps."""
    with mjrec.Monitor(VectorCorridor(LENGTHS, mode), tmp_path) as env:
        play(env, 8)
    for monitor, length in zip(env.monitors, LENGTHS, strict=True):
        for episode in (0, 1):
            path = path_of(monitor, episode, "mp4")
            assert shown(path, step=16) == list(range(length + 1))
            assert metadata_at(path.with_suffix(".meta.json"))["complete"]


def test_a_frame_that_nobody_sees_is_said_to_be_missing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """In SAME_STEP the metadata says so, and one warning for all."""
    with mjrec.Monitor(VectorCorridor(LENGTHS, SAME_STEP), tmp_path) as env:
        play(env, 8)
    for monitor, length in zip(env.monitors, LENGTHS, strict=True):
        path = path_of(monitor, 1, "mp4")
        assert shown(path, step=16) == list(range(length))
        assert metadata_at(path.with_suffix(".meta.json"))["final_frame"] == "missing"
    [warning] = [r.message for r in caplog.records if "last frame" in r.message]
    assert "Monitor inside each of the functions" in warning


def test_no_warning_without_videos(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """No frame is missed where none is wanted."""
    with mjrec.Monitor(VectorCorridor(LENGTHS, SAME_STEP), tmp_path, False) as env:
        play(env, 4)
    assert not [
        r
        for r in caplog.records
        if r.levelno >= logging.WARNING and "frame" in r.message
    ]


@pytest.mark.parametrize("mode", MODES)
def test_statistics_are_those_of_gymnasium(tmp_path: Path, mode: Any) -> None:
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


def test_gymnasiums_own_vector_environment(tmp_path: Path) -> None:
    """CartPole, vectorised by itself, counts as RecordEpisodeStatistics does."""
    inner = gymnasium.make_vec("CartPole-v1", 3, "vector_entry_point")
    counted = RecordEpisodeStatistics(inner)
    with mjrec.Monitor(counted, tmp_path, False) as env:
        play(env, 60, seed=3)
    lengths = [length for each in env.get_episode_lengths() for length in each]
    assert sorted(lengths) == sorted(map(int, counted.length_queue))
    [name] = {
        metadata_at(p)["env_info"]["env_id"] for p in tmp_path.glob("*.manifest.json")
    }
    assert name == "CartPole-v1"


def test_it_draws_once_a_step_and_only_for_videos(tmp_path: Path) -> None:
    """One call of `render` is for all; without a running video there is none."""
    vector = VectorCorridor((3, 3), NEXT_STEP)
    with mjrec.Monitor(vector, tmp_path, lambda n: n == 0) as env:
        play(env, 3)
        assert vector.rendered == 4
        for _ in range(8):
            env.step(np.array([0, 0]))
    assert vector.rendered == 4


def test_trajectories_hold_what_can_be_seen(tmp_path: Path) -> None:
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


def test_success_is_read_from_the_final_info(tmp_path: Path) -> None:
    """Trackers are told what the environment says of an episode that is over."""
    told = []

    class Listening(Tracker):
        def episode(self, run: Any, episode: Any) -> None:
            told.append((run.env_index, episode.success))

    vector = VectorCorridor(LENGTHS, SAME_STEP)
    with mjrec.Monitor(vector, tmp_path, False, trackers=Listening()) as env:
        play(env, 3)
    assert told == [(0, True), (1, True)]


@pytest.mark.parametrize("mode", MODES)
def test_episode_info_is_that_of_gymnasium(tmp_path: Path, mode: Any) -> None:
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


def test_a_list_of_seeds_is_told_one_by_one(tmp_path: Path) -> None:
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


def test_a_masked_reset_leaves_the_others_alone(tmp_path: Path) -> None:
    """Their episodes go on."""
    with mjrec.Monitor(VectorCorridor(LENGTHS, DISABLED), tmp_path) as env:
        env.reset()
        for _ in range(2):
            env.step(np.array([0, 0]))
        with pytest.raises(ResetNeeded):
            env.step(np.array([0, 0]))
        env.reset(options={"reset_mask": np.array([True, False])})
        env.step(np.array([0, 0]))
    assert env.get_episode_lengths() == [[2], [3]]
    assert shown(path_of(env.monitors[1], 0, "mp4"), step=16) == [0, 1, 2, 3]


def test_the_environment_is_closed_as_asked(tmp_path: Path) -> None:
    """Arguments of its own `close` are passed on."""
    vector = VectorCorridor()
    env = mjrec.Monitor(vector, tmp_path, False)
    env.close(reason="done")
    env.close()
    assert vector.closings == [{"reason": "done"}]


def test_errors_are_noted_in_all_running_episodes(tmp_path: Path) -> None:
    """Their videos say what has ended them."""
    vector = VectorCorridor(LENGTHS)
    env = mjrec.Monitor(vector, tmp_path)
    env.reset()
    vector.lengths = None  # type: ignore[assignment]
    with pytest.raises(TypeError):
        env.step(np.array([0, 0]))
    env.close()
    for monitor in env.monitors:
        said = metadata_at(path_of(monitor, 0, "meta.json"))
        assert said["exception"]["type"] == "TypeError"


# --- what cannot be ---------------------------------------------------------------


def test_deferred_rendering_names_the_way_out(tmp_path: Path) -> None:
    """States cannot be seen from outside."""
    with pytest.raises(PicturesDiffer, match="inside"):
        mjrec.Monitor(VectorCorridor(), tmp_path / "run", render="deferred")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("view", [{"camera": 0}, {"height": 64, "width": 64}])
def test_the_view_cannot_be_chosen(tmp_path: Path, view: dict[str, Any]) -> None:
    """The error says where it can be."""
    with pytest.raises(InvalidArgument, match="Make them with the camera and size"):
        mjrec.Monitor(VectorCorridor(), tmp_path / "run", **view)


def test_videos_need_pictures(tmp_path: Path) -> None:
    """As for one environment; without videos nothing is missing."""
    vector = VectorCorridor(render_mode=None)
    with pytest.raises(NoPictures, match="render_mode"):
        mjrec.Monitor(vector, tmp_path / "run")
    with mjrec.Monitor(vector, tmp_path / "run", render="off") as env:
        play(env, 2)


def test_pictures_must_be_one_for_each(tmp_path: Path) -> None:
    """Said at the first reset."""
    vector = VectorCorridor()
    vector.render = lambda: (np.zeros((8, 8, 3), np.uint8),)  # type: ignore[method-assign]
    with (
        mjrec.Monitor(vector, tmp_path) as env,
        pytest.raises(InvalidArgument, match="each of its 2 sub-environments"),
    ):
        env.reset()


def test_pictures_of_different_sizes_are_different_videos(tmp_path: Path) -> None:
    """Each sub-environment has videos of its own, and of its own size."""
    with mjrec.Monitor(VectorCorridor(heights=(32, 48)), tmp_path) as env:
        play(env, 2)
    sizes = [metadata_at(path_of(m, 0, "meta.json"))["height"] for m in env.monitors]
    assert sizes == [32, 48]


# --- sub-environments in other processes --------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_environments_of_other_processes(
    make_corridor: Any, tmp_path: Path, mode: Any
) -> None:
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


def test_what_other_processes_know(tmp_path: Path) -> None:
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
