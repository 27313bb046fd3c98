# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import atexit
import gc
import json
import logging
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


def test_records_the_scheduled_episodes(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """Of ten episodes 0, 1 and 8 have a video; all are in the statistics."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 10)
    assert videos_in(tmp_path) == [0, 1, 8]
    assert stats_of(tmp_path)["episode_lengths"] == [3] * 10
    assert stats_of(tmp_path)["episode_rewards"] == [1.5] * 10
    schedule = manifest_of(tmp_path)["mjrec"]["schedule"]
    assert schedule == {"name": "capped_cubic_video_schedule", "recorded": [0, 1, 8]}


def test_video_has_the_first_and_the_last_frame(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """An episode of n steps has n + 1 frames."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 1)
    shown = [int((frame[0, :, 0] > 128).sum()) for frame in frames_in(tmp_path, 0)]
    assert shown == [4, 8, 12, 16]


def test_frame_hashes_are_of_the_frames_handed_over(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """A framehash file stands beside every video."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 1)
    [path] = tmp_path.glob("*.framehash")
    lines = [line for line in path.read_text().splitlines() if line[0] != "#"]
    assert len(lines) == 4


def test_metadata_says_what_is_in_the_video(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """Keys of gym, the episode's, and what made the pictures."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 1, seed=7)
    metadata = metadata_of(tmp_path, 0)
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
        "height": 32,
        "width": 48,
        "recording": "live",
        "pictures": "env.render",
    }
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


def test_manifest_is_gyms(corridor: Any, tmp_path: Path, play: Any) -> None:
    """Keys in gym's order, base names only, env_info with exactly its two keys."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 1)
    manifest = manifest_of(tmp_path)
    assert list(manifest) == ["stats", "videos", "env_info", "mjrec"]
    assert manifest["env_info"] == {
        "gym_version": "mjrec-1",
        "env_id": "(unknown:Corridor)",
    }
    [[video, metadata]] = manifest["videos"]
    assert (tmp_path / video).exists()
    assert (tmp_path / metadata).exists()


def test_journal_has_a_line_for_each_episode_as_it_ends(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """Before anything is closed, with seed and the way it ended."""
    env = mjrec.Monitor(corridor, tmp_path, video_callable=False)
    play(env, 2, seed=5)
    lines = journal_of(tmp_path)
    assert [line["episode_id"] for line in lines] == [0, 1]
    assert [line["seed"] for line in lines] == [5, 5]
    assert lines[0]["terminated"] is True
    assert lines[0]["truncated"] is False
    assert lines[0]["start_time"] <= lines[0]["end_time"]
    env.close()


def test_options_that_json_does_not_know_do_not_stop_the_run(
    corridor: Any, tmp_path: Path
) -> None:
    """They are written as what they look like."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        env.reset(options={"start": np.arange(2), "why": object})
        for _ in range(3):
            env.step(0)
    options = journal_of(tmp_path)[0]["options"]
    assert options["start"] == [0, 1]
    assert "object" in options["why"]["repr"]


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
        frames = frames_in(tmp_path, episode)
        shown = [int((frame[0, :, 0] > 128).sum()) for frame in frames]
        assert shown == [4, 8, 12, 16]


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


@pytest.mark.parametrize("options", [{"width": 0}, {"height": -3}, {"width": 1.5}])
def test_impossible_size_is_an_error(
    halfcheetah: Any, tmp_path: Path, options: dict[str, Any]
) -> None:
    """It names the side and what was asked."""
    [[side, value]] = options.items()
    with pytest.raises(InvalidArgument, match=f"{side}.*{value}"):
        mjrec.Monitor(halfcheetah, tmp_path / "new", **options)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("mode", [None, "human"])
def test_environment_without_pictures_is_an_error_at_construction(
    make_corridor: Any, tmp_path: Path, mode: str | None
) -> None:
    """It names render_mode="rgb_array" and video_callable=False."""
    with pytest.raises(
        NoPictures, match=r'(?s)render_mode="rgb_array".*video_callable=False'
    ):
        mjrec.Monitor(make_corridor(render_mode=mode), tmp_path)


def test_not_an_environment_is_an_error(tmp_path: Path) -> None:
    """The type that was given is named."""
    with pytest.raises(InvalidArgument, match=r"builtins\.dict"):
        mjrec.Monitor({}, tmp_path)


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


def test_fps_plays_faster_and_keeps_every_frame(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """`fps` is the rate written into the file."""
    with mjrec.Monitor(corridor, tmp_path, fps=50) as env:
        play(env, 1)
    assert metadata_of(tmp_path, 0)["fps"] == "50"
    assert len(frames_in(tmp_path, 0)) == 4


def test_write_upon_reset_writes_at_each_reset(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """Statistics and manifest are there before the monitor closes."""
    env = mjrec.Monitor(corridor, tmp_path, False, write_upon_reset=True)
    play(env, 2)
    env.reset()
    assert stats_of(tmp_path)["episode_lengths"] == [3, 3]
    assert manifest_of(tmp_path)["stats"]
    env.close()


def test_without_write_upon_reset_nothing_is_visible_before_an_episode_ends(
    corridor: Any, tmp_path: Path
) -> None:
    """As in gym, no results of a run that only was reset."""
    env = mjrec.Monitor(corridor, tmp_path, False)
    env.reset()
    assert list(tmp_path.glob("*.json")) == []
    env.close()
    assert manifest_of(tmp_path)


# --- the state machine ----------------------------------------------------------


def test_step_before_reset_is_an_error(corridor: Any, tmp_path: Path) -> None:
    """The environment is not stepped."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        with pytest.raises(ResetNeeded, match="before the first reset"):
            env.step(0)
        assert corridor.position == 0


def test_step_after_the_end_is_an_error(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """A reset is needed, and then it goes on."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 1)
        with pytest.raises(ResetNeeded, match="after the end"):
            env.step(0)
        play(env, 1)
    assert stats_of(tmp_path)["episode_lengths"] == [3, 3]


def test_reset_in_mid_episode_is_an_error(corridor: Any, tmp_path: Path) -> None:
    """The environment is not reset, and the episode can go on."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        env.reset()
        env.step(0)
        with pytest.raises(ResetNotAllowed, match="allow_early_reset=True"):
            env.reset()
        assert corridor.position == 1
        env.step(0)
        env.step(0)
    assert stats_of(tmp_path)["episode_lengths"] == [3]
    assert len(frames_in(tmp_path, 0)) == 4


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


def test_after_close_calls_go_straight_to_the_environment(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """Nothing more is recorded, and nothing is checked."""
    env = mjrec.Monitor(corridor, tmp_path)
    play(env, 1)
    env.close()
    before = stats_of(tmp_path)
    env.step(0)
    env.reset()
    env.step(0)
    assert stats_of(tmp_path) == before


def test_gyms_questions_have_gyms_answers(
    corridor: Any, tmp_path: Path, play: Any
) -> None:
    """Total steps cover the unfinished episode; the lists only complete ones."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        assert env.episode_id == 0
        play(env, 2)
        env.reset()
        env.step(0)
        assert env.episode_id == 3
        assert env.get_total_steps() == 7
        assert env.get_episode_lengths() == [3, 3]
        assert env.get_episode_rewards() == [1.5, 1.5]
        assert isinstance(env.stats_recorder, mjrec.StatsRecorder)
        assert isinstance(env.video_recorder, mjrec.VideoRecorder)


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
        shown = [
            int((frame[0, :, 0] > 128).sum()) for frame in frames_in(tmp_path, episode)
        ]
        assert shown == [4, 8, 12, 16]


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


def test_close_in_mid_episode_keeps_the_video(corridor: Any, tmp_path: Path) -> None:
    """It is marked incomplete and listed; the statistics leave the episode out."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        env.reset()
        env.step(0)
    assert len(frames_in(tmp_path, 0)) == 2
    metadata = metadata_of(tmp_path, 0)
    assert (metadata["complete"], metadata["reason"]) == (False, "close")
    assert len(manifest_of(tmp_path)["videos"]) == 1
    assert stats_of(tmp_path)["episode_lengths"] == []


def test_closed_directory_holds_only_finished_files(
    corridor: Any, tmp_path: Path, play: Any, names: Callable[[Path], list[str]]
) -> None:
    """No lock and no temporary file stays."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 1)
    assert [name for name in names(tmp_path) if name.startswith(".")] == []


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


def test_leaving_right_after_a_reset_keeps_its_frame(tmp_path: Path) -> None:
    """The one frame waits for a rate, and gets into its video at exit."""
    script = LEAVING.format(
        tests=str(Path(__file__).parent), directory=str(tmp_path), how=""
    )
    script = script[: script.index("for _ in")]
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert len(frames_in(tmp_path, 0)) == 1
    assert "Traceback" not in done.stderr


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


def test_interrupted_close_can_be_called_again(
    corridor: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second call does what the first did not."""
    env = mjrec.Monitor(corridor, tmp_path)
    env.reset()
    finish = mjrec.VideoWriter.close

    def interrupted(writer: mjrec.VideoWriter) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(mjrec.VideoWriter, "close", interrupted)
    with pytest.raises(KeyboardInterrupt):
        env.close()
    monkeypatch.setattr(mjrec.VideoWriter, "close", finish)
    env.close()
    assert len(manifest_of(tmp_path)["videos"]) == 1
    assert len(frames_in(tmp_path, 0)) == 1


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


def test_resets_do_not_add_up(corridor: Any, tmp_path: Path) -> None:
    """A monitor has one exit hook, however many episodes there are."""
    with mjrec.Monitor(corridor, tmp_path, False, allow_early_reset=True) as env:
        before = atexit._ncallbacks()  # type: ignore[attr-defined]  # undocumented
        for _ in range(20):
            env.reset()
            env.step(0)
        after = atexit._ncallbacks()  # type: ignore[attr-defined]  # undocumented
    assert after == before


def test_last_picture_that_fails_leaves_a_complete_episode(
    make_corridor: Any, tmp_path: Path
) -> None:
    """The error goes through; journal and metadata agree that it was over."""

    class Blind(make_corridor):  # type: ignore[misc,valid-type]  # a fixture's class
        def render(self) -> Any:
            if self.position == self.length:
                raise RuntimeError("on purpose")
            return super().render()

    with mjrec.Monitor(Blind(), tmp_path) as env:
        env.reset()
        env.step(0)
        env.step(0)
        with pytest.raises(RuntimeError, match="on purpose"):
            env.step(0)
    assert metadata_of(tmp_path, 0)["complete"] is True
    assert journal_of(tmp_path)[0]["length"] == 3
    assert len(frames_in(tmp_path, 0)) == 3


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


def test_environment_without_spec_is_recorded_with_a_warning(
    corridor: Any, tmp_path: Path, play: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """And can be loaded again."""
    with caplog.at_level(logging.WARNING), mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 1)
    assert "no spec" in caplog.text
    results = mjrec.load_results(tmp_path)
    assert results is not None
    assert results["episode_lengths"] == [3]
    assert results["env_info"]["env_id"] == "(unknown:Corridor)"


def test_failing_step_leaves_the_statistics_alone(
    make_corridor: Any, tmp_path: Path
) -> None:
    """The environment's exception goes through unchanged."""

    class Failing(make_corridor):  # type: ignore[misc,valid-type]  # a fixture's class
        def step(self, action: Any) -> Any:
            raise RuntimeError("on purpose")

    with mjrec.Monitor(Failing(), tmp_path) as env:
        env.reset()
        with pytest.raises(RuntimeError, match="on purpose"):
            env.step(0)
        assert env.get_total_steps() == 0


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
    assert metadata_of(tmp_path, 0)["broken"]
    assert len(manifest_of(tmp_path)["mjrec"]["broken"]) == 1


# --- cameras and sizes ----------------------------------------------------------


def test_own_size_and_camera(halfcheetah: Any, tmp_path: Path) -> None:
    """Pictures of another size and camera, while env.render() stays as it was."""
    before = halfcheetah.unwrapped.model.vis.global_.offwidth
    with mjrec.Monitor(
        halfcheetah, tmp_path, camera="track", width=80, height=60
    ) as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())
        assert env.render().shape == (48, 64, 3)
    metadata = metadata_of(tmp_path, 0)
    assert (metadata["width"], metadata["height"]) == (80, 60)
    assert metadata["camera"] == "track"
    assert metadata["pictures"] == "scene"
    assert halfcheetah.unwrapped.model.vis.global_.offwidth == before
    assert frames_in(tmp_path, 0)[0].std() > 10


def test_frame_larger_than_the_offscreen_buffer(
    halfcheetah: Any, tmp_path: Path
) -> None:
    """The buffer is grown on the renderer's copy of the model."""
    model = halfcheetah.unwrapped.model
    buffer = (model.vis.global_.offheight, model.vis.global_.offwidth)
    wide = buffer[1] + 64
    with mjrec.Monitor(halfcheetah, tmp_path, width=wide, height=48) as env:
        env.reset(seed=0)
    assert frames_in(tmp_path, 0)[0].shape == (48, wide, 3)
    assert (model.vis.global_.offheight, model.vis.global_.offwidth) == buffer


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


def test_unknown_camera_lists_the_names(halfcheetah: Any, tmp_path: Path) -> None:
    """At construction, and nothing is left."""
    with pytest.raises(mjrec.UnknownName, match="track"):
        mjrec.Monitor(halfcheetah, tmp_path / "new", camera="side")
    assert not (tmp_path / "new").exists()


# --- several environments in one process ------------------------------------------


def make_halfcheetah(**options: Any) -> Any:
    return gymnasium.make(
        "HalfCheetah-v5", render_mode="rgb_array", width=64, height=48, **options
    )


def make_ant() -> Any:
    return gymnasium.make("Ant-v5", render_mode="rgb_array", width=64, height=48)


def first_hashes(directory: Path) -> list[str]:
    """Return the hash of each frame of episode 0, as it was rendered."""
    [path] = directory.glob("*.video000000.framehash")
    lines = [line for line in path.read_text().splitlines() if line[0] != "#"]
    return [line.split()[-1] for line in lines]


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
        assert first_hashes(tmp_path / f"{name}2") == first_hashes(tmp_path / name)


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


def test_missed_picture_is_not_counted_as_a_step(
    make_corridor: Any, tmp_path: Path
) -> None:
    """The metadata says of which steps the frames are."""

    class Blinking(make_corridor):  # type: ignore[misc,valid-type]  # a fixture's class
        def render(self) -> Any:
            if self.position == 2:
                raise RuntimeError("on purpose")
            return super().render()

    with mjrec.Monitor(Blinking(length=5), tmp_path) as env:
        env.reset()
        for step in range(1, 6):
            if step == 2:
                with pytest.raises(RuntimeError):
                    env.step(0)
            else:
                env.step(0)
    assert metadata_of(tmp_path, 0)["frame_steps"] == [[0, 1], [3, 5]]


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


def test_failed_encoder_leaves_no_claim_of_frames(
    make_corridor: Any, tmp_path: Path, kill_ffmpeg: Callable[[], int]
) -> None:
    """The metadata says why there is no video."""
    env = mjrec.Monitor(make_corridor(length=9), tmp_path)
    env.reset()
    env.step(0)
    kill_ffmpeg()
    with pytest.raises(mjrec.EncoderError):
        env.close()
    metadata = metadata_of(tmp_path, 0)
    assert metadata["broken"]
    assert metadata["empty"]
    assert "-9" in metadata["broken_reason"]
    assert "frame_count" not in metadata


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
