# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import threading
import warnings
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from parts import parametrize
from recordings import (
    frames_in,
    journal_of,
    manifest_of,
    metadata_of,
    stats_of,
    videos_in,
)

import mjrec
from mjrec import InvalidArgument, NoPictures, ResetNeeded, ResetNotAllowed


def finish_episode(env: Any) -> None:
    while not env.stats_recorder.done:
        env.step(0)


# --- what is recorded -----------------------------------------------------------


BAR = [4, 8, 12, 16]


def shown(directory: Path, episode: int) -> list[int]:
    """Return how long the corridor's bar is in each frame of a video."""
    frames = frames_in(directory, episode)
    return [int((frame[0, :, 0] > 128).sum()) for frame in frames]


def hashes_of(directory: Path) -> list[str]:
    """Return the hash of each frame of episode 0, as it was rendered."""
    [path] = directory.glob("*.video000000.framehash")
    lines = [line for line in path.read_text().splitlines() if line[0] != "#"]
    return [line.split()[-1] for line in lines]


def test_records_the_scheduled_episodes(
    corridor: Any,
    tmp_path: Path,
    play: Any,
    names: Any,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Of ten episodes 0, 1 and 8 have a video; statistics and manifest are gym's."""
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
    assert all(
        (tmp_path / name).is_file() for pair in manifest["videos"] for name in pair
    )
    schedule = manifest["mjrec"]["schedule"]
    assert schedule == {"name": "capped_cubic_video_schedule", "recorded": [0, 1, 8]}
    # No lock and no temporary file stays.
    assert [name for name in names(tmp_path) if name.startswith(".")] == []


def test_video_and_its_metadata(corridor: Any, tmp_path: Path, play: Any) -> None:
    """N + 1 frames of n steps, each with its hash; keys of gym and the episode's."""
    with mjrec.Monitor(corridor, tmp_path, fps=50) as env:
        play(env, 1, seed=7)
    assert shown(tmp_path, 0) == BAR
    assert len(hashes_of(tmp_path)) == 4
    expected = {
        "episode_id": 0,
        "content_type": "video/mp4",
        "complete": True,
        "terminated": True,
        "truncated": False,
        "length": 3,
        "reward": 1.5,
        "seed": 7,
        "frame_count": 4,
        "fps": "50",
        "height": 32,
        "width": 48,
        "recording": "live",
        "pictures": "env.render",
    }
    metadata = metadata_of(tmp_path, 0)
    assert metadata.items() >= expected.items()
    assert metadata["versions"].keys() >= {"mjrec", "mujoco", "gymnasium", "python"}


@pytest.mark.thorough
def test_metadata_names_renderer_and_camera(
    halfcheetah: Any, tmp_path: Path, play: Any
) -> None:
    """Pictures of MuJoCo say which OpenGL drew them and from where."""
    with mjrec.Monitor(halfcheetah, tmp_path) as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())
    metadata = metadata_of(tmp_path, 0)
    assert metadata["gl_renderer"]
    assert metadata["gl_version"]
    # Gymnasium before 1.4 shows the model's camera.
    assert metadata["camera"] == "track" or metadata["camera"]["type"]
    assert metadata["fps"] == "20"


def test_journal_has_a_line_for_each_episode_as_it_ends(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """Before anything is closed; options that JSON does not know are no obstacle."""
    with mjrec.Monitor(corridor, tmp_path, video_callable=False) as env:
        play(env, 1, seed=5)
        env.reset(options={"start": np.arange(2), "why": object})
        finish_episode(env)
        first, second = journal_of(tmp_path)
        # As in gym, results are written at the end.
        assert not list(tmp_path.glob("*.json"))
    assert (first["episode_id"], first["seed"], second["episode_id"]) == (0, 5, 1)
    assert (first["terminated"], first["truncated"]) == (True, False)
    assert first["start_time"] <= first["end_time"]
    assert second["options"]["start"] == [0, 1]
    assert "object" in second["options"]["why"]["repr"]


def test_truncation_ends_an_episode(tmp_path: Path, make_corridor: Any) -> None:
    """Done is terminated or truncated."""
    env = gymnasium.wrappers.TimeLimit(make_corridor(length=9), 2)
    with mjrec.Monitor(env, tmp_path) as env:
        env.reset()
        env.step(0)
        env.step(0)
        env.reset()
    assert stats_of(tmp_path)["episode_lengths"] == [2]
    assert metadata_of(tmp_path, 0)["truncated"] is True


def test_text_environment_is_recorded(
    make_corridor: Any, tmp_path: Path, play: Any
) -> None:
    """Its recordings are asciicasts, listed in the manifest."""
    with mjrec.Monitor(make_corridor(render_mode="ansi"), tmp_path) as env:
        play(env, 1)
    [[video, _]] = manifest_of(tmp_path)["videos"]
    assert video.endswith("video000000.json")
    assert json.loads((tmp_path / video).read_text())["duration"] == 0.4


@pytest.mark.parametrize("pop_frames", [True, False])
def test_frame_collections_lose_and_double_nothing(
    tmp_path: Path, make_corridor: Any, play: Any, pop_frames: bool
) -> None:
    """Whether or not RenderCollection forgets the frames it has given."""
    env = gymnasium.wrappers.RenderCollection(make_corridor(), pop_frames=pop_frames)
    with mjrec.Monitor(env, tmp_path) as env:
        play(env, 2)
    for episode in (0, 1):
        assert shown(tmp_path, episode) == BAR


# --- arguments ------------------------------------------------------------------


@pytest.mark.parametrize("never", [False, 0, np.False_])
def test_false_records_no_video(
    make_corridor: Any, tmp_path: Path, play: Any, never: Any
) -> None:
    """Whatever equals False does; the environment need not give pictures then."""
    with mjrec.Monitor(
        make_corridor(render_mode=None), tmp_path, video_callable=never
    ) as env:
        play(env, 2)
    assert videos_in(tmp_path) == []
    assert stats_of(tmp_path)["episode_lengths"] == [3, 3]


def test_schedule_is_asked_once_for_each_episode(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """With its number; what it returns counts by its truth."""
    asked: list[int] = []

    def odd(episode_id: int) -> Any:
        asked.append(episode_id)
        return episode_id % 2

    with mjrec.Monitor(corridor, tmp_path, odd) as env:
        play(env, 4)
    assert asked == [0, 1, 2, 3]
    assert videos_in(tmp_path) == [1, 3]
    assert manifest_of(tmp_path)["mjrec"]["schedule"]["name"].endswith("odd")


@pytest.mark.parametrize(
    "options",
    [
        {"video_callable": True},
        {"video_callable": "cubic"},
        {"mode": "testing"},
        {"fps": 0},
        {"fps": float("nan")},
        {"fps": True},
        {"uid": "a/b"},
        {"camera": "side"},
        {"width": 100},
    ],
)
def test_failed_construction_leaves_nothing(
    corridor: Any, tmp_path: Path, options: dict[str, Any]
) -> None:
    """No file, no directory, and the user's environment is still open."""
    with pytest.raises(InvalidArgument):
        mjrec.Monitor(corridor, tmp_path / "new", **options)
    gc.collect()
    assert not (tmp_path / "new").exists()
    assert corridor.closed == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera": "side"}, "track"),
        ({"width": 0}, "width.*0"),
        ({"height": -3}, "height.*-3"),
        ({"width": 1.5}, r"width.*1\.5"),
    ],
)
def test_a_view_that_cannot_be(
    halfcheetah: Any, tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    """The error names what was asked, or the cameras there are; nothing is left."""
    with pytest.raises(InvalidArgument, match=message):
        mjrec.Monitor(halfcheetah, tmp_path / "new", **options)
    assert not (tmp_path / "new").exists()


def test_what_cannot_be_recorded(make_corridor: Any, tmp_path: Path) -> None:
    """An environment without pictures, and what is no environment."""
    with pytest.raises(NoPictures, match=r'(?s)="rgb_array".*video_callable=False'):
        mjrec.Monitor(make_corridor(render_mode="human"), tmp_path)
    with pytest.raises(InvalidArgument, match=r"builtins\.dict"):
        mjrec.Monitor({}, tmp_path)


def test_write_upon_reset_writes_at_each_reset(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """Statistics and manifest are there before the monitor closes."""
    with mjrec.Monitor(corridor, tmp_path, False, write_upon_reset=True) as env:
        play(env, 2)
        env.reset()
        assert stats_of(tmp_path)["episode_lengths"] == [3, 3]
        assert manifest_of(tmp_path)["stats"]


def test_modes_give_the_types(corridor: Any, tmp_path: Path, play: Any) -> None:
    """set_monitor_mode takes effect at the next reset, and types stay aligned."""
    with mjrec.Monitor(corridor, tmp_path, mode="evaluation") as env:
        env.reset()
        env.reset()
        env.set_monitor_mode("training")
        for _ in range(3):
            env.step(0)
        play(env, 1)
        env.set_monitor_mode("evaluation")
        play(env, 1)
        env.reset()
    assert stats_of(tmp_path)["episode_types"] == ["e", "t", "e"]


# --- the state machine ----------------------------------------------------------


def test_wrong_use_is_refused(corridor: Any, tmp_path: Path, play: Any) -> None:
    """The environment is neither stepped nor reset, and the episode can go on."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        with pytest.raises(ResetNeeded, match="before the first reset"):
            env.step(0)
        assert corridor.position == 0
        env.reset()
        env.step(0)
        with pytest.raises(ResetNotAllowed, match="allow_early_reset=True"):
            env.reset()
        assert corridor.position == 1
        finish_episode(env)
        with pytest.raises(ResetNeeded, match="after the end"):
            env.step(0)
        play(env, 1)
    assert stats_of(tmp_path)["episode_lengths"] == [3, 3]
    assert shown(tmp_path, 0) == BAR


def test_gyms_questions_have_gyms_answers(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """Total steps cover the unfinished episode; after close nothing counts."""
    env = mjrec.Monitor(corridor, tmp_path)
    assert env.episode_id == 0
    play(env, 2)
    env.reset()
    env.step(0)
    assert isinstance(env.stats_recorder, mjrec.StatsRecorder)
    assert isinstance(env.video_recorder, mjrec.VideoRecorder)
    env.close()
    env.reset()
    env.step(0)
    assert (env.episode_id, env.get_total_steps()) == (3, 7)
    assert env.get_episode_lengths() == [3, 3]
    assert env.get_episode_rewards() == [1.5, 1.5]


def test_allowed_early_reset_keeps_the_video(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """The unfinished episode has a number and a video, marked; no statistics."""
    with mjrec.Monitor(
        corridor, tmp_path, lambda _: True, allow_early_reset=True
    ) as env:
        env.reset()
        env.step(0)
        play(env, 1)
    first, second = metadata_of(tmp_path, 0), metadata_of(tmp_path, 1)
    assert (first["complete"], first["reason"]) == (False, "reset")
    assert second["complete"]
    assert stats_of(tmp_path)["episode_lengths"] == [3]
    assert journal_of(tmp_path)[0]["episode_id"] == 1


def test_reset_before_any_step_replaces_the_picture(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """The number stays, and the schedule is asked for it once more at most."""
    with mjrec.Monitor(corridor, tmp_path, lambda _: True) as env:
        env.reset()
        env.reset()
        assert env.episode_id == 1
        play(env, 2)
    assert videos_in(tmp_path) == [0, 1]
    assert len(frames_in(tmp_path, 0)) == 4
    assert manifest_of(tmp_path)["mjrec"]["schedule"]["recorded"] == [0, 1]


def test_check_env_passes(tmp_path: Path) -> None:
    """Gymnasium's own checker accepts the monitor where early resets are allowed."""
    env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array")
    monitor = mjrec.Monitor(env, tmp_path, video_callable=False, allow_early_reset=True)
    with warnings.catch_warnings():
        # It warns of every wrapper, and of HalfCheetah's own unbounded spaces.
        warnings.simplefilter("ignore")
        check_env(monitor, skip_render_check=True)


# --- environments that reset themselves -----------------------------------------


def test_gymnasiums_autoreset_wrapper_begins_episodes(
    corridor: Any, tmp_path: Path
) -> None:
    """The step after the end is the reset; terminal frames are where they belong."""
    env = gymnasium.wrappers.Autoreset(corridor)
    with mjrec.Monitor(env, tmp_path, lambda _: True) as env:
        env.reset()
        for _ in range(7):
            env.step(0)
    assert stats_of(tmp_path)["episode_lengths"] == [3, 3]
    for episode in (0, 1):
        assert shown(tmp_path, episode) == BAR


def test_gyms_autoreset_environments_begin_episodes(
    make_corridor: Any, tmp_path: Path
) -> None:
    """The picture of the step that ends is the next episode's, and metadata says so."""

    class Looping(make_corridor):  # type: ignore[misc,valid-type]  # a fixture's class
        metadata = make_corridor.metadata | {"semantics.autoreset": True}

        def step(self, action: Any) -> Any:
            result = super().step(action)
            if result[2]:
                self.reset()
            return result

    with mjrec.Monitor(Looping(), tmp_path, lambda _: True) as env:
        env.reset()
        for _ in range(6):
            env.step(0)
    assert stats_of(tmp_path)["episode_lengths"] == [3, 3]
    assert len(frames_in(tmp_path, 0)) == 3
    assert metadata_of(tmp_path, 0)["final_frame"] == "missing"
    assert (frames_in(tmp_path, 1)[0] == frames_in(tmp_path, 0)[0]).all()


# --- leaving --------------------------------------------------------------------


def test_close_is_idempotent_and_closes_the_environment_last(
    make_corridor: Any, tmp_path: Path, play: Any
) -> None:
    """The manifest is there when the environment is closed, once."""
    seen: list[bool] = []

    class Watching(make_corridor):  # type: ignore[misc,valid-type]  # a fixture's class
        def close(self) -> None:
            seen.append(any(tmp_path.glob("openaigym.manifest.*")))

    env = mjrec.Monitor(Watching(), tmp_path)
    play(env, 1)
    env.close()
    env.close()
    assert seen == [True]


@pytest.mark.parametrize("steps", [0, 1])
def test_close_in_mid_episode_keeps_the_video(
    corridor: Any, tmp_path: Path, steps: int
) -> None:
    """It is marked incomplete and listed; the statistics leave the episode out."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        env.reset()
        for _ in range(steps):
            env.step(0)
    assert shown(tmp_path, 0) == BAR[: steps + 1]
    metadata = metadata_of(tmp_path, 0)
    assert (metadata["complete"], metadata["reason"]) == (False, "close")
    assert len(manifest_of(tmp_path)["videos"]) == 1
    assert stats_of(tmp_path)["episode_lengths"] == []


def test_garbage_collection_closes(corridor: Any, tmp_path: Path, play: Any) -> None:
    """A monitor that is forgotten writes its results."""
    env = mjrec.Monitor(corridor, tmp_path)
    play(env, 1)
    gone = weakref.ref(env)
    del env
    gc.collect()
    assert gone() is None
    assert stats_of(tmp_path)["episode_lengths"] == [3]
    assert corridor.closed == 1


LEAVING = """
import sys
sys.path.insert(0, {tests!r})
import conftest, gymnasium, mjrec
env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array", width=32, height=32)
env = mjrec.Monitor(env, {directory!r}, render="live")
env.reset(seed=0)
for _ in range(3):
    env.step(env.action_space.sample())
{how}
"""


@parametrize(
    ("how", "status"),
    [("", 0), ("sys.exit(3)", 3), ("raise RuntimeError('on purpose')", 1)],
    ids=["end", "exit", "exception"],
)
def test_leaving_the_interpreter_closes(tmp_path: Path, how: str, status: int) -> None:
    """Without close(): a live video, statistics and manifest, without noise."""
    script = LEAVING.format(
        tests=str(Path(__file__).parent), directory=str(tmp_path), how=how
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == status
    assert len(frames_in(tmp_path, 0)) == 4
    assert manifest_of(tmp_path)["videos"]
    assert "Exception ignored" not in done.stderr


def test_interrupted_end_is_taken_up_again(
    corridor: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while an episode's video is finished: close finishes it after all."""
    env = mjrec.Monitor(corridor, tmp_path)
    env.reset()
    env.step(0)
    env.step(0)
    finish = mjrec.VideoWriter.close

    def interrupted(writer: mjrec.VideoWriter) -> None:
        monkeypatch.setattr(mjrec.VideoWriter, "close", finish)
        raise KeyboardInterrupt

    monkeypatch.setattr(mjrec.VideoWriter, "close", interrupted)
    with pytest.raises(KeyboardInterrupt):
        env.step(0)
    env.close()
    assert len(frames_in(tmp_path, 0)) == 4
    assert metadata_of(tmp_path, 0)["complete"] is True
    assert len(manifest_of(tmp_path)["videos"]) == 1
    assert stats_of(tmp_path)["episode_lengths"] == [3]


def test_garbage_collected_on_a_thread_of_ours(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """Closing then happens on another thread, which may wait for ours."""
    holder = [mjrec.Monitor(corridor, tmp_path)]
    play(holder[0], 1)
    thread = threading.Thread(target=holder.clear, name="mjrec-encoder")
    thread.start()
    thread.join()
    for other in threading.enumerate():
        if other.name == "close":
            other.join()
    assert stats_of(tmp_path)["episode_lengths"] == [3]


@pytest.mark.parametrize(
    ("blind", "steps"), [(2, [[0, 1], [3, 5]]), (5, [[0, 4]])], ids=["middle", "last"]
)
def test_a_frame_that_fails_is_left_out(
    make_corridor: Any, tmp_path: Path, blind: int, steps: list[list[int]]
) -> None:
    """The error goes through; the episode goes on, or is complete."""

    class Blinking(make_corridor):  # type: ignore[misc,valid-type]  # a fixture's class
        def render(self) -> Any:
            if self.position == blind:
                raise RuntimeError("on purpose")
            return super().render()

    with mjrec.Monitor(Blinking(length=5), tmp_path) as env:
        env.reset()
        for step in range(1, 6):
            if step == blind:
                with pytest.raises(RuntimeError, match="on purpose"):
                    env.step(0)
            else:
                env.step(0)
    assert metadata_of(tmp_path, 0)["frame_steps"] == steps
    assert metadata_of(tmp_path, 0)["complete"] is True
    assert journal_of(tmp_path)[0]["length"] == 5


def test_forked_child_leaves_the_files_alone(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """A child may exit, but not record; the parent's files stay the parent's."""
    script = LEAVING.replace("HalfCheetah-v5", "CartPole-v1").format(
        tests=str(Path(__file__).parent),
        directory=str(tmp_path),
        how="""
import os
if os.fork() == 0:
    for call in (env.reset, lambda: env.step(0)):
        try:
            call()
        except mjrec.Error as error:
            print(error)
    sys.exit(0)
os.wait()
print(sorted(os.listdir(env.directory)))
""",
    )
    script = script.replace(
        'gymnasium.make("CartPole-v1", render_mode="rgb_array", width=32, height=32)',
        "conftest.Corridor(length=9)",
    ).replace("env.action_space.sample()", "0")
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.count("forked from it") == 2
    assert "manifest" not in done.stdout.splitlines()[-1]
    assert len(manifest_of(tmp_path)["videos"]) == 1


def test_dead_encoder_is_one_error_and_loses_no_statistics(
    make_corridor: Any, tmp_path: Path, play: Any, kill_ffmpeg: Callable[[], int]
) -> None:
    """The run can go on; the video is marked broken and not listed."""
    env = mjrec.Monitor(
        make_corridor(length=400, size=(256, 256)), tmp_path, lambda n: n == 0
    )
    env.reset()
    env.step(0)
    assert kill_ffmpeg() == 1
    with pytest.raises(mjrec.EncoderError, match="exit status: -9"):
        finish_episode(env)
    finish_episode(env)
    play(env, 1)
    env.close()
    assert stats_of(tmp_path)["episode_lengths"] == [400, 400]
    assert manifest_of(tmp_path)["videos"] == []
    metadata = metadata_of(tmp_path, 0)
    assert metadata["broken"]
    assert metadata["empty"]
    assert "-9" in metadata["broken_reason"]
    assert "frame_count" not in metadata
    assert len(manifest_of(tmp_path)["mjrec"]["broken"]) == 1


# --- cameras and sizes ----------------------------------------------------------


def test_own_size_and_camera(halfcheetah: Any, tmp_path: Path) -> None:
    """Frames larger than the offscreen buffer, while env.render() stays as it was."""
    buffer = halfcheetah.unwrapped.model.vis.global_
    before = (buffer.offheight, buffer.offwidth)
    wide = before[1] + 64
    with mjrec.Monitor(
        halfcheetah, tmp_path, camera="track", width=wide, height=48
    ) as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())
        assert env.render().shape == (48, 64, 3)
    metadata = metadata_of(tmp_path, 0)
    assert (metadata["width"], metadata["height"]) == (wide, 48)
    assert (metadata["camera"], metadata["pictures"]) == ("track", "scene")
    assert (buffer.offheight, buffer.offwidth) == before
    assert frames_in(tmp_path, 0)[0].std() > 10


@pytest.mark.thorough
def test_another_size_shows_the_same_scene(halfcheetah: Any, tmp_path: Path) -> None:
    """With no camera asked for it is the environment's own."""
    with mjrec.Monitor(halfcheetah, tmp_path / "own") as env:
        env.reset(seed=0)
    other = gymnasium.make(
        "HalfCheetah-v5", render_mode="rgb_array", width=32, height=24
    )
    with mjrec.Monitor(other, tmp_path / "sized", width=64, height=48) as env:
        env.reset(seed=0)
    own, sized = frames_in(tmp_path / "own", 0)[0], frames_in(tmp_path / "sized", 0)[0]
    assert np.abs(own.astype(int) - sized).mean() < 1


# --- several environments in one process ------------------------------------------


def make_halfcheetah(**options: Any) -> Any:
    return gymnasium.make(
        "HalfCheetah-v5", render_mode="rgb_array", width=64, height=48, **options
    )


def make_ant() -> Any:
    return gymnasium.make("Ant-v5", render_mode="rgb_array", width=64, height=48)


def record_steps(env: Any, steps: int = 3) -> None:
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(steps):
        env.step(env.action_space.sample())


@pytest.mark.thorough
def test_environments_that_take_turns_are_drawn_each_in_its_own_context(
    tmp_path: Path,
) -> None:
    """Interleaved, and after one was closed: the pictures are those of alone."""
    for name, make in (("cheetah", make_halfcheetah), ("ant", make_ant)):
        with mjrec.Monitor(make(), tmp_path / name) as env:
            record_steps(env)
    cheetah = mjrec.Monitor(make_halfcheetah(), tmp_path / "cheetah2")
    ant = mjrec.Monitor(make_ant(), tmp_path / "ant2")
    for env in (cheetah, ant):
        env.action_space.seed(0)
        env.reset(seed=0)
    for _ in range(2):
        cheetah.step(cheetah.action_space.sample())
        ant.step(ant.action_space.sample())
    ant.step(ant.action_space.sample())
    ant.close()
    gc.collect()
    cheetah.step(cheetah.action_space.sample())
    cheetah.close()
    for name in ("cheetah", "ant"):
        assert hashes_of(tmp_path / f"{name}2") == hashes_of(tmp_path / name)


@pytest.mark.thorough
@pytest.mark.skipif(
    os.environ["MUJOCO_GL"] != "egl",
    reason="only EGL can make a context current again that somebody else made",
)
def test_the_users_other_environment_is_drawn_as_before(tmp_path: Path) -> None:
    """Recording one environment, with its own camera or another, and closing it."""
    other = make_ant()
    other.reset(seed=0)
    before = other.render()
    for number, options in enumerate([{}, {"camera": "track"}]):
        with mjrec.Monitor(
            make_halfcheetah(), tmp_path / str(number), **options
        ) as env:
            record_steps(env)
            if options:
                assert (other.render() == before).all()
    fresh = make_ant()
    fresh.reset(seed=0)
    assert (fresh.render() == before).all()
    fresh.close()
    other.close()


def test_users_exception_is_not_hidden_by_a_failing_close(
    make_corridor: Any, tmp_path: Path, kill_ffmpeg: Callable[[], int]
) -> None:
    """The encoder's failure is a note on it."""

    def fail() -> None:
        with mjrec.Monitor(make_corridor(length=9), tmp_path) as env:
            env.reset()
            env.step(0)
            assert kill_ffmpeg() == 1
            raise KeyError("of the user")

    with pytest.raises(KeyError, match="of the user") as raised:
        fail()
    assert "ffmpeg" in raised.value.__notes__[0]


def test_close_can_be_tried_again_when_there_is_space(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """A directory that is gone for a while stands for a full disk."""
    env = mjrec.Monitor(corridor, tmp_path / "a", video_callable=False)
    play(env, 1)
    (tmp_path / "a").rename(tmp_path / "b")
    with pytest.raises(mjrec.FileNotWritten, match=r"stats\.json.*next close\(\)"):
        env.close()
    (tmp_path / "b").rename(tmp_path / "a")
    env.close()
    assert stats_of(tmp_path / "a")["episode_lengths"] == [3]
    assert manifest_of(tmp_path / "a")


def test_environment_that_the_user_closed_first(tmp_path: Path) -> None:
    """The recordings are finished all the same."""
    env = make_halfcheetah()
    monitor = mjrec.Monitor(env, tmp_path)
    record_steps(monitor)
    env.close()
    monitor.close()
    assert len(frames_in(tmp_path, 0)) == 4
