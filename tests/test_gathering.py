# SPDX-License-Identifier: Apache-2.0
"""Test that reports gather their contents from recordings and evaluations."""

import json
import os
import re
import shlex
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from parts import parametrize

import mjrec
from evaluations import write_evaluation, write_recorded
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
    """Return a recording of two six-step episodes with two cameras."""
    directory = tmp_path_factory.mktemp("my recordings")
    size = {"width": 64, "height": 48, "max_episode_steps": 6}
    env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array", **size)
    record(env, directory, 2, camera=[None, "track"])
    return directory


# Takes more than five seconds: the fixture records for all tests in this file.
def test_monitor_directory_is_one_task_with_its_videos(recorded):
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
def test_video_command_renders_again(recorded, number, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    video = gather(recorded).videos[number]
    program, *arguments = shlex.split(video.command)
    assert program == "mjrec"
    command(*arguments)
    paths = (Path("again.meta.json"), video.path.with_suffix(".meta.json"))
    again, first = (json.loads(path.read_text())["decoded_sha256"] for path in paths)
    assert again == first


@pytest.mark.parametrize("version", sorted(p.name for p in GYM.iterdir() if p.is_dir()))
def test_gathers_recordings_of_every_gym_version(version):
    """`gather` also finds directories one level down and videos in text form."""
    tasks = {Path(task.source).name: task for task in gather(GYM / version).tasks}
    assert tasks.keys() == {p.name for p in (GYM / version).iterdir()}
    assert tasks["two_monitors"].summary.runs == 2
    for name, task in tasks.items():
        results = mjrec.load_results(GYM / version / name)
        assert task.episodes["length"].tolist() == results["episode_lengths"]
        if name == "text":
            assert [video.path.suffix for video in task.videos] == [".json"] * 2


def test_episodes_of_several_monitors_are_sorted_by_time(tmp_path):
    """An episode with an unknown time comes last, and unknown success stays unknown."""
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


def test_each_environment_of_each_directory_is_a_task(tmp_path):
    """A directory with several environments is reported as a problem."""
    a, b = tmp_path / "a", tmp_path / "b"
    write_journal(a, "0.a", "X-v0", [entry(0)])
    write_journal(a, "1.a", "Y-v0", [entry(0), entry(1)])
    write_journal(b, "0.x", "X-v0", [entry(0)])
    # A directory that is given twice counts only once.
    contents = gather([a, b, b / "."])
    tasks = [(task.name, task.summary.episodes) for task in contents.tasks]
    assert tasks == [(f"X-v0 ({a})", 1), ("Y-v0", 2), (f"X-v0 ({b})", 1)]
    [problem] = contents.problems
    assert "2 environments, X-v0, Y-v0" in problem
    assert contents.title == "Recordings: 3 tasks"


def test_damaged_files_are_problems_and_the_rest_is_shown(tmp_path):
    path = write_journal(tmp_path, "0.a", "X-v0", [entry(0), entry(1)])
    path.write_text(path.read_text() + '{"episode_id": 2, "len\n')
    (tmp_path / "openaigym.manifest.1.b.manifest.json").write_text("{")
    contents = gather(tmp_path)
    assert [(task.name, len(task.episodes)) for task in contents.tasks] == [("X-v0", 2)]
    problems = "\n".join(contents.problems)
    assert "openaigym.manifest.1.b" in problems
    assert "line 4 (episode 2)" in problems


@pytest.mark.parametrize("there", ["link", "pipe"])
def test_links_and_pipes_in_place_of_videos_are_omitted(corridor, tmp_path, there):
    """A link could make a report include any file that its reader can access."""
    directory = tmp_path / "run"
    record(corridor, directory, 1)
    # There is no command that renders a live video again.
    [shown] = gather(directory).videos
    assert shown.command is None
    assert any("live" in note for note in shown.notes)
    [video] = directory.glob("*.mp4")
    secret = video.rename(tmp_path / "secret.mp4")
    if there == "link":
        video.symlink_to(secret)
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
def test_invalid_metadata_does_not_hide_the_video(corridor, tmp_path, metadata):
    record(corridor, tmp_path, 1)
    [path] = tmp_path.glob("*.meta.json")
    path.write_text(json.dumps(metadata))
    [video] = gather(tmp_path).videos
    assert (video.seconds, video.height) == (None, None)


def test_evaluation_has_the_results_of_its_files(tmp_path):
    """Summaries are read from the file, and episodes keep the order of the plan."""
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
    # All intervals on a page use the same bootstrap.
    assert (contents.bootstrap.seed, contents.bootstrap.resamples) == (3, 100)
    [alone] = gather(tmp_path / "m").tasks
    assert contents.tasks[-1].summary.mean_interval != alone.summary.mean_interval


def test_policies_with_arguments_and_scores_are_shown(tmp_path):
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


def test_videos_of_an_evaluation_belong_to_episodes_and_roles(corridor, tmp_path):
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


def test_pending_videos_and_differing_intervals_are_problems(tmp_path):
    name = "openaigym.video.0.batch.video000000.mp4"
    write_recorded(tmp_path / "a", ["a/x"], videos={"a/x": name})
    write_evaluation(tmp_path / "b", {"b/y": [[1.0, 2.0]]}, monitor="0.batch")
    pending, computed = gather([tmp_path / "a", tmp_path / "b"]).problems
    assert "1 of 1 videos of a/x are missing" in pending
    assert f"mjrec render {tmp_path / 'a' / 'a-x'}" in pending
    assert "differently: 10 resamples with seed 0, confidence 0.95." in computed


@pytest.mark.parametrize(
    ("broken", "content", "reason"),
    [
        (None, None, "not finished"),
        ("results.json", '{"format_version": 1', "results.json"),
        ("results.csv", "no table", "results.csv"),
    ],
)
def test_evaluation_without_results_shows_monitors(tmp_path, broken, content, reason):
    write_recorded(tmp_path, ["a/x", "b/y"], finished=broken is not None)
    if broken:
        (tmp_path / broken).write_text(content)
    contents = gather(tmp_path)
    tasks = [(task.name, task.is_evaluation) for task in contents.tasks]
    assert tasks == [("a/x", False), ("b/y", False)]
    assert contents.tasks[0].episodes["total_reward"].tolist() == [3.0, 1.0, 2.0]
    [problem] = contents.problems
    assert reason in problem
    assert "The recordings of its monitors are shown instead." in problem


@pytest.mark.parametrize(
    "rewards",
    [(2, 5, 5, 1, 1, 2), (5.0, 5.0), (9, None, 1, 2), (np.nan, -np.inf, 0.0, 1.0)],
)
def test_roles_are_those_of_the_selection_rule(tmp_path, rewards):
    write_recorded(tmp_path, ["a/x"], rewards=rewards)
    results = list(read_results(tmp_path))
    expected = {}
    for result, role in keep_rule("best,median,worst").choose(results):
        index = results.index(result)
        expected[index] = (*expected.get(index, ()), role)
    assert expected
    assert episodes_with_roles(gather(tmp_path).tasks[0]) == expected


def verdict(outcome, **fields):
    """Return the JSON text of a verification with one finding."""
    known = {"path": "run", "level": "physics", "findings": [{"outcome": outcome}]}
    return json.dumps({**known, **fields})


def test_verdicts_come_from_the_directory_and_from_given_files(tmp_path):
    """Findings with the outcome `noted` are not counted."""
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
def test_invalid_verdicts_are_problems(tmp_path, text):
    """An invalid file is a problem if found in a directory, and an error if passed."""
    write_journal(tmp_path, "0.a", "X-v0", [entry(0)])
    path = tmp_path / "verification.json"
    path.write_text(text)
    contents = gather(tmp_path)
    assert contents.verdicts == []
    assert "verification.json" in contents.problems[0]
    with pytest.raises(UnreadableFile, match=r"verification\.json"):
        gather(tmp_path, verifications=[path])


def test_directories_without_recordings_are_errors(tmp_path):
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
