# SPDX-License-Identifier: Apache-2.0
"""Test clips, which are videos counted in steps, both live and deferred."""

import copy
import json
import signal
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from compiled_tasks import growing
from full_disk import file_size_limit
from other_python import run_python
from parts import parametrize
from recordings import add_facts, frames_of, hashes_at, in_flight, manifest_of

import mjrec
from conftest import Corridor
from mjrec.commands import main
from mjrec.rendering.finish import finish
from mjrec.rendering.jobs import key_of
from mjrec.rendering.recordings import recordings


class Blinking(gymnasium.Wrapper):
    """A wrapper that changes the color after every step and reset."""

    def reset(self, **options):
        self._blink(0.5)
        return self.env.reset(**options)

    def step(self, action):
        self._blink(0.1)
        return self.env.step(action)

    def _blink(self, more):
        color = self.env.unwrapped.model.geom_rgba
        color[:, 0] = (color[:, 0] + more) % 1


def hopper(length=5, **options):
    # Narrower frames have no room for a caption.
    options |= {"max_episode_steps": length, "width": 256, "height": 48}
    return Blinking(gymnasium.make("Hopper-v5", **options))


def reacher():
    """Return a task that moves the target within its model at each reset."""
    from dm_control import suite

    return suite.load("reacher", "easy", {"random": 3, "time_limit": 0.08})


def hop(env, steps):
    done = True
    for number in range(steps):
        if done:
            env.reset(seed=number)
        *_, terminated, truncated, _ = env.step(np.full(3, 0.1 * (number % 7)))
        done = terminated or truncated


def reach(env, steps):
    """Reset only once, because dm_control's `step` resets after a last step."""
    env.reset()
    for number in range(steps):
        env.step(np.full(2, 0.1 * (number % 7)))


# This clip starts at the second step.
CLIP = {"step_trigger": lambda step: step == 1, "workers": 0}
CLIPS = {"step_trigger": lambda step: step in (2, 20), "video_length": 13}


def record(directory, env, steps, **options):
    ride = hop if isinstance(env, gymnasium.Env) else reach
    with mjrec.Monitor(env, directory, **{"workers": 1, **options}) as monitor:
        ride(monitor, steps)


def hashes(directory):
    """Return the frame hashes of each video by name suffix."""
    return {
        path.name.partition(".video")[2].split(".video")[-1]: hashes_at(path)
        for path in sorted(directory.glob("*.framehash"))
    }


def metadata_in(directory):
    paths = sorted(directory.glob("openaigym.*.meta.json"))
    return [json.loads(path.read_text()) for path in paths]


VIEW = {"height": 48, "width": 256, "env_id": "dm_control/some-task"}
EVERY = {"video_callable": lambda _: True}


# Takes more than five seconds: each run is recorded live and deferred.
@parametrize(
    ("make", "steps", "options"),
    [
        (hopper, 36, {**CLIPS, "annotate": True, "max_fps": 50}),
        *(
            pytest.param(make, 14, {**VIEW, **options}, marks=pytest.mark.dm_control)
            for make, options in (
                (growing, {**CLIP, "video_length": 9, "annotate": True}),
                (growing, EVERY),
                (reacher, {**CLIP, "video_length": 9}),
            )
        ),
        (hopper, 36, CLIPS),
    ],
    default=2,
)
def test_deferred_frames_equal_live_frames(make, steps, options, tmp_path):
    """Frames are equal even after resets that change or recompile the model."""
    metadata = []
    for render in ("live", "deferred"):
        env = make(render_mode="rgb_array") if make is hopper else make()
        options = {**options, "workers": 1, "render": render}
        record(tmp_path / render, env, steps, **options)
        metadata.append(metadata_in(tmp_path / render))
    assert hashes(tmp_path / "live")
    assert hashes(tmp_path / "live") == hashes(tmp_path / "deferred")
    assert not in_flight(tmp_path / "deferred")
    same = "episode_id first_step last_episode_id length reward complete reason"
    same += " fps timestep stride frame_count frame_steps seed type height width camera"
    for live, deferred in zip(*metadata, strict=True):
        assert (live["recording"], deferred["recording"]) == ("live", "deferred")
        for key in same.split():
            assert live.get(key) == deferred.get(key), key


@parametrize(
    ("options", "part", "frames", "fps"),
    [
        # The nine frames are the first one, six steps and two resets.
        ({"camera": ["track", -1]}, "step", 9, "125"),
        # `max_fps` drops frames, whereas `fps` sets the frame rate of the file.
        ({"fps": 12, "max_fps": 62.5}, "step", 5, "12"),
        # A video that starts with an episode has the episode's number.
        ({"step_trigger": None, "video_callable": (1).__eq__}, "episode", 7, "125"),
    ],
    default=2,
)
def test_deferred_clips_wait_until_rendered(options, part, frames, fps, tmp_path):
    steps = {**CLIP, "video_length": 6, "name_prefix": "rl-video"}
    record(tmp_path, hopper(3), 8, **{**steps, **options})
    [entry] = manifest_of(tmp_path)["mjrec"]["pending"]
    parts = [path.name[-6:] for path in in_flight(tmp_path)]
    assert parts == [f"{number:06d}" for number in range(len(parts))]
    assert recordings(tmp_path) == [key_of(entry["clip"])]
    assert main(["render", str(tmp_path)]) == 0
    assert not in_flight(tmp_path)
    manifest = manifest_of(tmp_path)
    assert not manifest["mjrec"]["pending"]
    listed = [name for name, _ in manifest["videos"]]
    assert entry["video"] in listed
    assert len(listed) == len(options.get("camera", [0]))
    video = tmp_path / entry["video"]
    assert (tmp_path / f"rl-video-{part}-1.mp4").samefile(video)
    metadata = json.loads(video.with_suffix(".meta.json").read_text())
    assert (metadata["frame_count"], metadata["fps"]) == (frames, fps)
    assert not list(finish(tmp_path, workers=1))


# Takes more than five seconds: it kills a process and renders its clips.
def test_clip_of_a_killed_process_is_rendered_whole(tmp_path):
    script = (
        "import os, sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import mjrec\n"
        "from test_clips import hop, hopper\n"
        f"env = mjrec.Monitor(hopper(), {str(tmp_path)!r}, video_length=99,\n"
        "    step_trigger=lambda step: step == 2, workers=0)\n"
        "hop(env, 13)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    run_python(script, status=-signal.SIGKILL)
    assert mjrec.recover(tmp_path)
    details = manifest_of(tmp_path)["mjrec"]
    [entry] = details["pending"]
    # The next run must not reuse the number of the clip's last episode.
    assert (entry["episode_id"], details["next_episode_id"]) == (0, 3)
    assert main(["render", str(tmp_path)]) == 0
    [about] = metadata_in(tmp_path)
    assert (about["complete"], about["reason"]) == (False, "killed")
    # The clip has three steps of the first episode, five of the second and three of the
    # third, and the first frame of each.
    assert (about["frame_count"], about["length"]) == (14, 11)
    assert about["last_episode_id"] == 2
    assert [name for name, _ in manifest_of(tmp_path)["videos"]] == [entry["video"]]
    assert not mjrec.recover(tmp_path)


@pytest.mark.thorough
def test_clip_ends_early_where_the_model_is_replaced(tmp_path, caplog):
    """The clip keeps its earlier frames, and a new clip can follow."""
    env = hopper()
    options = {**CLIP, "workers": 1, "video_length": 4, "mode": "evaluation"}
    with mjrec.Monitor(env, tmp_path, **options) as monitor:
        hop(monitor, 3)
        env.unwrapped.model = copy.copy(env.unwrapped.model)
        monitor.step(np.zeros(3))
        monitor.step(np.zeros(3))
    assert "end early" in caplog.text
    [about] = [each for each in metadata_in(tmp_path) if "first_step" in each]
    assert "another model" in about["broken_reason"]
    assert (about["frame_count"], about["length"]) == (3, 4)
    details = manifest_of(tmp_path)["mjrec"]
    assert (len(details["broken"]), details["pending"]) == (1, [])


def test_full_disk_ends_a_clip_and_not_the_simulation(tmp_path):
    """Frames recorded before the disk was full are still rendered."""
    options = {**CLIP, "video_length": 9, "on_error": "warn"}
    with mjrec.Monitor(hopper(), tmp_path, **options) as monitor:
        hop(monitor, 5)
        with file_size_limit(1000):
            hop(monitor, 5)
        hop(monitor, 3)
    assert monitor.get_total_steps() == 13
    details = manifest_of(tmp_path)["mjrec"]
    assert "video" in {fault["what"] for fault in details["faults"]}
    [outcome] = finish(tmp_path, workers=1)
    assert outcome.videos == {details["pending"][0]["video"]: 5}
    [about] = metadata_in(tmp_path)
    assert "Cannot write" in about["broken_reason"]


@pytest.mark.parametrize(
    "name",
    [
        *("", "../there.mp4", "openaigym.video.9.9.video000000.mp4"),
        "openaigym.video.{infix}.video000000.step000002.mp4",
    ],
)
def test_hostile_clip_names_overwrite_nothing(name, tmp_path):
    record(tmp_path, hopper(), 3, **CLIP)
    [key] = recordings(tmp_path)
    [log] = in_flight(tmp_path)
    named = name.format(infix=key.infix)
    add_facts(log, {"video": {"recording": "deferred", "name": named}})
    before = set(tmp_path.iterdir())
    [outcome] = finish(tmp_path, workers=1)
    assert "does not belong to its episode" in str(outcome.failures)
    [new] = set(tmp_path.iterdir()) - before
    assert new.match("openaigym.clip.*.failed.json")


class Counting(Corridor):
    """An environment whose frames show its step count as brightness."""

    taken = 0

    def step(self, action):
        self.taken += 1
        return super().step(action)

    def render(self):
        return np.full((32, 32, 3), 5 * self.taken, np.uint8)


def begins(*at, **options):
    return {"step_trigger": lambda step: step in at, **options}


@pytest.mark.parametrize(
    ("length", "steps", "options", "shown"),
    [
        # A clip starts with the frame before its first step.
        (
            *(100, 20, begins(0, 7, video_length=4)),
            {"0.step000000": [0, 1, 2, 3, 4], "0.step000007": [7, 8, 9, 10, 11]},
        ),
        # No clip starts during another one.
        (
            *(100, 8, begins(*range(0, 9, 2), video_length=3)),
            {"0.step000000": [0, 1, 2, 3], "0.step000004": [4, 5, 6, 7]},
        ),
        # The clip continues across resets, which follow steps 3 and 6.
        (3, 12, begins(2, video_length=5), {"0.step000002": [2, 3, 3, 4, 5, 6, 6, 7]}),
        # Closing the monitor ends the clip early.
        (9, 4, begins(1, video_length=50), {"0.step000001": [1, 2, 3, 4]}),
        # A clip without a length ends with its episode.
        (5, 15, begins(3), {"0.step000003": [3, 4, 5]}),
        # With a schedule, the video starts with an episode and ends after its steps.
        (
            *(3, 15),
            {"video_callable": (0, 3).__contains__, "video_length": 4},
            {"0": [0, 1, 2, 3, 3, 4], "3": [9, 10, 11, 12, 12, 13]},
        ),
    ],
)
def test_clip_has_its_first_frame_and_n_steps(length, steps, options, shown, tmp_path):
    """A reset adds a frame but does not count as a step."""
    env = Counting(length)
    with mjrec.Monitor(env, tmp_path, allow_early_reset=True, **options) as monitor:
        done = True
        for _ in range(steps):
            if done:
                monitor.reset()
            _, _, done, _, _ = monitor.step(0)
    paths = sorted(tmp_path.glob("*.mp4"))
    for path, (name, counts) in zip(paths, shown.items(), strict=True):
        assert path.name.endswith(f".video00000{name}.mp4")
        assert [round(frame.mean() / 5) for frame in frames_of(path)] == counts
    listed = [video for video, _ in mjrec.load_results(tmp_path)["videos"]]
    assert [*map(Path, listed)] == paths
