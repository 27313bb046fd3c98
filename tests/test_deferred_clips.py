# SPDX-License-Identifier: Apache-2.0
"""Videos counted in steps that are rendered later, from recorded states."""

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
from recordings import add_facts, hashes_at, in_flight, manifest_of

import mjrec
from mjrec.commands import main
from mjrec.rendering import finish as module
from mjrec.rendering.jobs import key_of
from mjrec.rendering.recordings import recordings


class Blinking(gymnasium.Wrapper):
    """Shows another colour after every step and every reset."""

    def reset(self, **options):
        self._blink(0.5)
        return self.env.reset(**options)

    def step(self, action):
        self._blink(0.1)
        return self.env.step(action)

    def _blink(self, more):
        colour = self.env.unwrapped.model.geom_rgba
        colour[:, 0] = (colour[:, 0] + more) % 1


def hopper(length=5, **made):
    """Return a hopper whose episodes are short, and small frames of it."""
    # So wide that a caption has room.
    size = {"width": 256, "height": 48}
    return Blinking(
        gymnasium.make("Hopper-v5", max_episode_steps=length, **size, **made)
    )


def reacher():
    """Return a task whose resets put another target into the model."""
    from dm_control import suite

    return suite.load("reacher", "easy", {"random": 3, "time_limit": 0.08})


def hop(env, steps):
    """Take so many steps, with resets where they are needed."""
    done = True
    for number in range(steps):
        if done:
            env.reset(seed=number)
        *_, terminated, truncated, _ = env.step(np.full(3, 0.1 * (number % 7)))
        done = terminated or truncated


def reach(env, steps):
    """Take so many steps; a step after the last one of an episode is a reset."""
    timestep = env.reset()
    for number in range(steps):
        if timestep.last():
            env.reset()
        timestep = env.step(np.full(2, 0.1 * (number % 7)))


def record(directory, env, steps, **options):
    """Record so many steps of an environment, and all videos of them."""
    ride = hop if isinstance(env, gymnasium.Env) else reach
    with mjrec.Monitor(env, directory, **{"workers": 1, **options}) as monitor:
        ride(monitor, steps)


def finish(directory):
    """Render what is pending."""
    return list(module.finish(directory, workers=1))


def parts(directory):
    """Return the names of all logs of clips, without their beginnings."""
    return [path.name.partition(".step")[2] for path in in_flight(directory)]


def hashes(directory):
    """Return the hashes of the frames of each video, by the end of its name."""
    return {
        path.name.partition(".video")[2].split(".video")[-1]: hashes_at(path)
        for path in sorted(directory.glob("*.framehash"))
    }


def metadata_in(directory):
    """Return the metadata of each video."""
    paths = sorted(directory.glob("openaigym.*.meta.json"))
    return [json.loads(path.read_text()) for path in paths]


def metadata_of(directory, video):
    content = (directory / video).with_suffix(".meta.json").read_text()
    return dict(json.loads(content))


# One that begins with the second step.
CLIP = {"step_trigger": lambda step: step == 1, "workers": 0}
SAME = (
    *("episode_id", "first_step", "last_episode_id", "length", "reward", "complete"),
    *("fps", "timestep", "stride", "frame_count", "frame_steps", "seed", "type"),
    *("reason", "height", "width", "camera"),
)


def check_same(live, deferred):
    """Check that both show the same, and say the same of it."""
    assert hashes(live)
    assert hashes(live) == hashes(deferred)
    for one, other in zip(metadata_in(live), metadata_in(deferred), strict=True):
        assert (one["recording"], other["recording"]) == ("live", "deferred")
        assert {key: one.get(key) for key in SAME} == {
            key: other.get(key) for key in SAME
        }


# Takes more than five seconds: the same run live and deferred.
@parametrize("options", [{"annotate": True, "max_fps": 50}, {}])
def test_frames_are_those_that_were_drawn_live(options, tmp_path):
    """Byte for byte, across resets and from the midst of an episode."""
    clips = {"step_trigger": lambda step: step in (2, 20), "video_length": 13}
    for render in ("live", "deferred"):
        env = hopper(render_mode="rgb_array")
        record(tmp_path / render, env, 36, render=render, **clips, **options)
    check_same(tmp_path / "live", tmp_path / "deferred")
    assert not parts(tmp_path / "deferred")


# Takes more than five seconds: the same run live and deferred.
@pytest.mark.dm_control
@parametrize(
    ("make", "annotate"),
    [(reacher, False), (growing, False), (reacher, True), (growing, True)],
)
def test_resets_that_change_or_compile_the_model_are_seen(make, annotate, tmp_path):
    """A target lies elsewhere in each episode, or the model is another one."""
    options = {
        **CLIP,
        "workers": 1,
        "video_length": 9,
        "height": 48,
        "width": 256,
        "annotate": annotate,
        "env_id": "dm_control/some-task",
    }
    for render in ("live", "deferred"):
        record(tmp_path / render, make(), 14, render=render, **options)
    check_same(tmp_path / "live", tmp_path / "deferred")


@parametrize(
    ("options", "part", "frames"),
    [
        # Two steps, a reset and three steps, a reset and a step, and the first frame.
        ({"camera": ["track", -1]}, "step", 9),
        # One that begins with an episode has its name.
        ({"step_trigger": None, "video_callable": lambda e: e == 1}, "episode", 7),
    ],
)
def test_clips_wait_to_be_rendered(options, part, frames, tmp_path):
    """Pending, with a log for each episode; afterwards there is the video alone."""
    steps = {**CLIP, "video_length": 6, "name_prefix": "rl-video"}
    record(tmp_path, hopper(3), 8, **{**steps, **options})
    [entry] = manifest_of(tmp_path)["mjrec"]["pending"]
    assert [name[-6:] for name in parts(tmp_path)] == [
        f"{n:06d}" for n in range(len(parts(tmp_path)))
    ]
    assert recordings(tmp_path) == [key_of(entry["clip"])]
    assert main(["render", str(tmp_path)]) == 0
    assert not parts(tmp_path)
    manifest = manifest_of(tmp_path)
    assert not manifest["mjrec"]["pending"]
    listed = [name for name, _ in manifest["videos"]]
    assert entry["video"] in listed
    assert len(listed) == len(options.get("camera", [0]))
    assert (tmp_path / f"rl-video-{part}-1.mp4").samefile(tmp_path / entry["video"])
    assert metadata_of(tmp_path, entry["video"])["frame_count"] == frames
    assert not finish(tmp_path)


# Takes more than five seconds: a process is killed, and its clips are drawn.
def test_a_killed_process_leaves_a_clip_that_can_be_rendered(tmp_path):
    """With all that was there; and it is in the manifest then."""
    script = (
        "import os, sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import mjrec\n"
        "from test_deferred_clips import hop, hopper\n"
        f"env = mjrec.Monitor(hopper(), {str(tmp_path)!r}, video_length=99,\n"
        "    step_trigger=lambda step: step == 2, workers=0)\n"
        "hop(env, 13)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    run_python(script, status=-signal.SIGKILL)
    assert mjrec.recover(tmp_path)
    details = manifest_of(tmp_path)["mjrec"]
    [entry] = details["pending"]
    # The next run does not use the number of the clip's last episode again.
    assert (entry["episode_id"], details["next_episode_id"]) == (0, 3)
    assert main(["render", str(tmp_path)]) == 0
    [about] = metadata_in(tmp_path)
    assert (about["complete"], about["reason"]) == (False, "killed")
    # Three steps of the first episode, five of the second and three of the third, each
    # with the frame that it began with here.
    assert (about["frame_count"], about["length"]) == (14, 11)
    assert about["last_episode_id"] == 2
    assert [name for name, _ in manifest_of(tmp_path)["videos"]] == [entry["video"]]
    assert not mjrec.recover(tmp_path)


@pytest.mark.thorough
def test_a_clip_ends_where_its_frames_would_lie(tmp_path, caplog):
    """What was taken before stays, and the next clip is another one."""
    env = hopper()
    with mjrec.Monitor(
        env, tmp_path, **{**CLIP, "workers": 1}, video_length=4, mode="evaluation"
    ) as monitor:
        hop(monitor, 3)
        simulated = env.unwrapped
        simulated.model = copy.copy(simulated.model)
        monitor.step(np.zeros(3))
        monitor.step(np.zeros(3))
    assert "end early" in caplog.text
    [about] = [each for each in metadata_in(tmp_path) if "first_step" in each]
    assert about["broken"]
    assert "another model" in about["broken_reason"]
    assert (about["frame_count"], about["length"]) == (3, 4)
    manifest = manifest_of(tmp_path)
    assert len(manifest["mjrec"]["broken"]) == 1
    assert not manifest["mjrec"]["pending"]


def test_a_full_disk_ends_a_clip_and_not_the_simulation(tmp_path):
    """With `on_error="warn"`: what had room is rendered, and the manifest tells."""
    begins = {**CLIP, "step_trigger": lambda step: step == 2}
    monitor = mjrec.Monitor(
        hopper(), tmp_path, **begins, video_length=9, on_error="warn"
    )
    hop(monitor, 5)
    with file_size_limit(1000):
        hop(monitor, 5)
    hop(monitor, 3)
    monitor.close()
    assert monitor.get_total_steps() == 13
    details = manifest_of(tmp_path)["mjrec"]
    assert "video" in {fault["what"] for fault in details["faults"]}
    [outcome] = finish(tmp_path)
    assert outcome.videos == {details["pending"][0]["video"]: 4}
    [about] = metadata_in(tmp_path)
    assert "Cannot write" in about["broken_reason"]


@pytest.mark.parametrize(
    "name",
    [
        "../there.mp4",
        "openaigym.video.9.9.video000000.mp4",
        "openaigym.video.{infix}.video000000.step000002.mp4",
        "",
    ],
)
def test_no_other_video_is_written_over(name, tmp_path):
    """Logs may be anybody's: the name of a video has to be that of its own clip."""
    record(tmp_path, hopper(), 3, **CLIP)
    [key] = recordings(tmp_path)
    [log] = in_flight(tmp_path)
    named = name.format(infix=key.infix)
    add_facts(log, {"video": {"recording": "deferred", "name": named}})
    before = set(tmp_path.iterdir())
    [outcome] = finish(tmp_path)
    assert "does not belong to its episode" in str(outcome.failures)
    [new] = set(tmp_path.iterdir()) - before
    assert new.match("openaigym.clip.*.failed.json")


def test_a_clip_is_written_at_the_rate_that_was_asked_for(tmp_path):
    """`fps` is that of the file, whichever frames `max_fps` leaves."""
    record(tmp_path, hopper(), 9, **CLIP, video_length=6, fps=12, max_fps=62.5)
    assert not finish(tmp_path)[0].failures
    [about] = metadata_in(tmp_path)
    assert (about["frame_count"], about["fps"]) == (5, "12")
