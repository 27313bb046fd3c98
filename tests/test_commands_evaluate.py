# SPDX-License-Identifier: Apache-2.0
import json
import sys
from pathlib import Path

import pytest

import mjrec
from mjrec import commands

TASK = "InvertedPendulum-v5"
POLICIES = """
import numpy as np

def zero(observation):
    return np.zeros(1)

def raising(observation):
    raise RuntimeError("[red]no idea[/]" + chr(27) + "[2J")
"""


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Return a function that runs the command, and gives status, output and errors."""
    (tmp_path / "few_policies.py").write_text(POLICIES)
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        small = ["--episodes", "2", "--num-seeds", "1", "--max-steps", "5"]
        rest = ["--size", "32x32", "--workers", "1", "--out", "e"]
        status = commands.main(["evaluate", *arguments, *small, *rest])
        return status, *capsys.readouterr()

    return run


def test_table_has_a_row_for_each_task(run, tmp_path):
    """Videos and directory are named below it."""
    policy = ("--policy", "few_policies:zero", "--keep", "best")
    status, out, err = run(TASK, *policy, "--confidence", "0.9")
    assert status == 0
    [header] = [line for line in out.splitlines() if line.lstrip().startswith("task ")]
    [row] = [line for line in out.splitlines() if line.lstrip().startswith(TASK)]
    assert " 90% " in header
    assert row.split()[:3] == [TASK, "2", "5"]
    assert "1 video:" in out
    assert str(tmp_path / "e") in out
    assert "2/2 episodes" in err
    # The workers record the command that started them.
    manifest = next((tmp_path / "e").rglob("*.manifest.json"))
    provenance = json.loads(manifest.read_text())["mjrec"]["provenance"]
    assert provenance["command"] == sys.orig_argv


def test_tasks_with_a_scale_are_summarized_together(run):
    """Other tasks are named with the reason."""
    double = "InvertedDoublePendulum-v5"
    ranges = (f"{TASK}=0:10", "--score-range", f"{double}=0:100")
    tasks = (TASK, double, "Hopper-v5", "--policy", "zero", "--keep", "none")
    status, out, _ = run(*tasks, "--score-range", *ranges)
    assert status == 0
    assert "Over 2 tasks, as scores from 0 to 1: IQM" in out
    assert "left out: Hopper-v5: it has no default scale" in out


def test_json_output_is_one_object(run):
    """A mean equal to `--fail-under` is no failure."""
    policy = ("--policy", "zero", "--keep", "none", "--json")
    least = ("--score-range", f"{TASK}=0:10", "--fail-under", f"{TASK}=5")
    status, out, err = run(TASK, *policy, *least)
    content = json.loads(out)
    assert (status, err) == (0, "")
    [task] = content["tasks"]
    assert task["mean"] == 5.0
    assert content["across"]["iqm"] == 0.5
    assert (content["episodes"], content["failed"]) == (2, 0)


def test_failed_episodes_fail_the_command(run, tmp_path):
    """Results are written, and control characters of messages are escaped."""
    policy = ("--policy", "few_policies:raising", "--keep", "none")
    status, out, _ = run(TASK, *policy, "--fail-under", f"{TASK}=-1000")
    assert status == 1
    assert "2 of 2 episodes failed:" in out
    assert "[red]no idea[/]" in out
    assert "\x1b[2J" not in out
    assert f"{TASK} falls short: 2 episodes failed." in out
    assert (tmp_path / "e" / "results.json").exists()


def test_resume_needs_only_the_directory(run, capsys):
    """Best, median and worst episodes are named with their files."""
    low = ("--fail-under", f"{TASK}=5.5")
    status, out, _ = run(TASK, "--policy", "zero", "--keep", "none", *low)
    assert status == 1
    assert "its mean return 5 is below 5.5" in out
    more = ["--seeds", "0-2", "--workers", "1", "--fail-under", "Inverted*=5"]
    assert commands.main(["evaluate", "--resume", "e", *more]) == 0
    out = capsys.readouterr().out
    assert out.split()[out.split().index(TASK) + 1] == "6"
    [worst] = [line for line in out.splitlines() if line.startswith("  worst")]
    assert len(mjrec.load_trajectory(Path(worst.split()[-1]))) > 0
    assert commands.main(["evaluate", "--resume", "e", "--seeds", "0-1"]) == 1
    assert "seeds was [0, 1, 2]" in capsys.readouterr().err


def test_evaluation_is_rendered_and_recovered_as_one(
    run, tmp_path, monkeypatch, capsys
):
    """Without OpenGL, a message says how to render elsewhere."""
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.delenv("DISPLAY", raising=False)
    status, out, err = run(TASK, "--policy", "zero", "--keep", "all")
    assert status == 0
    directory = tmp_path / "e"
    assert "Videos cannot be drawn on this machine" in err
    assert f"mjrec render e/{TASK}" in out
    monkeypatch.setenv("MUJOCO_GL", "egl")
    table = (directory / "timing.csv").read_text()
    rows = [row.split(",") for row in table.splitlines()[1:]]
    paths = [directory / row[5] / row[-1] for row in rows]
    assert not list(directory.rglob("*.mp4"))
    assert commands.main(["render", "e", "--episode", "1"]) == 0
    assert [path.is_file() for path in paths] == [False, True]
    assert commands.main(["render", "e", "--episode", "9"]) == 1
    assert "No episode 9 is recorded" in capsys.readouterr().err
    assert commands.main(["render", "e"]) == 0
    assert all(path.is_file() for path in paths)
    assert (directory / "timing.csv").read_text() == table
    capsys.readouterr()
    [manifest, *_] = directory.rglob("*.manifest.json")
    manifest.unlink()
    assert commands.main(["recover", "e"]) == 0
    assert f"{manifest.parent.relative_to(directory)}" in capsys.readouterr().out
    assert manifest.is_file()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["NoSuch-v0"], "no Gymnasium environment 'NoSuch-v0'"),
        ([TASK, "--fail-under", "Ant-v5=3"], "'Ant-v5'"),
        ([TASK, "--fail-under", f"{TASK}=nan"], "TASK=VALUE"),
        ([TASK, "--score-range", f"{TASK}=3"], "TASK=LOW:HIGH"),
        ([TASK, "--seeds", "0,x"], "0,1,2"),
    ],
)
def test_wrong_command_line_gives_one_line_and_runs_nothing(
    run, tmp_path, arguments, words
):
    status, out, err = run(*arguments, "--policy", "zero")
    lines = [line for line in err.splitlines() if line.startswith("mjrec: ")]
    assert (status, out, len(lines)) == (1, "", 1)
    assert words in err
    assert "Traceback" not in err
    assert not (tmp_path / "e").exists()


def test_ctrl_c_says_how_to_continue(run, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("mjrec.commands.evaluate.evaluate_policy", interrupted)
    status, _, err = run(TASK, "--policy", "zero")
    assert status == 130
    assert "To continue: mjrec evaluate --resume e" in err
