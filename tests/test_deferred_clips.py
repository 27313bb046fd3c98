# SPDX-License-Identifier: Apache-2.0
"""Videos counted in steps that are rendered later, from recorded states."""

from __future__ import annotations

import copy
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from full_disk import file_size_limit
from parts import parametrize
from recordings import in_flight, manifest_of

import mjrec
from mjrec.commands import main
from mjrec.formats.in_flight import add_facts, drop_recording
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.rendering import finish as module
from mjrec.rendering.recordings import key_of, look_at, recordings


class Blinking(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Shows another colour after every step and every reset."""

    def reset(self, **options: Any) -> Any:
        self._blink(0.5)
        return self.env.reset(**options)

    def step(self, action: Any) -> Any:
        self._blink(0.1)
        return self.env.step(action)

    def _blink(self, more: float) -> None:
        colour: Any = self.env.unwrapped.model.geom_rgba  # type: ignore[attr-defined]  # MuJoCo's
        colour[:, 0] = (colour[:, 0] + more) % 1


def hopper(length: int = 5, **made: Any) -> gymnasium.Env[Any, Any]:
    """Return a hopper whose episodes are short, and small pictures of it."""
    # So wide that a caption has room.
    size = {"width": 256, "height": 48}
    return Blinking(
        gymnasium.make("Hopper-v5", max_episode_steps=length, **size, **made)
    )


def reacher() -> Any:
    """Return a task whose resets put another target into the model."""
    from dm_control import suite

    return suite.load("reacher", "easy", {"random": 3, "time_limit": 0.08})


def hop(env: Any, steps: int) -> None:
    """Take so many steps, with resets where they are needed."""
    done = True
    for number in range(steps):
        if done:
            env.reset(seed=number)
        *_, terminated, truncated, _ = env.step(np.full(3, 0.1 * (number % 7)))
        done = terminated or truncated


def reach(env: Any, steps: int) -> None:
    """Take so many steps; a step after the last one of an episode is a reset."""
    timestep = env.reset()
    for number in range(steps):
        if timestep.last():
            env.reset()
        timestep = env.step(np.full(2, 0.1 * (number % 7)))


def record(directory: Path, env: Any, steps: int, **options: Any) -> None:
    """Record so many steps of an environment, and all videos of them."""
    ride = hop if isinstance(env, gymnasium.Env) else reach
    with mjrec.Monitor(env, directory, **{"workers": 1, **options}) as monitor:
        ride(monitor, steps)


def finish(directory: Path) -> list[Any]:
    """Render what is pending."""
    return list(module.finish(directory, recordings(directory), workers=1))


def parts(directory: Path) -> list[str]:
    """Return the names of all logs of clips, without their beginnings."""
    return [path.name.partition(".step")[2] for path in in_flight(directory)]


def hashes(directory: Path) -> dict[str, list[str]]:
    """Return the hashes of the pictures of each video, by the end of its name."""
    return {
        path.name.partition(".video")[2].split(".video")[-1]: [
            line.split(",")[-1].strip()
            for line in path.read_text().splitlines()
            if not line.startswith("#")
        ]
        for path in sorted(directory.glob("*.framehash"))
    }


def told(directory: Path) -> Iterator[dict[str, Any]]:
    """Yield the metadata of each video."""
    for path in sorted(directory.glob("openaigym.*.meta.json")):
        yield json.loads(path.read_text())


SAME = (
    *("episode_id", "first_step", "last_episode_id", "length", "reward", "complete"),
    *("fps", "timestep", "stride", "frame_count", "frame_steps", "seed", "type"),
    *("reason", "height", "width", "camera"),
)


def check_same(live: Path, deferred: Path) -> None:
    """Check that both show the same, and say the same of it."""
    assert hashes(live)
    assert hashes(live) == hashes(deferred)
    for one, other in zip(told(live), told(deferred), strict=True):
        assert (one["recording"], other["recording"]) == ("live", "deferred")
        assert {key: one.get(key) for key in SAME} == {
            key: other.get(key) for key in SAME
        }


# Takes more than five seconds: the same run live and deferred.
@parametrize("options", [{"annotate": True, "max_fps": 50}, {}])
def test_pictures_are_those_that_were_drawn_live(
    options: dict[str, Any], tmp_path: Path
) -> None:
    """Byte for byte, across resets and from the midst of an episode."""
    clips: dict[str, Any] = {
        "step_trigger": lambda step: step in (2, 20),
        "video_length": 13,
    }
    for render in ("live", "deferred"):
        env = hopper(render_mode="rgb_array")
        record(tmp_path / render, env, 36, render=render, **clips, **options)
    check_same(tmp_path / "live", tmp_path / "deferred")
    assert not parts(tmp_path / "deferred")


@pytest.mark.dm_control
@parametrize("annotate", [False, True])
def test_resets_that_change_the_model_are_seen(annotate: bool, tmp_path: Path) -> None:
    """Of a task whose target lies elsewhere in each episode."""
    options: dict[str, Any] = {
        "step_trigger": lambda step: step == 1,
        "video_length": 9,
        "height": 48,
        "width": 256,
        "annotate": annotate,
        "env_id": "dm_control/reacher-easy",
    }
    for render in ("live", "deferred"):
        record(tmp_path / render, reacher(), 14, render=render, **options)
    check_same(tmp_path / "live", tmp_path / "deferred")


@pytest.mark.thorough
def test_trajectories_and_clips_run_beside_each_other(tmp_path: Path) -> None:
    """Each sees all that changes in the model, whoever looks first."""
    clips: dict[str, Any] = {
        "step_trigger": lambda step: step in (2, 9),
        "video_length": 6,
    }
    live = hopper(render_mode="rgb_array")
    evaluation: dict[str, Any] = {"mode": "evaluation"}
    record(tmp_path / "live", live, 14, render="live", **clips, **evaluation)
    record(tmp_path / "both", hopper(), 14, **clips, **evaluation)
    record(tmp_path / "plain", hopper(), 14, video_callable=False, **evaluation)
    check_same(tmp_path / "live", tmp_path / "both")
    recorded = sorted((tmp_path / "both").glob("*.h5"))
    plain = sorted((tmp_path / "plain").glob("*.h5"))
    assert len(recorded) == len(plain) == 3
    for one, other in zip(recorded, plain, strict=True):
        with open_trajectory(one) as first, open_trajectory(other) as second:
            assert first.states(0, 4).tobytes() == second.states(0, 4).tobytes()
            assert len(first.model_changes) == len(second.model_changes) > 0


@pytest.mark.thorough
def test_clips_wait_for_who_renders_them(tmp_path: Path) -> None:
    """Pending, with a log for each episode; afterwards there is the video alone."""
    record(
        tmp_path,
        hopper(3),
        8,
        step_trigger=lambda step: step == 1,
        video_length=6,
        workers=0,
        name_prefix="rl-video",
        camera=["track", -1],
    )
    [entry] = manifest_of(tmp_path)["mjrec"]["pending"]
    assert parts(tmp_path) == [f"000000001.part{n:06d}" for n in range(3)]
    assert main(["render", str(tmp_path)]) == 0
    assert not parts(tmp_path)
    manifest = manifest_of(tmp_path)
    assert not manifest["mjrec"]["pending"]
    further = entry["video"].replace(".mp4", ".-1.mp4")
    assert {name for name, _ in manifest["videos"]} == {entry["video"], further}
    assert (tmp_path / "rl-video-step-1.mp4").samefile(tmp_path / entry["video"])
    [about] = [each for each in told(tmp_path) if "further_videos" in each]
    # Two steps, a reset and three steps, a reset and a step, and what was there first.
    assert about["frame_count"] == 9
    assert not finish(tmp_path)


@pytest.mark.thorough
def test_clip_that_begins_with_an_episode_has_its_name(tmp_path: Path) -> None:
    """`video_length` with a schedule; so do Gymnasium's names."""
    record(
        tmp_path,
        hopper(3),
        7,
        video_callable=lambda episode: episode == 1,
        video_length=4,
        workers=0,
        name_prefix="rl-video",
    )
    [entry] = manifest_of(tmp_path)["mjrec"]["pending"]
    assert entry["episode_id"] == 1
    assert entry["video"].endswith(".video000001.mp4")
    [outcome] = finish(tmp_path)
    assert (outcome.name, outcome.frame_count) == (entry["video"], 6)
    assert (tmp_path / "rl-video-episode-1.mp4").exists()


def test_running_clip_is_its_monitors_business(tmp_path: Path) -> None:
    """Nobody renders one that may go on, be it between two episodes."""
    monitor = mjrec.Monitor(
        hopper(), tmp_path, step_trigger=lambda step: step == 2, workers=0
    )
    with monitor:
        hop(monitor, 4)
        [key] = recordings(tmp_path)
        assert look_at(tmp_path, key) is None
    assert look_at(tmp_path, key) is not None


# Takes more than five seconds: a process is killed, and its clips are drawn.
def test_killed_process_leaves_a_clip_that_can_be_rendered(tmp_path: Path) -> None:
    """With all that was there; and it is in the manifest then."""
    script = (
        "import os, signal, sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import mjrec\n"
        "from test_deferred_clips import hop, hopper\n"
        f"env = mjrec.Monitor(hopper(), {str(tmp_path)!r}, video_length=99,\n"
        "    step_trigger=lambda step: step == 2, workers=0)\n"
        "hop(env, 13)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], check=False, capture_output=True, text=True
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert mjrec.recover(tmp_path)
    manifest = manifest_of(tmp_path)["mjrec"]
    [entry] = manifest["pending"]
    assert (entry["episode_id"], manifest["next_episode_id"]) == (0, 3)
    assert main(["render", str(tmp_path)]) == 0
    [about] = told(tmp_path)
    assert (about["complete"], about["reason"]) == (False, "killed")
    # Three steps of the first episode, five of the second and three of the third, each
    # with the picture that it began with here.
    assert (about["frame_count"], about["length"]) == (14, 11)
    assert about["last_episode_id"] == 2
    assert [name for name, _ in manifest_of(tmp_path)["videos"]] == [entry["video"]]
    assert not mjrec.recover(tmp_path)


@pytest.mark.thorough
def test_clip_ends_where_its_pictures_would_lie(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """What was taken before stays, and the next clip is another one."""
    env = hopper()
    with mjrec.Monitor(
        env,
        tmp_path,
        step_trigger=lambda step: step == 1,
        video_length=4,
        mode="evaluation",
    ) as monitor:
        hop(monitor, 3)
        simulated: Any = env.unwrapped
        simulated.model = copy.copy(simulated.model)
        monitor.step(np.zeros(3))
        monitor.step(np.zeros(3))
    assert "ends early" in caplog.text
    [about] = [each for each in told(tmp_path) if "first_step" in each]
    assert about["broken"]
    assert "another model" in about["broken_reason"]
    assert (about["frame_count"], about["length"]) == (3, 4)
    manifest = manifest_of(tmp_path)
    assert len(manifest["mjrec"]["broken"]) == 1
    assert not manifest["mjrec"]["pending"]


def test_full_disk_ends_a_clip_and_not_the_simulation(tmp_path: Path) -> None:
    """With `on_error="warn"`: what had room is rendered, and the manifest tells."""
    monitor = mjrec.Monitor(
        hopper(),
        tmp_path,
        step_trigger=lambda step: step == 2,
        video_length=9,
        on_error="warn",
        workers=0,
    )
    hop(monitor, 5)
    with file_size_limit(1000):
        hop(monitor, 5)
    hop(monitor, 3)
    monitor.close()
    assert monitor.get_total_steps() == 13
    [entry] = manifest_of(tmp_path)["mjrec"]["pending"]
    faults = manifest_of(tmp_path)["mjrec"]["faults"]
    assert "video" in {fault["what"] for fault in faults}
    [outcome] = finish(tmp_path)
    assert (outcome.name, outcome.failure) == (entry["video"], None)
    assert outcome.frame_count == 4
    [about] = told(tmp_path)
    assert "states" in about["broken_reason"]


def test_a_part_that_is_missing_is_told(tmp_path: Path) -> None:
    """What is there stays, and so does the entry in the manifest, with the reason."""
    record(
        tmp_path,
        hopper(3),
        8,
        step_trigger=lambda step: step == 1,
        video_length=6,
        workers=0,
    )
    [second] = [p for p in in_flight(tmp_path) if p.name.endswith("part000001")]
    drop_recording(second)
    [outcome] = finish(tmp_path)
    assert "part 1" in str(outcome.failure)
    assert len(parts(tmp_path)) == 2
    [entry] = manifest_of(tmp_path)["mjrec"]["pending"]
    assert "part 1" in entry["reason"]


def test_clips_belong_to_their_monitor(tmp_path: Path) -> None:
    """`force` removes their logs, and a resumed run has other ones."""
    options: dict[str, Any] = {
        "step_trigger": lambda step: step == 1,
        "video_length": 3,
        "workers": 0,
    }
    for number in range(2):
        record(tmp_path, hopper(), 5, resume=number > 0, **options)
    assert len({key.infix for key in recordings(tmp_path)}) == 2
    record(tmp_path, hopper(), 5, force=True, **options)
    assert len(recordings(tmp_path)) == 1


@pytest.mark.parametrize(
    "name",
    [
        "../there.mp4",
        "openaigym.video.9.9.video000000.mp4",
        "openaigym.video.{infix}.video000000.step000002.mp4",
        None,
    ],
)
def test_no_other_video_is_written_over(name: str | None, tmp_path: Path) -> None:
    """Logs may be anybody's: the name of a video has to be that of its own clip."""
    record(tmp_path, hopper(), 3, step_trigger=lambda step: step == 1, workers=0)
    [key] = recordings(tmp_path)
    [log] = in_flight(tmp_path)
    named = None if name is None else name.format(infix=key.infix)
    add_facts(log, {"video": {"recording": "deferred", "name": named or ""}})
    before = sorted(tmp_path.iterdir())
    [outcome] = finish(tmp_path)
    assert "not that of its own" in str(outcome.failure)
    said = [*tmp_path.glob("openaigym.clip.*.failed.json")]
    assert len(said) == 1
    assert sorted(tmp_path.iterdir()) == sorted(before + said)


def test_a_video_is_found_by_its_own_name(tmp_path: Path) -> None:
    """Whoever has read the manifest knows no other."""
    record(tmp_path, hopper(), 3, step_trigger=lambda step: step == 1, workers=0)
    [entry] = manifest_of(tmp_path)["mjrec"]["pending"]
    assert [key_of(entry["video"])] == recordings(tmp_path) == [key_of(entry["clip"])]


def test_a_clip_is_written_at_the_rate_that_was_asked_for(tmp_path: Path) -> None:
    """`fps` is that of the file, whichever frames `max_fps` leaves."""
    record(
        *(tmp_path, hopper(), 9),
        step_trigger=lambda step: step == 1,
        video_length=6,
        workers=0,
        fps=12,
        max_fps=62.5,
    )
    assert not finish(tmp_path)[0].failure
    [about] = told(tmp_path)
    assert (about["frame_count"], about["fps"]) == (5, "12")
