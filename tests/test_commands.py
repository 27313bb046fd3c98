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
from mjrec.commands import main
from report_recordings import entry, write_journal

PENDULUM = """
<mujoco>
  <worldbody>
    <camera name="front" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>
    <light pos="0 -1 2"/>
    <body>
      <joint type="hinge" axis="0 1 0" ref="90"/>
      <geom type="capsule" size="0.05" fromto="0 0 0 0.5 0 0" rgba="1 0 0 1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def mjrec(capsys):
    """Run the command; returns the exit status and what it printed."""
    return lambda *arguments: (main([*map(str, arguments)]), *capsys.readouterr())


CHEETAH = ("record", "HalfCheetah-v5", "--size", "64x48", "--max-steps", 3)


# Takes more than five seconds: three videos, each by renderers that start for it.
def test_record_gymnasium(mjrec, tmp_path):
    """Ten short episodes: videos of 0, 1 and 8, statistics of all, a line for each."""
    status, out, _ = mjrec(*CHEETAH, "--out", tmp_path, "--episodes", 10, "--seed", 0)
    assert status == 0
    assert "episode 9 (10/10): 3 steps" in out
    assert "video000008.mp4" in out
    results = load_results(tmp_path)
    assert results["episode_lengths"] == [3] * 10
    assert videos_in(tmp_path) == [0, 1, 8]
    assert metadata_of(tmp_path, 0)["camera"] == "track"
    assert frames_in(tmp_path, 0)[0].shape == (48, 64, 3)
    _, out, _ = mjrec("list", tmp_path, "--json")
    listed = [json.loads(line) for line in out.splitlines()]
    assert [each["episode_id"] for each in listed if each["video"]] == [0, 1, 8]
    assert listed[8]["video"] == Path(results["videos"][2][0]).name
    assert isinstance(listed[0]["seed"], int)


@pytest.mark.thorough
def test_resume_goes_on_where_it_stopped(mjrec, tmp_path):
    """Episode 1 of a resumed run is episode 1 of an uninterrupted one."""
    for out, runs in (("whole", [2]), ("parts", [1, 1])):
        for episodes in runs:
            run = (*CHEETAH, "--out", tmp_path / out, "--seed", 3, "--resume")
            mjrec(*run, "--episodes", episodes)
    whole, parts = load_results(tmp_path / "whole"), load_results(tmp_path / "parts")
    assert whole["episode_rewards"] == parts["episode_rewards"]
    assert metadata_of(tmp_path / "parts", 1)["episode_id"] == 1


def test_keep_names_only_what_was_chosen(mjrec, tmp_path):
    """The videos that are there in the end, in the summary and as JSON."""
    run = (*CHEETAH, "--seed", 0, "--episodes", 3, "--workers", 0, "--keep", "worst:1")
    _, out, _ = mjrec(*run, "--out", tmp_path / "a")
    rewards = load_results(tmp_path / "a")["episode_rewards"]
    is_worst = [reward == min(rewards) for reward in rewards]
    assert "1 video:" in out
    assert [f"video00000{number}.mp4" in out for number in range(3)] == is_worst
    _, out, _ = mjrec(*run, "--out", tmp_path / "b", "--json")
    said = json.loads(out)
    assert (said["seed"], said["interrupted"]) == (0, False)
    assert [episode["length"] for episode in said["episodes"]] == [3] * 3
    assert [episode["pending"] for episode in said["episodes"]] == is_worst


@pytest.mark.parametrize(
    ("arguments", "said"),
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
def test_bad_input_is_one_clear_error(mjrec, tmp_path, arguments, said):
    """It says what was asked and what there is, and leaves nothing behind."""
    status, _, err = mjrec("record", *arguments, "--out", tmp_path / "out")
    assert status == 1
    # MuJoCo may warn of the model before that.
    assert [line[:7] for line in err.splitlines()].count("mjrec: ") == 1
    for words in said:
        assert words in err
    assert not (tmp_path / "out").exists()


def test_existing_recordings_need_force_or_resume(mjrec, tmp_path):
    """The error names both; force replaces."""
    run = (*CHEETAH, "--out", tmp_path, "--seed", 0, "--schedule", "none")
    mjrec(*run)
    status, _, err = mjrec(*run)
    assert status == 1
    assert "--resume" in err
    assert "--force" in err
    assert mjrec(*run, "--force", "--episodes", 2)[0] == 0
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


@pytest.mark.parametrize(("allowed", "expected"), [([], 1), (["--allow-nan"], 0)])
def test_a_return_that_is_nan_is_no_success(
    mjrec, tmp_path, monkeypatch, allowed, expected
):
    """It is said, and fails recording and evaluating unless it is allowed."""
    monkeypatch.chdir(tmp_path)
    Path("nan_env.py").write_text(NAN)
    run = ("nan_env:Nan-v0", "--policy", "zero", "--episodes", 2, *allowed)
    status, out, _ = mjrec("record", *run, "--out", "r", "--schedule", "none")
    assert status == expected
    assert "NaN or infinite: 2 returns" in out
    small = ("--keep", "none", "--num-seeds", 1, "--workers", 1)
    status, out, err = mjrec("evaluate", *run, *small, "--out", "e")
    assert status == expected
    # Nothing is drawn, so how fast it would play is no news.
    assert "does not declare a frame rate" not in err
    assert "NaN or infinite: 2 returns" in out
    # None of them is the best.
    assert "best" not in out


def test_every_command_shows_returns_that_are_nan(mjrec, tmp_path, monkeypatch):
    """Those that judge nothing show them, too, and do what they were asked for."""
    monkeypatch.chdir(tmp_path)
    Path("nan_env.py").write_text(NAN)
    run = ("nan_env:Nan-v0", "--policy", "zero", "--episodes", 2, "--allow-nan")
    small = ("--keep", "none", "--num-seeds", 1, "--workers", 1)
    mjrec("evaluate", *run, *small, "--out", "e")
    mjrec("record", *run, "--out", "r", "--schedule", "none")
    for directory in ("e", "r"):
        for command in (
            ("list", directory),
            ("render", directory),
            ("pack", directory, "--out", f"{directory}.zip"),
        ):
            status, out, _ = mjrec(*command)
            assert status == 0
            assert "NaN or infinite: 2 returns: " in out
        assert json.loads(mjrec("render", directory, "--json")[1])["not_finite"] == 2
        status, _, err = mjrec("report", directory)
        assert status == 0
        assert "NaN or infinite: 2 returns of" in err


def test_wrong_usage_is_status_2(mjrec):
    """As every command line has it."""
    with pytest.raises(SystemExit) as left:
        mjrec("record", "HalfCheetah-v5", "--no-such-option")
    assert left.value.code == 2


# Takes more than five seconds: three videos, by renderers that start for them.
def test_cameras_are_a_video_each_or_one_side_by_side(mjrec, tmp_path):
    """All are listed; captions and second names are asked for likewise.

    A model file plays at 60 frames a second.
    """
    (tmp_path / "model.xml").write_text(PENDULUM)
    run = ("record", tmp_path / "model.xml", "--max-steps", 2, "--size", "64x48")
    run = (*run, "--camera", "front", "--camera", -1)
    status, out, _ = mjrec(*run, "--out", tmp_path / "a")
    assert status == 0
    videos = [path.name for path in (tmp_path / "a").glob("*.mp4")]
    assert len(videos) == 2
    assert "2 videos:" in out
    assert all(video in out for video in videos)
    about = metadata_of(tmp_path / "a", 0)
    assert (about["camera"], about["fps"]) == ("front", "60")
    more = ("--tiled", "--annotate", "--name-prefix", "rl-video")
    assert mjrec(*run, "--out", tmp_path / "b", *more)[0] == 0
    assert frames_in(tmp_path / "b", 0)[0].shape == (48, 128, 3)
    about = metadata_of(tmp_path / "b", 0)
    assert about["tiled"]
    assert about["annotated"]
    assert (tmp_path / "b" / "rl-video-episode-0.mp4").exists()


def test_list_says_which_videos_are_pending_and_which_episode_is_best(mjrec, tmp_path):
    """In place of the name that there is not yet; clips are listed for themselves."""
    entries = [entry(0, reward=float("nan")), entry(1, recording="deferred")]
    write_journal(tmp_path, "0.7", "X-v0", entries)
    trajectory = write_log(tmp_path, 1, steps=2)
    clip = tmp_path / "openaigym.video.0.7.video000000.step000001.mp4"
    clip.touch()
    clip.with_suffix(".meta.json").touch()
    _, out, _ = mjrec("list", tmp_path)
    assert out.count("pending") == 1
    assert out.splitlines()[-3:] == [
        *("Other videos:", f"  {clip.name}"),
        f"NaN or infinite: 1 return: {tmp_path.name} episode 0",
    ]
    assert "monitor" not in out
    _, out, _ = mjrec("list", tmp_path, "--json")
    first, second = (json.loads(line) for line in out.splitlines())
    assert (first["pending"], first["trajectory"]) == (False, None)
    assert (second["pending"], second["trajectory"]) == (True, trajectory.name)
    assert second["video"] is None
    # Sub-environments count their episodes separately; a NaN is not the best.
    write_journal(tmp_path, "1.7", "X-v0", [entry(0), entry(1, reward=9.0)])
    _, out, _ = mjrec("list", tmp_path)
    lines = out.splitlines()
    assert lines[0].split()[:2] == ["monitor", "episode"]
    assert [line.split()[0] for line in lines[1:5]] == ["0.7", "0.7", "1.7", "1.7"]
    assert lines[5] == "Best return: episode 1 of 1.7, 9"


def test_list_shows_the_directories_in_one(mjrec, tmp_path):
    """Others are passed over."""
    for name, count in (("b", 1), ("a", 2)):
        write_journal(tmp_path / name, "0.7", "X-v0", map(entry, range(count)))
    (tmp_path / "notes").mkdir()
    (tmp_path / "c.txt").touch()
    _, out, _ = mjrec("list", tmp_path)
    assert [line for line in out.splitlines() if line.endswith(":")] == [
        f"{tmp_path / name}:" for name in "ab"
    ]
    assert out.count("truncated") == 3
    _, out, _ = mjrec("list", tmp_path, "--json")
    lines = [json.loads(line) for line in out.splitlines()]
    listed = [(line["directory"], line["episode_id"]) for line in lines]
    assert listed == [("a", 0), ("a", 1), ("b", 0)]


def test_list_shows_an_evaluation_as_one(mjrec, tmp_path):
    """Task, seed, return and video of each episode; what failed says so.

    Of one that is not over, what is done: which get a video is not chosen yet.
    """
    name = "openaigym.video.0.batch.video000000.mp4"
    write_recorded(tmp_path, ["a/x", "b/y"], videos={"a/x": name, "b/y": name})
    (tmp_path / "a-x" / name).touch()
    _, out, _ = mjrec("list", tmp_path)
    rows = [line.split() for line in out.splitlines() if "/" in line]
    assert rows[:3] == [
        ["a/x", "0", "0", "10", "3", "truncated", name],
        ["a/x", "0", "1", "10", "1", "truncated"],
        ["a/x", "7", "0", "10", "failed"],
    ]
    assert [rows[4][-1], len(rows)] == ["pending", 8]
    _, out, _ = mjrec("list", tmp_path, "--json")
    first, *_ = (json.loads(line) for line in out.splitlines())
    assert (first["task"], first["seed"], first["reward"]) == ("a/x", 0, 3.0)
    assert (first["video"], first["pending"]) == (str(tmp_path / "a-x" / name), False)
    write_recorded(tmp_path / "begun", ["a/x"], finished=False)
    _, out, _ = mjrec("list", tmp_path / "begun")
    assert [line.split() for line in out.splitlines() if "/" in line] == [
        ["a/x", "0", "0", "10", "3", "truncated"],
        ["a/x", "0", "1", "10", "1", "truncated"],
        ["a/x", "7", "1", "10", "2", "truncated"],
    ]


def test_list_says_that_there_is_nothing(mjrec, tmp_path):
    """Not an empty table, and no error: a run may not have come to an end yet."""
    handlers = logging.getLogger("mjrec").handlers[:]
    status, out, _ = mjrec("list", tmp_path)
    assert (status, out) == (0, f"No episodes are recorded in {tmp_path}.\n")
    assert mjrec("list", tmp_path, "--json")[:2] == (0, "")
    status, _, err = mjrec("list", tmp_path / "nothing")
    assert status == 1
    assert "nothing" in err
    # Else each later command of this process would say each message once more.
    assert logging.getLogger("mjrec").handlers == handlers


@pytest.mark.thorough
def test_reader_may_leave_early(tmp_path):
    """Nothing is said on stderr where the list's reader has closed the pipe."""
    write_journal(tmp_path, "0.7", "X-v0", [entry(0)])
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "mjrec", "list", str(tmp_path), "--json"]
    done = subprocess.run(
        command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, "")


LOG = "openaigym.trajectory.0.7.episode00000"


def test_recover_lists_what_was_done(mjrec, tmp_path):
    """A line a file, and nothing the second time; or one JSON object."""
    for name in ("text", "json"):
        (tmp_path / name).mkdir()
        write_log(tmp_path / name, 0)
        write_log(tmp_path / name, 1, ended=False)
    status, out, _ = mjrec("recover", tmp_path / "text")
    assert status == 0
    assert out.splitlines() == [
        f"Recovered in {tmp_path / 'text'}:",
        f"  {LOG}0.h5: 4 steps",
        f"  {LOG}1.h5: 4 steps, incomplete: killed",
        "  openaigym.episode_batch.0.7.stats.json: 0 episodes",
        "  openaigym.manifest.0.7.manifest.json: 0 videos, 2 pending: mjrec render",
    ]
    again = mjrec("recover", tmp_path / "text")
    assert again[:2] == (0, f"Nothing to recover in {tmp_path / 'text'}.\n")
    _, out, _ = mjrec("recover", tmp_path / "json", "--timeout", 0, "--json")
    said = json.loads(out)
    assert said["directory"] == str(tmp_path / "json")
    assert said["files"][0] == {"name": f"{LOG}0.h5", "what": "4 steps"}
    assert (said["failures"], said["open_monitors"]) == ([], [])


def test_recover_lists_failures(mjrec, tmp_path):
    """The exit status says so too. A newer version's log is left as it is."""
    write_log(tmp_path, 0)
    [log] = tmp_path.glob("*.log")
    [journal] = tmp_path.glob("*.jsonl")
    spoilt = journal.read_bytes().replace(b'"version": 1', b'"version": 9', 1)
    journal.write_bytes(spoilt)
    content = log.read_bytes()
    status, out, _ = mjrec("recover", tmp_path)
    assert status == 1
    assert "Not recovered:\n" in out
    assert f"  {log.name}: " in out
    assert log.read_bytes() == content
    status, _, err = mjrec("recover", tmp_path / "missing")
    assert status == 1
    assert err.startswith("mjrec: Cannot recover")


def test_what_is_said_by_mujoco_and_of_a_policy_is_said_once(
    mjrec, tmp_path, monkeypatch
):
    """Of many episodes, and of several workers of an evaluation."""
    monkeypatch.chdir(tmp_path)
    # A tenth of a second a step, with a spring that is far too stiff for it.
    unstable = PENDULUM.replace("<mujoco>", '<mujoco><option timestep="0.1"/>')
    unstable = unstable.replace("ref=", 'stiffness="1e9" ref=')
    Path("unstable.xml").write_text(unstable)
    Path("crash_policy.py").write_text(
        "def crash(observation):\n    raise RuntimeError('boom')\n"
    )
    run = ("--out", "a", "--episodes", 3, "--schedule", "none", "--max-steps", 50)
    status, _, err = mjrec("record", "unstable.xml", *run)
    assert (status, err.count("The simulation is unstable")) == (0, 1)
    policy = ("--policy", "crash_policy:crash")
    few = ("--keep", "none", "--episodes", 2, "--num-seeds", 2, "--workers", 2)
    for command in (
        ("record", "unstable.xml", "--out", "b"),
        ("evaluate", "Hopper-v5", "CartPole-v1", "--out", "c", *few),
    ):
        status, _, err = mjrec(*command, *policy)
        assert status == 1
        assert err.count('crash_policy.py", line 2, in crash') == 1


def endless(directory):
    """Return a command that records until it is told to end."""
    command = ["record", "HalfCheetah-v5", "--out", str(directory), "--size", "64x48"]
    command += ["--seed", "0", "--episodes", "10000", "--max-steps", "20"]
    return [sys.executable, "-m", "mjrec", *command]


# Takes more than five seconds: a command is interrupted, and what it left is drawn.
@pytest.mark.usefixtures("default_signals")
@parametrize(
    ("signum", "status"),
    [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)],
    default=2,
)
def test_being_told_to_end_keeps_everything_so_far(signum, status, tmp_path):
    """By Ctrl-C, or by a scheduler at a time limit: files are closed, and can be drawn.

    What is pending is said.
    """
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
    assert main(["render", str(tmp_path), "--workers", "1"]) == 0
    assert len(frames_in(tmp_path, 0)) == 21
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


@pytest.mark.usefixtures("default_signals")
def test_terminal_shows_a_bar(tmp_path):
    """On a terminal there is a progress bar with episodes and steps."""
    reader, terminal = pty.openpty()
    process = subprocess.Popen(endless(tmp_path), stdout=terminal, stderr=terminal)
    os.close(terminal)
    shown = b""
    while b"1/10000 episodes" not in shown:
        shown += os.read(reader, 65536)
    process.send_signal(signal.SIGINT)
    # Linux's way to say that the other end is closed.
    with contextlib.suppress(OSError):
        while True:
            shown += os.read(reader, 65536)
    assert process.wait(60) == 130
    os.close(reader)
    assert b"steps" in shown
    assert b"HalfCheetah-v5" in shown
