# SPDX-License-Identifier: Apache-2.0
"""What a report shows is gathered from directories of every kind."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from parts import parametrize

import mjrec
from mjrec.commands import main
from mjrec.errors import InvalidArgument, UnreadableFile
from mjrec.formats.monitor_directory import infix_of
from mjrec.reporting.contents import EpisodeColumns
from mjrec.reporting.episode_columns import episodes_with_roles
from mjrec.reporting.gathering import gather
from report_recordings import GYM, entry, record, write_evaluation, write_journal


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two recorded episodes of six steps, with two cameras, whose states are there."""
    directory = tmp_path_factory.mktemp("my recordings")
    env = gymnasium.make(
        "HalfCheetah-v5",
        render_mode="rgb_array",
        width=64,
        height=48,
        max_episode_steps=6,
    )
    record(env, directory, 2, camera=[None, "track"])
    return directory


def columns(*rewards: float, failed: tuple[int, ...] = ()) -> EpisodeColumns:
    count = len(rewards)
    zeros = np.zeros(count, np.int64)
    outcome = np.ones(count, np.uint8)
    outcome[list(failed)] = 4
    return EpisodeColumns(
        run=zeros,
        runs=None,
        episode=np.arange(count),
        total_reward=np.array(rewards),
        length=zeros,
        end_time=np.zeros(count),
        outcome=outcome,
        success=np.zeros(count, np.int8),
    )


# Takes more than five seconds: its fixture records what all tests of the file read.
def test_a_monitor_directory_is_one_task(recorded: Path) -> None:
    """Its episodes stand in the order of time, its videos know theirs."""
    contents = gather(recorded)
    [task] = contents.tasks
    assert (task.name, task.source) == ("HalfCheetah-v5", str(recorded))
    assert not task.is_evaluation
    assert task.summary.episodes == 2
    assert list(task.episodes.length) == [6, 6]
    assert list(task.episodes.outcome) == [2, 2]
    assert contents.title == "Recordings: HalfCheetah-v5"
    assert contents.problems == ()
    assert task.episodes.videos == {0: [0, 1], 1: [2, 3]}


def test_videos_say_what_their_metadata_say(recorded: Path) -> None:
    """Size, seconds, camera and hash, also of a further camera's."""
    first, further, *_ = gather(recorded).videos
    assert (first.height, first.width) == (48, 64)
    assert first.seconds == pytest.approx(7 * 0.05)
    assert first.sha256 is not None
    assert Path(first.file).is_file()
    assert (first.index, further.index) == (0, 0)
    assert further.camera == "track"
    assert {*gather(recorded).videos[0].roles} <= {"best", "median", "worst"}


@parametrize("number", [0, 1])
def test_the_command_renders_a_video_again(
    recorded: Path, number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it stands there, for the first camera and a further one; the same pixels."""
    monkeypatch.chdir(tmp_path)
    video = gather(recorded).videos[number]
    assert video.command is not None
    words = shlex.split(video.command)
    assert words[0] == "mjrec"
    assert main(words[1:]) == 0
    decoded = json.loads(Path("again.meta.json").read_text())["decoded_sha256"]
    metadata = Path(video.file).with_suffix(".meta.json")
    assert decoded == json.loads(metadata.read_text())["decoded_sha256"]


def test_live_videos_have_no_command(corridor: Any, tmp_path: Path) -> None:
    """There is nothing that they could be rendered from, and that is said."""
    record(corridor, tmp_path, 1)
    [video] = gather(tmp_path).videos
    assert video.command is None
    assert any("live" in note for note in video.notes)


@pytest.mark.parametrize("version", sorted(p.name for p in GYM.iterdir() if p.is_dir()))
def test_recordings_of_every_gym_are_gathered(version: str) -> None:
    """Each of its directories is found one level below, with all of its episodes."""
    contents = gather(GYM / version)
    found = {Path(task.source).name: task for task in contents.tasks}
    assert found.keys() == {p.name for p in (GYM / version).iterdir()}
    assert found["two_monitors"].summary.runs == 2
    assert len(found["plain"].episodes.run) == 3
    for name, task in found.items():
        results = mjrec.load_results(GYM / version / name)
        assert results is not None
        assert list(task.episodes.length) == results["episode_lengths"]


def test_text_recordings_are_among_the_videos() -> None:
    """Of gym's, which shows text in a terminal."""
    contents = gather(GYM / "0.22.0" / "text")
    assert [Path(video.file).suffix for video in contents.videos] == [".json"] * 2


def test_episodes_of_several_monitors_are_in_the_order_of_time(tmp_path: Path) -> None:
    """Whichever monitor they are of; what has no time comes last."""
    write_journal(tmp_path, "0.a", "X-v0", [entry(0, end_time=3.0e9), entry(1)])
    write_journal(
        tmp_path, "1.b", "X-v0", [entry(0, end_time=2.0e9), entry(1, end_time=np.nan)]
    )
    [task] = gather(tmp_path).tasks
    assert list(task.episodes.run) == [0, 1, 0, 1]
    assert list(task.episodes.episode) == [1, 0, 0, 1]
    assert task.episodes.runs == ["0.a", "1.b"]
    assert task.summary.runs == 2


def test_what_the_environment_says_of_success_is_known(tmp_path: Path) -> None:
    """Unknown stays unknown."""
    successes = [True, False, None]
    entries = [entry(i, success=said) for i, said in enumerate(successes)]
    write_journal(tmp_path, "0.a", "X-v0", entries)
    [task] = gather(tmp_path).tasks
    assert list(task.episodes.success) == [1, 0, -1]
    assert (task.summary.success_known, task.summary.success_rate) == (2, 0.5)


def test_several_environments_in_a_directory_are_tasks_of_their_own(
    tmp_path: Path,
) -> None:
    """And the report says so."""
    write_journal(tmp_path, "0.a", "X-v0", [entry(0)])
    write_journal(tmp_path, "1.a", "Y-v0", [entry(0), entry(1)])
    contents = gather(tmp_path)
    assert [(t.name, t.summary.episodes) for t in contents.tasks] == [
        ("X-v0", 1),
        ("Y-v0", 2),
    ]
    [problem] = contents.problems
    assert "2 environments, X-v0, Y-v0" in problem


def test_the_same_environment_in_two_directories_is_told_apart(tmp_path: Path) -> None:
    """By the directory; one that is given twice counts once."""
    for name in ("a", "b"):
        write_journal(tmp_path / name, "0.x", "X-v0", [entry(0)])
    contents = gather([tmp_path / "a", tmp_path / "b", tmp_path / "b" / "."])
    assert [t.name for t in contents.tasks] == [
        f"X-v0 ({tmp_path / 'a'})",
        f"X-v0 ({tmp_path / 'b'})",
    ]


def test_the_title_counts_what_the_page_counts(tmp_path: Path) -> None:
    """The same environment in two directories is two tasks."""
    for name, env_id in (("a", "X-v0"), ("b", "X-v0"), ("c", "Y-v0")):
        write_journal(tmp_path / name, "0.x", env_id, [entry(0)])
    assert gather(tmp_path).title == "Recordings: 3 tasks"


def test_a_damaged_file_is_named_and_the_rest_shown(tmp_path: Path) -> None:
    """Of the one monitor there is nothing, of the other everything."""
    write_journal(tmp_path, "0.a", "X-v0", [entry(0)])
    (tmp_path / "openaigym.manifest.1.b.manifest.json").write_text("{")
    contents = gather(tmp_path)
    assert [(task.name, len(task.episodes.run)) for task in contents.tasks] == [
        ("X-v0", 1)
    ]
    assert any("openaigym.manifest.1.b" in problem for problem in contents.problems)


def test_what_readers_leave_out_is_a_problem(tmp_path: Path) -> None:
    """A damaged line of a journal, which is otherwise only in the log."""
    path = write_journal(tmp_path, "0.a", "X-v0", [entry(0), entry(1)])
    with path.open("a") as file:
        file.write('{"episode_id": 2, "len\n')
    contents = gather(tmp_path)
    assert len(contents.tasks[0].episodes.run) == 2
    assert any("line 4 (episode 2)" in problem for problem in contents.problems)


def test_a_video_that_leads_elsewhere_is_left_out(
    corridor: Any, tmp_path: Path
) -> None:
    """A link out of the directory could put any file of the reader into a report."""
    directory = tmp_path / "run"
    record(corridor, directory, 1)
    [video] = directory.glob("*.mp4")
    shutil.move(video, tmp_path / "secret.mp4")
    video.symlink_to(tmp_path / "secret.mp4")
    contents = gather(directory)
    assert contents.videos == []
    assert any("leads out of its directory" in each for each in contents.problems)


def test_a_pipe_in_the_place_of_a_video_is_not_waited_for(
    corridor: Any, tmp_path: Path
) -> None:
    """Its opening would last for ever."""
    record(corridor, tmp_path, 1)
    [video] = tmp_path.glob("*.mp4")
    video.unlink()
    os.mkfifo(video)
    contents = gather(tmp_path)
    assert contents.videos == []
    assert any(video.name in problem for problem in contents.problems)


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
def test_metadata_may_say_anything(
    corridor: Any, tmp_path: Path, metadata: dict[str, Any]
) -> None:
    """What is nonsense is not known; the video is shown."""
    record(corridor, tmp_path, 1)
    [path] = tmp_path.glob("*.meta.json")
    path.write_text(json.dumps(metadata))
    [video] = gather(tmp_path).videos
    assert (video.seconds, video.height) == (None, None)


def test_an_evaluation_has_its_results(tmp_path: Path) -> None:
    """Its summaries are those of its file, its episodes in the plan's order."""
    write_evaluation(tmp_path, ["a/x", "b/y"])
    contents = gather(tmp_path)
    assert [task.name for task in contents.tasks] == ["a/x", "b/y"]
    task = contents.tasks[0]
    assert task.is_evaluation
    assert list(task.episodes.run) == [0, 0, 7, 7]
    assert task.episodes.runs is None
    assert list(task.episodes.outcome) == [2, 2, 4, 2]
    assert list(task.episodes.success) == [1, 0, -1, 0]
    assert task.episodes.failures == {2: "PolicyError: it gave <b>NaN</b>"}
    assert task.episodes.end_time[1] == 1.79e9 + 2
    assert (task.summary.episodes, task.summary.failed) == (3, 1)
    assert contents.bootstrap.seed == 3
    assert contents.across.keys() == {str(tmp_path)}
    assert ("Seeds", "0, 7") in task.provenance
    assert ("Versions", "mjrec 9.9, MuJoCo 8.8") in task.provenance


def test_videos_of_an_evaluation_know_their_episode(
    corridor: Any, tmp_path: Path
) -> None:
    """By monitor and number; the best of the task is called so."""
    record(corridor, tmp_path / "a-x" / "seed-000", 1, uid="batch")
    [journal] = tmp_path.glob("a-x/*/*.jsonl")
    journal.unlink()
    [path] = tmp_path.glob("a-x/*/*.mp4")
    infix = infix_of(path.name)
    assert infix is not None
    write_evaluation(tmp_path, ["a/x"], videos={"a/x": path.name}, infix=infix)
    contents = gather(tmp_path)
    [video] = contents.videos
    assert (video.index, video.roles) == (0, ("best",))
    assert contents.tasks[0].episodes.videos == {0: [0]}
    assert contents.problems == ()


def test_pending_videos_of_an_evaluation_are_told(tmp_path: Path) -> None:
    """With the command that makes them."""
    name = "openaigym.video.0.batch.video000000.mp4"
    write_evaluation(tmp_path, ["a/x"], videos={"a/x": name})
    [problem] = gather(tmp_path).problems
    assert "1 of 1 videos of a/x are not there" in problem
    assert f"mjrec render {tmp_path / 'a-x'}" in problem


def test_an_unfinished_evaluation_is_shown_by_its_monitors(tmp_path: Path) -> None:
    """And the report says that it is not finished."""
    write_evaluation(tmp_path, ["a/x", "b/y"], finished=False)
    contents = gather(tmp_path)
    assert [(t.name, t.is_evaluation) for t in contents.tasks] == [
        ("a/x", False),
        ("b/y", False),
    ]
    assert "not finished" in contents.problems[0]


def test_a_damaged_results_file_is_named_and_the_rest_shown(tmp_path: Path) -> None:
    """What the monitors recorded is there all the same."""
    write_evaluation(tmp_path, ["a/x"])
    (tmp_path / "results.json").write_text('{"format_version": 1')
    contents = gather(tmp_path)
    assert len(contents.tasks[0].episodes.run) == 3
    assert "results.json" in contents.problems[0]


def test_a_damaged_table_takes_no_figures_away(tmp_path: Path) -> None:
    """The summaries say how many failed; that the list does not hold them is told."""
    write_evaluation(tmp_path, ["a/x", "b/y"])
    (tmp_path / "results.csv").write_text("no table")
    contents = gather(tmp_path)
    summary = contents.tasks[0].summary
    assert (summary.episodes, summary.failed, summary.runs) == (3, 1, 2)
    assert list(contents.tasks[0].episodes.total_reward) == [3.0, 1.0, 2.0]
    assert contents.across.keys() == {str(tmp_path)}
    [problem] = contents.problems
    assert "results.csv" in problem
    assert "episodes that failed are not in it" in problem


@pytest.mark.parametrize("there", [None, "pipe", "folder"])
def test_videos_are_shown_without_the_table_of_their_files(
    corridor: Any, tmp_path: Path, there: str | None
) -> None:
    """That it is missing, or is none, is told; no pipe is waited for."""
    record(corridor, tmp_path / "a-x" / "seed-000", 1, uid="batch")
    [video] = tmp_path.glob("a-x/*/*.mp4")
    infix = infix_of(video.name)
    assert infix is not None
    write_evaluation(tmp_path, ["a/x"], videos={"a/x": video.name}, infix=infix)
    timing = tmp_path / "timing.csv"
    timing.unlink()
    if there == "pipe":
        os.mkfifo(timing)
    elif there == "folder":
        timing.mkdir()
    contents = gather(tmp_path)
    assert [Path(shown.file).name for shown in contents.videos] == [video.name]
    assert contents.tasks[0].summary.failed == 1
    assert any("timing.csv" in problem for problem in contents.problems)


@pytest.mark.parametrize(
    ("changed", "about"),
    [
        ("a/x,0,1,1.5,", ["the smallest return", "the mean return"]),
        ("a/x,0,1,2.5,", ["the smallest return", "the mean return"]),
        ("a/x,0,1,9.0,", ["the smallest", "the largest return", "the mean return"]),
        ("a/x,0,1,nan,", ["how many returns are finite"]),
    ],
)
def test_a_changed_return_is_told(
    tmp_path: Path, changed: str, about: list[str]
) -> None:
    """The table and the summary of its task do not agree then."""
    write_evaluation(tmp_path, ["a/x", "b/y"])
    assert gather(tmp_path).problems == ()
    table = tmp_path / "results.csv"
    text = table.read_text()
    assert "a/x,0,1,1.0," in text
    table.write_text(text.replace("a/x,0,1,1.0,", changed))
    [problem] = gather(tmp_path).problems
    assert "a/x" in problem
    assert "results.json and results.csv disagree" in problem
    assert all(words in problem for words in about)


def test_a_changed_outcome_is_told(tmp_path: Path) -> None:
    """A failed episode that has got a return; a return in the middle of others."""
    write_evaluation(tmp_path, ["a/x"])
    table = tmp_path / "results.csv"
    text = table.read_text()
    row = next(line for line in text.splitlines() if "PolicyError" in line)
    table.write_text(text.replace(row, "a/x,7,0,2.5,10,false,true,,"))
    [problem] = gather(tmp_path).problems
    assert "the number of episodes, how many failed, the mean return" in problem
    table.write_text(text.replace("a/x,7,1,2.0,", "a/x,7,1,2.001,"))
    [problem] = gather(tmp_path).problems
    assert "disagree about the mean return." in problem


def test_intervals_of_monitors_are_made_as_the_evaluation_made_its_own(
    tmp_path: Path,
) -> None:
    """So that one sentence is true of the whole page; where it is not, that is said."""
    write_evaluation(tmp_path / "e", ["a/x"])
    entries = [entry(i) for i in range(20)]
    write_journal(tmp_path / "m", "0.a", "X-v0", entries)
    alone, beside = gather(tmp_path / "m"), gather([tmp_path / "e", tmp_path / "m"])
    assert beside.bootstrap.resamples == 100
    intervals = [c.tasks[-1].summary.mean_interval for c in (alone, beside)]
    assert intervals[0] != intervals[1]


@pytest.mark.parametrize(
    ("rewards", "failed", "roles"),
    [
        ((1.0, 3.0, 2.0), (), {1: ("best",), 2: ("median",), 0: ("worst",)}),
        ((5.0, 5.0, 5.0), (), {0: ("best", "median", "worst")}),
        ((4.0, 1.0, 3.0, 2.0), (), {0: ("best",), 3: ("median",), 1: ("worst",)}),
        ((np.nan, -np.inf, 0.0), (), {2: ("best",), 1: ("median",), 0: ("worst",)}),
        ((9.0, 1.0, 2.0), (0,), {2: ("best",), 1: ("median", "worst")}),
        ((np.inf, np.inf), (), {0: ("best", "median", "worst")}),
        ((1.0,), (0,), {}),
        ((), (), {}),
    ],
)
def test_roles(
    rewards: tuple[float, ...], failed: tuple[int, ...], roles: dict[int, Any]
) -> None:
    """Of equals the earlier, of an even number the lower, no number is the worst."""
    assert episodes_with_roles(columns(*rewards, failed=failed)) == roles


def test_roles_are_those_of_an_evaluation(tmp_path: Path) -> None:
    """The rule that chose the videos and the page call the same episodes the best."""
    from mjrec.evaluation.kept_episodes import keep_rule
    from mjrec.evaluation.results_files import read_results

    rewards = (2.0, 5.0, 5.0, 1.0, 1.0, 2.0)
    write_evaluation(tmp_path, ["a/x"], rewards=rewards)
    results = list(read_results(tmp_path))
    chosen = keep_rule("best,median,worst").choose(results)
    expected: dict[int, tuple[str, ...]] = {}
    for result, role in chosen:
        index = results.index(result)
        expected[index] = (*expected.get(index, ()), role)
    assert episodes_with_roles(gather(tmp_path).tasks[0].episodes) == expected


def test_verdicts_are_found_and_given(tmp_path: Path) -> None:
    """In the directory, and as a file."""
    write_journal(tmp_path / "run", "0.a", "X-v0", [entry(0)])
    counts = {"pass": 3, "fail": 0, "not checkable": 1}
    said = {"path": "run", "level": "physics", "passed": True, "counts": counts}
    (tmp_path / "run" / "verification.json").write_text(json.dumps(said))
    bad = {**said, "passed": False, "counts": {**counts, "fail": 2}}
    (tmp_path / "other.json").write_text(json.dumps(bad))
    contents = gather(tmp_path / "run", verifications=[tmp_path / "other.json"])
    assert [verdict.passed for verdict in contents.verdicts] == [True, False]
    assert contents.verdicts[0].counts == counts
    assert contents.verdicts[0].level == "physics"


@pytest.mark.parametrize(
    "text",
    [
        "no JSON",
        "{}",
        '{"path": "x", "level": "pixels", "passed": true, '
        '"counts": {"pass": 1, "fail": 1, "not checkable": 0}}',
        '{"path": "x", "level": "all", "passed": true, '
        '"counts": {"pass": 1, "fail": 0, "not checkable": 0}}',
    ],
)
def test_a_verdict_that_is_none_is_not_shown(tmp_path: Path, text: str) -> None:
    """One that contradicts itself neither; a file that was given is an error."""
    write_journal(tmp_path, "0.a", "X-v0", [entry(0)])
    path = tmp_path / "verification.json"
    path.write_text(text)
    contents = gather(tmp_path)
    assert contents.verdicts == ()
    assert "verification.json" in contents.problems[0]
    with pytest.raises(UnreadableFile, match=r"verification\.json"):
        gather(tmp_path, verifications=[path])


def test_a_directory_without_recordings_is_an_error(tmp_path: Path) -> None:
    """It is named, with what to do; so is one that is not there, or a file."""
    (tmp_path / "deep" / "deeper").mkdir(parents=True)
    write_journal(tmp_path / "deep" / "deeper", "0.a", "X-v0", [entry(0)])
    with pytest.raises(InvalidArgument, match="holds no recordings"):
        gather(tmp_path)
    named = tmp_path / "my runs; $(x)"
    named.mkdir()
    with pytest.raises(InvalidArgument, match="--out") as error:
        gather(named)
    assert f"--out {shlex.quote(str(named))}`" in str(error.value)
    with pytest.raises(InvalidArgument, match="is not there"):
        gather(tmp_path / "nowhere")
    with pytest.raises(InvalidArgument, match="is a file"):
        gather(GYM.parent.parent / "conftest.py")
    with pytest.raises(InvalidArgument, match="at least one directory"):
        gather([])


def test_gathering_needs_no_simulator_no_opengl_and_no_ffmpeg(recorded: Path) -> None:
    """Where these cannot be imported, everything is there all the same."""
    code = (
        "import sys\n"
        "blocked = {'mujoco', 'OpenGL', 'gymnasium', 'dm_control', 'imageio_ffmpeg'}\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in blocked:\n"
        "            raise ImportError(name)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from mjrec.reporting.gathering import gather\n"
        "contents = gather(sys.argv[1])\n"
        "print(contents.tasks[0].summary.episodes, len(contents.videos))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(recorded)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["2", "4"]


@pytest.mark.thorough
def test_many_episodes_take_little_memory(tmp_path: Path) -> None:
    """A hundred bytes each: a million take a fifth of what is promised."""
    count = 10_000
    write_journal(tmp_path, "0.a", "X-v0", [entry(i) for i in range(count)])
    gather(tmp_path)
    tracemalloc.start()
    try:
        gather(tmp_path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # Besides, the bootstrap takes what it takes, for any number.
    assert peak < 150 * count + (24 << 20)
