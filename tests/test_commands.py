# SPDX-License-Identifier: Apache-2.0
import contextlib
import json
import logging
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from parts import parametrize
from recordings import frames_in, metadata_of, videos_in
from trajectories_by_hand import write_log

from evaluations import write_recorded
from mjrec import load_results
from report_recordings import entry, write_journal

PENDULUM = """
<mujoco><worldbody>
  <camera name="front" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/><light pos="0 -1 2"/>
  <body><joint type="hinge" axis="0 1 0" ref="90"/>
    <geom type="capsule" size="0.05" fromto="0 0 0 0.5 0 0" rgba="1 0 0 1"/></body>
</worldbody></mujoco>
"""


def json_lines(text):
    return [json.loads(line) for line in text.splitlines()]


CHEETAH = ("record", "HalfCheetah-v5", "--size", "64x48", "--max-steps", 3)


# Takes more than five seconds: each of three videos starts renderers.
def test_record_writes_scheduled_videos_and_statistics_of_all(command, tmp_path):
    run = (*CHEETAH, "--out", tmp_path, "--episodes", 10, "--seed", 0)
    out = command(*run).out
    assert "episode 9 (10/10): 3 steps" in out
    assert "video000008.mp4" in out
    results = load_results(tmp_path)
    assert results["episode_lengths"] == [3] * 10
    assert videos_in(tmp_path) == [0, 1, 8]
    assert metadata_of(tmp_path, 0)["camera"] == "track"
    assert frames_in(tmp_path, 0)[0].shape == (48, 64, 3)
    listed = json_lines(command("list", tmp_path, "--json").out)
    assert [each["episode_id"] for each in listed if each["video"]] == [0, 1, 8]
    assert listed[8]["video"] == Path(results["videos"][2][0]).name
    assert isinstance(listed[0]["seed"], int)


@pytest.mark.thorough
def test_resumed_run_equals_an_uninterrupted_one(command, tmp_path):
    for out, runs in (("whole", [2]), ("parts", [1, 1])):
        for episodes in runs:
            run = (*CHEETAH, "--out", tmp_path / out, "--seed", 3, "--resume")
            command(*run, "--episodes", episodes)
    whole, parts = load_results(tmp_path / "whole"), load_results(tmp_path / "parts")
    assert whole["episode_rewards"] == parts["episode_rewards"]
    assert metadata_of(tmp_path / "parts", 1)["episode_id"] == 1


def test_keep_lists_only_kept_videos_as_text_and_as_json(command, tmp_path):
    run = (*CHEETAH, "--seed", 0, "--episodes", 3, "--workers", 0, "--keep", "worst:1")
    out = command(*run, "--out", tmp_path / "a").out
    rewards = load_results(tmp_path / "a")["episode_rewards"]
    is_worst = [reward == min(rewards) for reward in rewards]
    assert "1 video:" in out
    assert [f"video00000{number}.mp4" in out for number in range(3)] == is_worst
    summary = json.loads(command(*run, "--out", tmp_path / "b", "--json").out)
    assert (summary["seed"], summary["interrupted"]) == (0, False)
    assert [episode["length"] for episode in summary["episodes"]] == [3] * 3
    assert [episode["pending"] for episode in summary["episodes"]] == is_worst


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["Nope-v1"], ["Nope-v1", "Hopper-v5"]),
        (["HalfCheetah-v5", "--schedule", "some"], ["some", "every:N"]),
        (
            ["HalfCheetah-v5", "--keep", "best:1", "--schedule", "cubic"],
            ["--keep best:1", "--schedule cubic"],
        ),
        (["HalfCheetah-v5", "--policy", "greedy"], ["greedy", "random"]),
        (["HalfCheetah-v5", "--size", "-4x4"], ["-4x4", "640x480"]),
        (["HalfCheetah-v5", "--fps", "nan"], ["fps", "nan"]),
        (["HalfCheetah-v5", "--seed", "-1"], ["seed", "-1"]),
        (["HalfCheetah-v5", "--env-kwargs", "{"], ["JSON object"]),
        (["HalfCheetah-v5", "--env-kwargs", '{"no": 1, "no": 2}'], ["'no'", "twice"]),
        (["HalfCheetah-v5", "--env-kwargs", '{"no": [NaN]}'], ["'no'", "NaN"]),
    ],
)
def test_bad_input_is_one_error_and_no_directory(command, tmp_path, arguments, words):
    err = command("record", *arguments, "--out", tmp_path / "out", status=1).err
    # MuJoCo may print a warning about the model before the error.
    assert [line[:7] for line in err.splitlines()].count("mjrec: ") == 1
    assert [each for each in words if each not in err] == []
    assert not (tmp_path / "out").exists()


def test_existing_recordings_need_force_or_resume(command, tmp_path):
    run = (*CHEETAH, "--out", tmp_path, "--seed", 0, "--schedule", "none")
    command(*run)
    err = command(*run, status=1).err
    assert "--resume" in err
    assert "--force" in err
    command(*run, "--force", "--episodes", 2)
    assert len(load_results(tmp_path)["episode_lengths"]) == 2


NAN = """
import gymnasium
import numpy as np

class Nan(gymnasium.Env):
    observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), float("nan"), True, False, {}

gymnasium.register("Nan-v0", Nan, disable_env_checker=True)
"""


@pytest.mark.parametrize(("allowed", "status"), [([], 1), (["--allow-nan"], 0)])
def test_nan_fails_unless_allowed(command, tmp_path, monkeypatch, allowed, status):
    monkeypatch.chdir(tmp_path)
    Path("nan_env.py").write_text(NAN)
    run = ("nan_env:Nan-v0", "--policy", "zero", "--episodes", 2, *allowed)
    out = command("record", *run, "--out", "r", "--schedule", "none", status=status).out
    assert "NaN or infinite: 2 returns" in out
    small = ("--keep", "none", "--num-seeds", 1, "--workers", 1)
    out, err = command("evaluate", *run, *small, "--out", "e", status=status)
    # Without videos, a missing frame rate needs no warning.
    assert "does not declare a frame rate" not in err
    assert "NaN or infinite: 2 returns" in out
    assert "best" not in out


def test_every_command_shows_returns_that_are_nan(command, tmp_path, monkeypatch):
    """NaN is not an error for commands that do not judge a run."""
    monkeypatch.chdir(tmp_path)
    Path("nan_env.py").write_text(NAN)
    run = ("nan_env:Nan-v0", "--policy", "zero", "--episodes", 2, "--allow-nan")
    small = ("--keep", "none", "--num-seeds", 1, "--workers", 1)
    command("evaluate", *run, *small, "--out", "e")
    command("record", *run, "--out", "r", "--schedule", "none")
    for directory in ("e", "r"):
        for name, *options in (
            ("list",),
            ("render",),
            ("pack", "--out", f"{directory}.zip"),
        ):
            shown = command(name, directory, *options).out
            assert "NaN or infinite: 2 returns: " in shown
        rendered = json.loads(command("render", directory, "--json").out)
        assert rendered["not_finite"] == 2
        assert "NaN or infinite: 2 returns of" in command("report", directory).err


# Takes more than five seconds: each of three videos starts renderers.
def test_cameras_make_one_video_each_or_one_tiled_video(command, tmp_path):
    """The videos of a model file play at 60 frames per second."""
    (tmp_path / "model.xml").write_text(PENDULUM)
    run = ("record", tmp_path / "model.xml", "--max-steps", 2, "--size", "64x48")
    run = (*run, "--camera", "front", "--camera", -1)
    out = command(*run, "--out", tmp_path / "a").out
    videos = [path.name for path in (tmp_path / "a").glob("*.mp4")]
    assert len(videos) == 2
    assert "2 videos:" in out
    assert all(video in out for video in videos)
    about = metadata_of(tmp_path / "a", 0)
    assert (about["camera"], about["fps"]) == ("front", "60")
    more = ("--tiled", "--annotate", "--name-prefix", "rl-video")
    command(*run, "--out", tmp_path / "b", *more)
    assert frames_in(tmp_path / "b", 0)[0].shape == (48, 128, 3)
    about = metadata_of(tmp_path / "b", 0)
    assert about["tiled"]
    assert about["annotated"]
    assert (tmp_path / "b" / "rl-video-episode-0.mp4").exists()


def test_list_shows_pending_videos_clips_and_the_best_episode(command, tmp_path):
    entries = [entry(0, reward=float("nan")), entry(1, recording="deferred")]
    write_journal(tmp_path, "0.7", "X-v0", entries)
    trajectory = write_log(tmp_path, 1, steps=2)
    clip = tmp_path / "openaigym.video.0.7.video000000.step000001.mp4"
    clip.touch()
    clip.with_suffix(".meta.json").touch()
    out = command("list", tmp_path).out
    endings = [line.split()[-1] for line in out.splitlines()[1:3]]
    assert endings == ["truncated", "pending"]
    assert out.splitlines()[-3:] == [
        *("Other videos:", f"  {clip.name}"),
        f"NaN or infinite: 1 return: {tmp_path.name} episode 0",
    ]
    assert "monitor" not in out
    first, second = json_lines(command("list", tmp_path, "--json").out)
    assert (first["pending"], first["trajectory"]) == (False, None)
    assert (second["pending"], second["trajectory"]) == (True, trajectory.name)
    assert second["video"] is None
    # Each monitor numbers its own episodes, and a NaN is never the best return.
    write_journal(tmp_path, "1.7", "X-v0", [entry(0), entry(1, reward=9.0)])
    lines = command("list", tmp_path).out.splitlines()
    assert lines[0].split()[:2] == ["monitor", "episode"]
    assert [line.split()[0] for line in lines[1:5]] == ["0.7", "0.7", "1.7", "1.7"]
    assert lines[5] == "Best return: episode 1 of 1.7, 9"


def test_list_shows_all_monitor_directories_below(command, tmp_path):
    for name, count in (("b", 1), ("a", 2)):
        write_journal(tmp_path / name, "0.7", "X-v0", map(entry, range(count)))
    (tmp_path / "notes").mkdir()
    (tmp_path / "c.txt").touch()
    out = command("list", tmp_path).out
    headings = [line for line in out.splitlines() if line.endswith(":")]
    assert headings == [f"{tmp_path / name}:" for name in "ab"]
    assert out.count("truncated") == 3
    lines = json_lines(command("list", tmp_path, "--json").out)
    listed = [(line["directory"], line["episode_id"]) for line in lines]
    assert listed == [("a", 0), ("a", 1), ("b", 0)]


def test_list_shows_episodes_of_a_finished_or_running_evaluation(command, tmp_path):
    """A running evaluation has not selected its videos yet."""
    name = "openaigym.video.0.batch.video000000.mp4"
    write_recorded(tmp_path, ["a/x", "b/y"], videos={"a/x": name, "b/y": name})
    (tmp_path / "a-x" / name).touch()

    def rows(directory):
        out = command("list", directory).out
        return [line.split() for line in out.splitlines() if "/" in line]

    listed = rows(tmp_path)
    assert listed[:3] == [
        ["a/x", "0", "0", "10", "3", "truncated", name],
        ["a/x", "0", "1", "10", "1", "truncated"],
        ["a/x", "7", "0", "10", "failed"],
    ]
    assert [listed[4][-1], len(listed)] == ["pending", 8]
    first, *_ = json_lines(command("list", tmp_path, "--json").out)
    assert (first["task"], first["seed"], first["reward"]) == ("a/x", 0, 3.0)
    assert (first["video"], first["pending"]) == (str(tmp_path / "a-x" / name), False)
    write_recorded(tmp_path / "begun", ["a/x"], finished=False)
    assert rows(tmp_path / "begun") == [
        ["a/x", "0", "0", "10", "3", "truncated"],
        ["a/x", "0", "1", "10", "1", "truncated"],
        ["a/x", "7", "1", "10", "2", "truncated"],
    ]


def test_list_of_an_empty_directory_is_no_error(command, tmp_path):
    handlers = logging.getLogger("mjrec").handlers[:]
    assert command("list", tmp_path).out == f"No episodes are recorded in {tmp_path}.\n"
    assert command("list", tmp_path, "--json").out == ""
    assert "nothing" in command("list", tmp_path / "nothing", status=1).err
    # A leftover handler would repeat every message of later commands in this process.
    assert logging.getLogger("mjrec").handlers == handlers


@pytest.mark.thorough
def test_list_is_silent_when_its_reader_closes_the_pipe(tmp_path):
    write_journal(tmp_path, "0.7", "X-v0", [entry(0)])
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "mjrec", "list", str(tmp_path), "--json"]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, "")


LOG = "openaigym.trajectory.0.7.episode00000"


def test_recover_lists_recovered_files(command, tmp_path):
    text, as_json = tmp_path / "text", tmp_path / "json"
    for directory in (text, as_json):
        directory.mkdir()
        write_log(directory, 0)
        write_log(directory, 1, ended=False)
    assert command("recover", text).out.splitlines() == [
        f"Recovered in {text}:",
        f"  {LOG}0.h5: 4 steps",
        f"  {LOG}1.h5: 4 steps, incomplete: killed",
        "  openaigym.episode_batch.0.7.stats.json: 0 episodes",
        "  openaigym.manifest.0.7.manifest.json: 0 videos, 2 pending: mjrec render",
    ]
    assert command("recover", text).out == f"Nothing to recover in {text}.\n"
    done = json.loads(command("recover", as_json, "--timeout", 0, "--json").out)
    assert done["directory"] == str(as_json)
    assert done["files"][0] == {"name": f"{LOG}0.h5", "what": "4 steps"}
    assert (done["failures"], done["open_monitors"]) == ([], [])


def test_recover_lists_failures(command, tmp_path):
    """The log of a newer version cannot be recovered and stays unchanged."""
    write_log(tmp_path, 0)
    [log] = tmp_path.glob("*.log")
    [journal] = tmp_path.glob("*.jsonl")
    newer = journal.read_bytes().replace(b'"version": 1', b'"version": 9', 1)
    journal.write_bytes(newer)
    content = log.read_bytes()
    out = command("recover", tmp_path, status=1).out
    assert "Not recovered:\n" in out
    assert f"  {log.name}: " in out
    assert log.read_bytes() == content
    err = command("recover", tmp_path / "missing", status=1).err
    assert err.startswith("mjrec: Cannot recover")


def test_warnings_and_policy_errors_are_shown_once(command, tmp_path, monkeypatch):
    """Neither later episodes nor parallel workers of an evaluation repeat a message."""
    monkeypatch.chdir(tmp_path)
    # This spring is too stiff for timesteps of a tenth of a second.
    unstable = PENDULUM.replace("<mujoco>", '<mujoco><option timestep="0.1"/>')
    unstable = unstable.replace("ref=", 'stiffness="1e9" ref=')
    Path("unstable.xml").write_text(unstable)
    Path("crash_policy.py").write_text(
        "def crash(observation):\n    raise RuntimeError('boom')\n"
    )
    run = ("--out", "a", "--episodes", 3, "--schedule", "none", "--max-steps", 50)
    err = command("record", "unstable.xml", *run).err
    assert err.count("The simulation is unstable") == 1
    few = ("--keep", "none", "--episodes", 2, "--num-seeds", 2, "--workers", 2)
    for run in (
        ("record", "unstable.xml", "--out", "b"),
        ("evaluate", "Hopper-v5", "CartPole-v1", "--out", "c", *few),
    ):
        err = command(*run, "--policy", "crash_policy:crash", status=1).err
        assert err.count('crash_policy.py", line 2, in crash') == 1


def endless(directory):
    """Return a command that records until a signal stops it."""
    command = ["record", "HalfCheetah-v5", "--out", str(directory), "--size", "64x48"]
    command += ["--seed", "0", "--episodes", "10000", "--max-steps", "20"]
    return [sys.executable, "-m", "mjrec", *command]


# Takes more than five seconds: it interrupts a command, then renders its videos.
@pytest.mark.usefixtures("default_signals")
@parametrize(
    ("signum", "status"),
    [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)],
    default=2,
)
def test_signals_close_files_and_keep_all_episodes(signum, status, command, tmp_path):
    """The command reports pending videos, which `mjrec render` then renders."""
    process = subprocess.Popen(
        endless(tmp_path), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert b"episode 0" in process.stdout.readline()
    process.send_signal(signum)
    out, errors = process.communicate(timeout=60)
    assert process.returncode == status
    assert b"Traceback" not in errors
    assert (b"Interrupted" in out) is (signum == signal.SIGINT)
    assert set(load_results(tmp_path)["episode_lengths"]) == {20}
    if not videos_in(tmp_path):
        assert f"pending: mjrec render {tmp_path}".encode() in out + errors
    command("render", tmp_path, "--workers", "1")
    assert len(frames_in(tmp_path, 0)) == 21
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


@pytest.mark.usefixtures("default_signals")
def test_terminal_shows_a_progress_bar_of_episodes_and_steps(tmp_path):
    reader, terminal = pty.openpty()
    process = subprocess.Popen(endless(tmp_path), stdout=terminal, stderr=terminal)
    os.close(terminal)
    shown = b""
    while b"1/10000 episodes" not in shown:
        shown += os.read(reader, 65536)
    process.send_signal(signal.SIGINT)
    # On Linux, reading raises an OSError when the other end is closed.
    with contextlib.suppress(OSError):
        while True:
            shown += os.read(reader, 65536)
    assert process.wait(60) == 130
    os.close(reader)
    assert b"steps" in shown
    assert b"HalfCheetah-v5" in shown
