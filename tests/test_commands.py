# SPDX-License-Identifier: Apache-2.0
import json
import logging
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import pytest
from parts import parametrize
from recordings import frames_in, metadata_of, videos_in
from trajectories_by_hand import write_log

from evaluations import write_recorded
from mjrec import Monitor, load_results
from mjrec.commands import COMMANDS, main
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

POLICY = """
import numpy as np

def calm(observation):
    return np.zeros(6)

class Built:
    def __init__(self, env):
        self.shape = env.action_space.shape

    def reset(self, seed):
        print("policy seed", seed)

    def __call__(self, observation):
        return np.zeros(self.shape)
"""


@pytest.fixture
def mjrec(capsys):
    """Run the command; returns the exit status and what it printed."""

    def run(*arguments):
        status = main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return status, out, err

    return run


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
    assert [Path(video).name[-10:] for video, _ in results["videos"]] == [
        "000000.mp4",
        "000001.mp4",
        "000008.mp4",
    ]
    assert metadata_of(tmp_path, 0)["camera"] == "track"
    assert frames_in(tmp_path, 0)[0].shape == (48, 64, 3)


def test_record_mjcf_file(mjrec, tmp_path):
    """A model file is simulated and recorded at 60 frames a second."""
    model = tmp_path / "pendulum.xml"
    model.write_text(PENDULUM)
    status, _, _ = mjrec(
        *("record", model, "--out", tmp_path / "out", "--max-steps", 6),
        *("--size", "64x48", "--seed", 0),
    )
    assert status == 0
    metadata = metadata_of(tmp_path / "out", 0)
    assert metadata["fps"] == "60"
    assert metadata["camera"] == "front"
    assert metadata["gl_renderer"]
    frames = frames_in(tmp_path / "out", 0)
    assert len(frames) == 7
    assert (frames[0] != frames[-1]).any()


def test_text_environment(mjrec, tmp_path):
    """An environment that draws text gives an asciicast, without any OpenGL."""
    status, _, err = mjrec(
        *("record", "FrozenLake-v1", "--out", tmp_path, "--seed", 0),
        *("--env-kwargs", '{"render_mode": "ansi"}'),
    )
    assert (status, err) == (0, "")
    [[cast, _]] = load_results(tmp_path)["videos"]
    assert json.loads(Path(cast).read_text())["version"] == 1


@pytest.mark.thorough
def test_resume_goes_on_where_it_stopped(mjrec, tmp_path):
    """Episode 1 of a resumed run is episode 1 of an uninterrupted one."""
    for out, runs in (("whole", [2]), ("parts", [1, 1])):
        for episodes in runs:
            mjrec(
                *(*CHEETAH, "--out", tmp_path / out, "--seed", 3, "--resume"),
                *("--episodes", episodes),
            )
    whole, parts = load_results(tmp_path / "whole"), load_results(tmp_path / "parts")
    assert whole["episode_rewards"] == parts["episode_rewards"]
    assert metadata_of(tmp_path / "parts", 1)["episode_id"] == 1


def test_keep_names_only_what_was_chosen(mjrec, tmp_path):
    """The videos that are there in the end, in the summary and as JSON."""
    run = (*CHEETAH, "--seed", 0, "--episodes", 3, "--workers", 0, "--keep", "worst:1")
    _, out, _ = mjrec(*run, "--out", tmp_path / "a")
    rewards = load_results(tmp_path / "a")["episode_rewards"]
    worst = rewards.index(min(rewards))
    assert "1 video:" in out
    assert [name in out for name in map("video00000{}.mp4".format, range(3))] == [
        number == worst for number in range(3)
    ]
    _, out, _ = mjrec(*run, "--out", tmp_path / "b", "--json")
    said = json.loads(out)
    assert (said["seed"], said["interrupted"]) == (0, False)
    assert [episode["length"] for episode in said["episodes"]] == [3] * 3
    pending = [episode["pending"] for episode in said["episodes"]]
    assert pending == [number == worst for number in range(3)]


@pytest.mark.parametrize("policy", ["zero", "calm_policy:calm", "calm_policy:Built"])
def test_policies(mjrec, tmp_path, monkeypatch, policy):
    """A built-in, a function and a class of the working directory act alike."""
    (tmp_path / "calm_policy.py").write_text(POLICY)
    monkeypatch.chdir(tmp_path)
    status, out, _ = mjrec(
        *(*CHEETAH, "--out", "out", "--seed", 0, "--policy", policy),
        *("--schedule", "none"),
    )
    assert status == 0
    assert ("policy seed" in out) == policy.endswith("Built")
    assert load_results(tmp_path / "out")["episode_rewards"] == [
        pytest.approx(0.0, abs=0.5)
    ]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["Nope-v1"], ["Nope-v1", "Hopper-v5"]),
        (["HalfCheetah-v5", "--schedule", "some"], ["some", "every:N"]),
        (["HalfCheetah-v5", "--keep", "some"], ["some", "worst:N"]),
        (["HalfCheetah-v5", "--keep", "best:1", "--render", "off"], ["keep", "off"]),
        (
            ["HalfCheetah-v5", "--keep", "best:1", "--schedule", "cubic"],
            ["--keep best:1", "--schedule cubic"],
        ),
        (["HalfCheetah-v5", "--policy", "greedy"], ["greedy", "random"]),
        (["HalfCheetah-v5", "--size", "0x48"], ["width", "0"]),
        (["HalfCheetah-v5", "--size", "big"], ["big", "640x480"]),
        (["HalfCheetah-v5", "--size", "-4x4"], ["-4x4"]),
        (["HalfCheetah-v5", "--fps", "0"], ["fps", "0"]),
        (["HalfCheetah-v5", "--fps", "nan"], ["fps", "nan"]),
        (["HalfCheetah-v5", "--episodes", "0"], ["episodes", "0"]),
        (["HalfCheetah-v5", "--seed", "-1"], ["seed", "-1"]),
        (["HalfCheetah-v5", "--env-kwargs", "[1]"], ["JSON object", "[1]"]),
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
    mjrec(*CHEETAH, "--out", tmp_path, "--seed", 0, "--schedule", "none")
    status, _, err = mjrec(*CHEETAH, "--out", tmp_path, "--seed", 0)
    assert status == 1
    assert "--resume" in err
    assert "--force" in err
    status, _, _ = mjrec(
        *(*CHEETAH, "--out", tmp_path, "--seed", 0, "--force"),
        *("--schedule", "none", "--episodes", 2),
    )
    assert status == 0
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


def test_messages_are_said_once(mjrec, tmp_path):
    """However often the command ran in one process."""
    handlers = logging.getLogger("mjrec").handlers[:]
    mjrec("list", tmp_path)
    mjrec("list", tmp_path)
    assert logging.getLogger("mjrec").handlers == handlers


def test_wrong_usage_is_status_2(mjrec):
    """As every command line has it."""
    with pytest.raises(SystemExit) as left:
        mjrec("record", "HalfCheetah-v5", "--no-such-option")
    assert left.value.code == 2


# Takes more than five seconds: three videos, by renderers that start for them.
def test_cameras_are_a_video_each_or_one_side_by_side(mjrec, tmp_path):
    """All are listed; captions and second names are asked for likewise."""
    (tmp_path / "model.xml").write_text(PENDULUM)
    run = ("record", tmp_path / "model.xml", "--max-steps", 2, "--size", "64x48")
    run = (*run, "--camera", "front", "--camera", -1)
    status, out, _ = mjrec(*run, "--out", tmp_path / "a")
    assert status == 0
    videos = sorted(path.name for path in (tmp_path / "a").glob("*.mp4"))
    assert len(videos) == 2
    assert "2 videos:" in out
    assert all(video in out for video in videos)
    assert metadata_of(tmp_path / "a", 0)["camera"] == "front"
    more = ("--tiled", "--annotate", "--name-prefix", "rl-video")
    assert mjrec(*run, "--out", tmp_path / "b", *more)[0] == 0
    [frame, *_] = frames_in(tmp_path / "b", 0)
    assert frame.shape == (48, 128, 3)
    about = metadata_of(tmp_path / "b", 0)
    assert about["tiled"]
    assert about["annotated"]
    assert (tmp_path / "b" / "rl-video-episode-0.mp4").exists()


@pytest.mark.thorough
def test_list_names_videos_of_more_or_less_than_an_episode(mjrec, tmp_path):
    """Those that are counted in steps, and that of an episode that was cut off."""
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=3)
    options = {"height": 32, "width": 32, "workers": 1}
    with Monitor(
        env, tmp_path, step_trigger=lambda step: step == 1, video_length=4, **options
    ) as env:
        for _ in range(2):
            env.reset(seed=0)
            for _ in range(3):
                env.step([0.0])
    status, out, _ = mjrec("list", tmp_path)
    assert status == 0
    [video] = tmp_path.glob("*.mp4")
    assert out.splitlines()[-2:] == ["Other videos:", f"  {video.name}"]


def test_list_says_which_videos_are_pending(mjrec, tmp_path):
    """In place of the name that there is not yet."""
    entries = [entry(0), entry(1, recording="deferred")]
    write_journal(tmp_path, "0.7", "X-v0", entries)
    trajectory = write_log(tmp_path, 1, steps=2)
    _, out, _ = mjrec("list", tmp_path)
    assert out.count("pending") == 1
    _, out, _ = mjrec("list", tmp_path, "--json")
    first, second = (json.loads(line) for line in out.splitlines())
    assert (first["pending"], first["trajectory"]) == (False, None)
    assert (second["pending"], second["trajectory"]) == (True, trajectory.name)
    assert second["video"] is None


def test_list_names_the_best_episode_and_its_monitor(mjrec, tmp_path):
    """Sub-environments count their episodes separately; a NaN is not the best."""
    write_journal(tmp_path, "0.7", "X-v0", [entry(0, reward=float("nan"))])
    _, out, _ = mjrec("list", tmp_path)
    assert "monitor" not in out
    assert "Best return" not in out
    write_journal(tmp_path, "1.7", "X-v0", [entry(0, reward=2.0), entry(1, reward=9.0)])
    _, out, _ = mjrec("list", tmp_path)
    lines = out.splitlines()
    assert lines[0].split()[:2] == ["monitor", "episode"]
    assert sorted(line.split()[0] for line in lines[1:-1]) == ["0.7", "1.7", "1.7"]
    assert lines[-1] == "Best return: episode 1 of 1.7, 9"


@pytest.mark.thorough
def test_list_shows_the_directories_in_one(mjrec, tmp_path):
    """As of an evaluation, which has one for each task; others are passed over."""
    for name, episodes in (("b", 1), ("a", 2)):
        mjrec(*CHEETAH, "--out", tmp_path / name, "--episodes", episodes)
    (tmp_path / "notes").mkdir()
    (tmp_path / "c.txt").touch()
    status, out, _ = mjrec("list", tmp_path)
    assert status == 0
    assert [line for line in out.splitlines() if line.endswith(":")] == [
        f"{tmp_path / name}:" for name in "ab"
    ]
    assert out.count("truncated") == 3
    videos = sorted(path.name for path in tmp_path.glob("*/*.mp4"))
    assert all(video in out for video in videos)
    _, out, _ = mjrec("list", tmp_path, "--json")
    lines = [json.loads(line) for line in out.splitlines()]
    assert [line["directory"] for line in lines] == ["a", "a", "b"]
    assert [line["episode_id"] for line in lines] == [0, 1, 0]
    assert sorted(line["video"] for line in lines) == videos
    assert isinstance(lines[0]["seed"], int)


def test_list_shows_an_evaluation_as_one(mjrec, tmp_path):
    """Task, seed, return and video of each episode; what failed says so."""
    name = "openaigym.video.0.batch.video000000.mp4"
    write_recorded(tmp_path, ["a/x", "b/y"], videos={"a/x": name, "b/y": name})
    (tmp_path / "a-x" / name).touch()
    status, out, _ = mjrec("list", tmp_path)
    assert status == 0
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


def test_list_shows_what_is_over_of_an_evaluation_that_is_not(mjrec, tmp_path):
    """By task and seed, too; which get a video is not chosen yet."""
    write_recorded(tmp_path, ["a/x"], finished=False)
    status, out, _ = mjrec("list", tmp_path)
    assert status == 0
    assert [line.split() for line in out.splitlines() if "/" in line] == [
        ["a/x", "0", "0", "10", "3", "truncated"],
        ["a/x", "0", "1", "10", "1", "truncated"],
        ["a/x", "7", "1", "10", "2", "truncated"],
    ]
    _, out, _ = mjrec("list", tmp_path, "--json")
    assert [json.loads(line)["seed"] for line in out.splitlines()] == [0, 0, 7]


def test_a_long_list_is_printed_as_it_is_read(tmp_path, monkeypatch):
    """The first rows are there before the last are read."""
    from mjrec.commands import terminal

    printed = []
    monkeypatch.setattr(sys, "stdout", SimpleNamespace(write=printed.append))

    def rows():
        for number in range(3000):
            assert len(printed) >= number - 1000
            yield str(number), "a" * (number % 7)

    assert terminal.print_rows(("number", "text"), rows(), left=("text",))
    assert printed[-1] == f"  2999  {'a' * 3}\n"


def test_list_says_that_there_is_nothing(mjrec, tmp_path):
    """Not an empty table, and no error: a run may not have come to an end yet."""
    status, out, _ = mjrec("list", tmp_path)
    assert (status, out) == (0, f"No episodes are recorded in {tmp_path}.\n")
    assert mjrec("list", tmp_path, "--json")[:2] == (0, "")
    status, _, err = mjrec("list", tmp_path / "nothing")
    assert status == 1
    assert "nothing" in err


@pytest.mark.thorough
def test_reader_may_leave_early(mjrec, tmp_path):
    """Whoever reads the list may have left: nothing is said on stderr."""
    mjrec(*CHEETAH, "--out", tmp_path, "--seed", 0, "--schedule", "none")
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "mjrec", "list", str(tmp_path), "--json"],
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    os.close(writer)
    assert done.stderr == ""


@pytest.mark.parametrize("command", COMMANDS)
def test_help_flows(mjrec, capsys, command):
    """Every command says what it does; descriptions break only at the margin."""
    with pytest.raises(SystemExit) as left:
        mjrec(command, "--help")
    assert left.value.code == 0
    out = capsys.readouterr().out
    assert f"usage: mjrec {command}" in out
    words = " ".join(out.replace("│", " ").split())
    assert command != "record" or "By default the environment's limit, or 1000" in words


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
    status, _, err = mjrec("record", "unstable.xml", "--out", "b", *policy)
    assert status == 1
    assert err.count('crash_policy.py", line 2, in crash') == 1
    status, _, err = mjrec(
        *("evaluate", "Hopper-v5", "CartPole-v1", "--out", "c", "--keep", "none"),
        *("--episodes", 2, "--num-seeds", 2, "--workers", 2, *policy),
    )
    assert status == 1
    assert err.count('crash_policy.py", line 2, in crash') == 1


def _start(tmp_path, **streams):
    return subprocess.Popen(
        [
            *(sys.executable, "-m", "mjrec", "record", "HalfCheetah-v5"),
            *("--out", str(tmp_path), "--size", "64x48", "--seed", "0"),
            *("--episodes", "10000", "--max-steps", "20"),
        ],
        **streams,
    )


# Takes more than five seconds: a command is interrupted, and what it left is drawn.
@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_keeps_everything_so_far(tmp_path):
    """Status 130; episodes and manifest are whole, and videos can be made of them."""
    process = _start(tmp_path, stdout=subprocess.PIPE)
    assert b"episode 0" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert b"Interrupted" in out
    results = load_results(tmp_path)
    assert results["episode_lengths"]
    assert set(results["episode_lengths"]) == {20}
    if not videos_in(tmp_path):
        assert f"pending: mjrec render {tmp_path}".encode() in out
    assert main(["render", str(tmp_path), "--workers", "1"]) == 0
    assert len(frames_in(tmp_path, 0)) == 21
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


@pytest.mark.usefixtures("default_signals")
@parametrize(("signum", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_being_told_to_end_keeps_everything_so_far(signum, status, tmp_path):
    """As a scheduler does at a time limit: files are closed, the rest is said."""
    process = _start(tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert b"episode 0" in process.stdout.readline()
    process.send_signal(signum)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == status
    assert b"Traceback" not in errors
    results = load_results(tmp_path)
    assert set(results["episode_lengths"]) == {20}
    if not videos_in(tmp_path):
        assert f"pending: mjrec render {tmp_path}".encode() in errors


@pytest.mark.usefixtures("default_signals")
def test_terminal_shows_a_bar(tmp_path):
    """On a terminal there is a progress bar with episodes and steps."""
    reader, terminal = pty.openpty()
    process = _start(tmp_path, stdout=terminal, stderr=terminal)
    os.close(terminal)
    shown = b""
    while b"1/10000 episodes" not in shown:
        shown += os.read(reader, 65536)
    process.send_signal(signal.SIGINT)
    while True:
        try:
            shown += os.read(reader, 65536)
        except OSError:  # Linux says so when the other end is closed.
            break
    assert process.wait(60) == 130
    os.close(reader)
    assert b"steps" in shown
    assert b"HalfCheetah-v5" in shown
