# SPDX-License-Identifier: Apache-2.0
"""What a report shows is gathered from directories of every kind."""

import json
import os
import re
import shlex
import shutil
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from parts import parametrize

import mjrec
from evaluations import write_evaluation, write_recorded
from mjrec.commands import main
from mjrec.errors import InvalidArgument, UnreadableFile
from mjrec.evaluation.evaluation import read_results
from mjrec.evaluation.summaries import AcrossTasks
from mjrec.formats.monitor_directory import infix_of
from mjrec.recorder.keep_rules import keep_rule
from mjrec.reporting.contents import end_times, episodes_with_roles, outcomes
from mjrec.reporting.gathering import gather
from report_recordings import GYM, entry, record, write_journal


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Two recorded episodes of six steps, with two cameras, whose states are there."""
    directory = tmp_path_factory.mktemp("my recordings")
    size = {"width": 64, "height": 48, "max_episode_steps": 6}
    env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array", **size)
    record(env, directory, 2, camera=[None, "track"])
    return directory


# --- Monitor directories ----------------------------------------------------------


# Takes more than five seconds: its fixture records what all tests of the file read.
def test_a_monitor_directory_is_one_task(recorded):
    """Episodes in the order of time, and videos with what their metadata say."""
    contents = gather(recorded)
    [task] = contents.tasks
    assert (task.name, task.source) == ("HalfCheetah-v5", str(recorded))
    assert not task.is_evaluation
    assert task.summary.episodes == 2
    assert task.episodes[["length", "truncated"]].tolist() == [(6, 1), (6, 1)]
    assert contents.title == "Recordings: HalfCheetah-v5"
    assert contents.problems == []
    assert [video.index for video in task.videos] == [0, 0, 1, 1]
    first, further, *_ = task.videos
    assert (first.height, first.width) == (48, 64)
    assert first.seconds == pytest.approx(7 * 0.05)
    assert first.path.is_file()
    assert further.camera == "track"
    assert {*first.roles} <= {"best", "median", "worst"}


@parametrize("number", [0, 1])
def test_the_command_renders_a_video_again(recorded, number, tmp_path, monkeypatch):
    """As it stands there, for the first camera and a further one; the same pixels."""
    monkeypatch.chdir(tmp_path)
    video = gather(recorded).videos[number]
    words = shlex.split(video.command)
    assert words[0] == "mjrec"
    assert main(words[1:]) == 0
    decoded = json.loads(Path("again.meta.json").read_text())["decoded_sha256"]
    metadata = video.path.with_suffix(".meta.json")
    assert decoded == json.loads(metadata.read_text())["decoded_sha256"]


@pytest.mark.parametrize("version", sorted(p.name for p in GYM.iterdir() if p.is_dir()))
def test_recordings_of_every_gym_are_gathered(version):
    """Each directory is found one level below, with all episodes and text videos."""
    tasks = {Path(task.source).name: task for task in gather(GYM / version).tasks}
    assert tasks.keys() == {p.name for p in (GYM / version).iterdir()}
    assert tasks["two_monitors"].summary.runs == 2
    for name, task in tasks.items():
        results = mjrec.load_results(GYM / version / name)
        assert task.episodes["length"].tolist() == results["episode_lengths"]
        if name == "text":
            assert [video.path.suffix for video in task.videos] == [".json"] * 2


def test_episodes_of_several_monitors_are_in_the_order_of_time(tmp_path):
    """What has no time comes last; what is not known of success stays unknown."""
    early = [entry(0, end_time=3.0e9, success=True), entry(1)]
    late = [entry(0, end_time=2.0e9, success=False), entry(1, end_time=np.nan)]
    write_journal(tmp_path, "0.a", "X-v0", early)
    write_journal(tmp_path, "1.b", "X-v0", late)
    [task] = gather(tmp_path).tasks
    shown = task.episodes[["seed", "episode", "success"]].tolist()
    assert shown == [(0, 1, -1), (1, 0, 0), (0, 0, 1), (1, 1, -1)]
    assert task.runs == ["0.a", "1.b"]
    summary = task.summary
    assert (summary.runs, summary.success_known, summary.success_rate) == (2, 2, 0.5)


def test_several_environments_are_tasks_of_their_own(tmp_path):
    """In one directory, which is told, and in several, by the directory's name."""
    a, b = tmp_path / "a", tmp_path / "b"
    write_journal(a, "0.a", "X-v0", [entry(0)])
    write_journal(a, "1.a", "Y-v0", [entry(0), entry(1)])
    write_journal(b, "0.x", "X-v0", [entry(0)])
    # One that is given twice counts once.
    contents = gather([a, b, b / "."])
    tasks = [(task.name, task.summary.episodes) for task in contents.tasks]
    assert tasks == [(f"X-v0 ({a})", 1), ("Y-v0", 2), (f"X-v0 ({b})", 1)]
    [problem] = contents.problems
    assert "2 environments, X-v0, Y-v0" in problem
    assert contents.title == "Recordings: 3 tasks"


def test_a_damaged_file_is_named_and_the_rest_shown(tmp_path):
    """A whole file, and a line of a journal, which is otherwise only in the log."""
    path = write_journal(tmp_path, "0.a", "X-v0", [entry(0), entry(1)])
    with path.open("a") as file:
        file.write('{"episode_id": 2, "len\n')
    (tmp_path / "openaigym.manifest.1.b.manifest.json").write_text("{")
    contents = gather(tmp_path)
    assert [(task.name, len(task.episodes)) for task in contents.tasks] == [("X-v0", 2)]
    problems = "\n".join(contents.problems)
    assert "openaigym.manifest.1.b" in problems
    assert "line 4 (episode 2)" in problems


@pytest.mark.parametrize("there", ["link", "pipe"])
def test_what_stands_in_the_place_of_a_video_is_left_out(corridor, tmp_path, there):
    """A link could put any file of the reader into a report; a pipe never ends."""
    directory = tmp_path / "run"
    record(corridor, directory, 1)
    # What was drawn live cannot be rendered again, and that is said.
    [shown] = gather(directory).videos
    assert shown.command is None
    assert any("live" in note for note in shown.notes)
    [video] = directory.glob("*.mp4")
    shutil.move(video, tmp_path / "secret.mp4")
    if there == "link":
        video.symlink_to(tmp_path / "secret.mp4")
    else:
        os.mkfifo(video)
    contents = gather(directory)
    assert contents.videos == []
    [problem] = contents.problems
    assert video.name in problem


@pytest.mark.parametrize(
    "metadata",
    [
        {"fps": 7, "frame_count": "x", "height": -1, "width": 1e300},
        {"fps": "0", "frame_count": 3, "camera": {"azimuth": []}, "file_sha256": 5},
        {"camera": ["a", {"type": 3}, None], "selection": {"rule": 1}},
        {"complete": False, "reason": 7, "playback_speed": "fast", "first_step": "x"},
        {"selection": {"rule": "best:1", "decided": True, "finished": "many"}},
    ],
)
def test_metadata_may_say_anything(corridor, tmp_path, metadata):
    """What is nonsense is not known; the video is shown."""
    record(corridor, tmp_path, 1)
    [path] = tmp_path.glob("*.meta.json")
    path.write_text(json.dumps(metadata))
    [video] = gather(tmp_path).videos
    assert (video.seconds, video.height) == (None, None)


# --- Evaluations ------------------------------------------------------------------


def test_an_evaluation_has_its_results(tmp_path):
    """Its summaries are those of its file, its episodes in the plan's order."""
    write_recorded(tmp_path / "e", ["a/x", "b/y"])
    write_journal(tmp_path / "m", "0.a", "X-v0", [entry(i) for i in range(20)])
    contents = gather([tmp_path / "e", tmp_path / "m"])
    assert [task.name for task in contents.tasks] == ["a/x", "b/y", "X-v0"]
    task = contents.tasks[0]
    assert task.is_evaluation
    assert task.episodes["seed"].tolist() == [0, 0, 7, 7]
    assert task.episodes["success"].tolist() == [1, 0, -1, 0]
    assert outcomes(task).tolist() == [2, 2, 4, 2]
    assert task.failures == {2: "PolicyError: it gave <b>NaN</b>"}
    assert end_times(task.episodes)[1] == 1.79e9 + 2
    assert (task.summary.episodes, task.summary.failed) == (3, 1)
    assert ("Seeds", "0, 7") in task.provenance
    assert ("Versions", "mjrec 9.9, MuJoCo 8.8") in task.provenance
    # One sentence about intervals is true of the whole page.
    assert (contents.bootstrap.seed, contents.bootstrap.resamples) == (3, 100)
    [alone] = gather(tmp_path / "m").tasks
    assert contents.tasks[-1].summary.mean_interval != alone.summary.mean_interval


def test_what_was_evaluated_is_told(tmp_path):
    """The policy with its arguments; scores only where a task has a scale."""
    write_evaluation(
        *(tmp_path / "a", {"a/x": [[1.0]]}),
        policy="mine:Policy",
        policy_kwargs={"gain": 2.5, "net": "small"},
        across=AcrossTasks(tasks=(), left_out={"a/x": "no scale"}),
    )
    scores = AcrossTasks(tasks=("b/y",))
    write_evaluation(tmp_path / "b", {"b/y": [[1.0]]}, across=scores)
    contents = gather([tmp_path / "a", tmp_path / "b"])
    policy = "mine:Policy, gain=2.5, net='small'"
    assert ("Policy", policy) in contents.tasks[0].provenance
    assert contents.across == {str(tmp_path / "b"): scores}


def test_videos_of_an_evaluation_know_their_episode(corridor, tmp_path):
    """By monitor and number; the best of the task is called so."""
    record(corridor, tmp_path / "a-x", 1, uid="batch")
    [journal] = (tmp_path / "a-x").glob("*.jsonl")
    journal.unlink()
    [path] = (tmp_path / "a-x").glob("*.mp4")
    infix = infix_of(path.name)
    write_recorded(tmp_path, ["a/x"], videos={"a/x": path.name}, monitor=infix)
    contents = gather(tmp_path)
    [video] = contents.videos
    assert (video.index, video.roles) == (0, ("best",))
    assert contents.problems == []


def test_problems_of_evaluations_are_told(tmp_path):
    """Pending videos with the command for them, and intervals made in another way."""
    name = "openaigym.video.0.batch.video000000.mp4"
    write_recorded(tmp_path / "a", ["a/x"], videos={"a/x": name})
    write_evaluation(tmp_path / "b", {"b/y": [[1.0, 2.0]]}, monitor="0.batch")
    pending, computed = gather([tmp_path / "a", tmp_path / "b"]).problems
    assert "1 of 1 videos of a/x are missing" in pending
    assert f"mjrec render {tmp_path / 'a' / 'a-x'}" in pending
    assert "differently: 10 resamples with seed 0, confidence 0.95." in computed


@pytest.mark.parametrize(
    ("broken", "content", "told"),
    [
        (None, None, "not finished"),
        ("results.json", '{"format_version": 1', "results.json"),
        ("results.csv", "no table", "results.csv"),
    ],
)
def test_an_evaluation_without_results_is_shown_by_its_monitors(
    tmp_path, broken, content, told
):
    """Whether it is not finished or a file is damaged, which is said."""
    write_recorded(tmp_path, ["a/x", "b/y"], finished=broken is not None)
    if broken:
        (tmp_path / broken).write_text(content)
    contents = gather(tmp_path)
    tasks = [(task.name, task.is_evaluation) for task in contents.tasks]
    assert tasks == [("a/x", False), ("b/y", False)]
    assert contents.tasks[0].episodes["total_reward"].tolist() == [3.0, 1.0, 2.0]
    [problem] = contents.problems
    assert told in problem
    assert "The recordings of its monitors are shown instead." in problem


# --- Roles and verdicts -----------------------------------------------------------


@pytest.mark.parametrize(
    "rewards",
    [
        (2.0, 5.0, 5.0, 1.0, 1.0, 2.0),
        *((5.0, 5.0), (9.0, None, 1.0, 2.0), (np.nan, -np.inf, 0.0, 1.0)),
    ],
)
def test_roles_are_those_of_an_evaluation(tmp_path, rewards):
    """The rule that chose the videos and the page call the same episodes the best."""
    write_recorded(tmp_path, ["a/x"], rewards=rewards)
    results = list(read_results(tmp_path))
    expected = {}
    for result, role in keep_rule("best,median,worst").choose(results):
        index = results.index(result)
        expected[index] = (*expected.get(index, ()), role)
    assert expected
    assert episodes_with_roles(gather(tmp_path).tasks[0]) == expected


def verdict(outcome, **said):
    """Return the text of a verification with one finding."""
    known = {"path": "run", "level": "physics", "findings": [{"outcome": outcome}]}
    return json.dumps({**known, **said})


def test_verdicts_are_found_and_given(tmp_path):
    """In the directory, and as a file; what is only noted does not count."""
    write_journal(tmp_path / "run", "0.a", "X-v0", [entry(0)])
    found, given = tmp_path / "run" / "verification.json", tmp_path / "other.json"
    outcomes = [{"outcome": each} for each in ("recreated", "believed", "noted")]
    found.write_text(verdict("", verdict="PARTLY", findings=outcomes))
    given.write_text(verdict("different", verdict="FAIL"))
    contents = gather(tmp_path / "run", verifications=[given])
    assert [each.verdict for each in contents.verdicts] == ["PARTLY", "FAIL"]
    assert contents.verdicts[0].counts == {"recreated": 1, "believed": 1}
    assert contents.verdicts[0].level == "physics"


@pytest.mark.parametrize(
    "text",
    [
        *("no JSON", "{}"),
        verdict("different", verdict="PASS"),
        verdict("recreated", verdict="PASS", level="all"),
    ],
)
def test_a_verdict_that_is_none_is_not_shown(tmp_path, text):
    """One that contradicts itself neither; a file that was given is an error."""
    write_journal(tmp_path, "0.a", "X-v0", [entry(0)])
    path = tmp_path / "verification.json"
    path.write_text(text)
    contents = gather(tmp_path)
    assert contents.verdicts == []
    assert "verification.json" in contents.problems[0]
    with pytest.raises(UnreadableFile, match=r"verification\.json"):
        gather(tmp_path, verifications=[path])


def test_a_directory_without_recordings_is_an_error(tmp_path):
    """It is named, with what to do; so is one that is not there, or a file."""
    (tmp_path / "deep" / "deeper").mkdir(parents=True)
    write_journal(tmp_path / "deep" / "deeper", "0.a", "X-v0", [entry(0)])
    named = tmp_path / "my runs; $(x)"
    named.mkdir()
    for given, words in (
        (tmp_path, "contains no recordings"),
        (named, re.escape(f"--out {shlex.quote(str(named))}`")),
        (tmp_path / "nowhere", "does not exist"),
        (__file__, "is a file"),
        ([], "at least one directory"),
    ):
        with pytest.raises(InvalidArgument, match=words):
            gather(given)
