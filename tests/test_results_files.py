# SPDX-License-Identifier: Apache-2.0
"""Read and write files of evaluation results, and report damaged ones."""

import dataclasses
import json
import math
import tracemalloc

import pytest

from mjrec import UnreadableFile
from mjrec.evaluation.episode_results import EpisodeResult
from mjrec.evaluation.evaluation import (
    ChosenEpisode,
    Evaluation,
    is_evaluation,
    read_results,
    write_results,
)
from mjrec.evaluation.plan import EvaluatedTask, EvaluationPlan
from mjrec.evaluation.result_tables import EpisodeFiles
from mjrec.evaluation.statistics import Bootstrap, Interval
from mjrec.evaluation.summaries import AcrossTasks, Profile, TaskSummary

VIDEO = "openaigym.video.0.w.video000000.mp4"
SUMMARY = TaskSummary(
    task="a,b-v0",
    runs=2,
    episodes=3,
    failed=1,
    mean=1.5,
    mean_interval=Interval(-1.0, math.inf),
    warnings={"BADQACC": 2},
    score_range=(0.0, 10.0),
)
ACROSS = AcrossTasks(
    tasks=("a,b-v0",),
    left_out={"c": "no scale"},
    iqm=0.5,
    profile=Profile(thresholds=(0.0, 1.0), shares=(1.0, 0.0), low=(1, 0), high=(1, 0)),
)
PLAN = EvaluationPlan(
    tasks=(EvaluatedTask("a,b-v0", "ab"),), policy="random", seeds=(7, 3), episodes=2
)


def result(seed, episode, total, **more):
    is_over = None if total is None else False
    ends = {"terminated": is_over, "truncated": None if total is None else True}
    facts = {"task": "a,b-v0", "total_reward": total, "length": 5, **ends, **more}
    return EpisodeResult(seed=seed, episode=episode, **facts)


TIMES = {"monitor": "0.w", "episode_id": 0, "start_time": 1.25, "seconds": 0.5}
RESULTS = [
    result(7, 0, 0.1 + 0.2, success=True, **TIMES),
    result(7, 1, math.nan),
    result(3, 0, None, failure='it said "no",\nand\0 went =1+1 \udc80'),
    result(3, 1, -math.inf),
]


def write(directory, **changes):
    facts = {
        "directory": directory,
        "plan": PLAN,
        "summaries": [SUMMARY],
        "across": ACROSS,
        "bootstrap": Bootstrap(resamples=10),
        "selection": {"a,b-v0": [ChosenEpisode(7, 0, "best")]},
        "versions": {"mujoco": "3.4"},
    }
    results, files = changes.pop("results", RESULTS), changes.pop("files", files_of)
    write_results(Evaluation(**{**facts, **changes}), results, files)
    return directory


def files_of(result):
    if result.monitor is None:
        return EpisodeFiles()
    return EpisodeFiles(
        "a,b-v0/seed-007", "openaigym.trajectory.0.w.episode000000.h5", VIDEO
    )


def test_results_are_read_back(tmp_path):
    """Floats are equal bit for bit, and times may be missing."""
    read = read_results(write(tmp_path))
    assert read.plan == PLAN
    assert (read.summaries, read.across) == ((SUMMARY,), ACROSS)
    assert read.bootstrap == Bootstrap(resamples=10)
    assert read.selection == {"a,b-v0": (ChosenEpisode(7, 0, "best"),)}
    assert read.versions == {"mujoco": "3.4"}
    first, nan, failed, infinite = read
    assert (first, infinite) == (RESULTS[0], RESULTS[3])
    assert math.isnan(nan.total_reward)
    assert failed.total_reward is None
    assert failed.failure == 'it said "no", and went =1+1 \\udc80'
    columns = read.by_task["a,b-v0"]
    assert columns.videos == {0: VIDEO}
    assert columns.places == {("a,b-v0/seed-007", "0.w"): 0}
    assert columns.failed.tolist() == [False, False, True, False]
    (tmp_path / "timing.csv").unlink()
    first, *_ = read_results(tmp_path)
    assert first.total_reward == 0.1 + 0.2
    assert (first.start_time, first.monitor) == (None, None)


def test_files_match_the_documentation(tmp_path):
    write(tmp_path)
    assert (tmp_path / "results.csv").read_text().splitlines() == [
        "task,seed,episode,return,length,terminated,truncated,success,failure",
        '"a,b-v0",7,0,0.30000000000000004,5,false,true,true,',
        '"a,b-v0",7,1,nan,5,false,true,,',
        '"a,b-v0",3,0,,5,,,,"it said ""no"", and went =1+1 \\udc80"',
        '"a,b-v0",3,1,-inf,5,false,true,,',
    ]
    json.loads((tmp_path / "results.json").read_text(), parse_constant=pytest.fail)


def test_results_are_removed_while_rewritten(tmp_path):
    """Old tables never coexist with a new plan, and the error says how to resume."""
    with pytest.raises(UnreadableFile, match="the directory contains no evaluation"):
        read_results(tmp_path)
    assert not is_evaluation(tmp_path)
    (tmp_path / "evaluation.json").write_text("{}")
    assert is_evaluation(tmp_path)
    write(tmp_path)
    with pytest.raises(ZeroDivisionError):
        write(tmp_path, files=lambda _: 1 / 0)
    assert not (tmp_path / "results.json").exists()
    assert not list(tmp_path.glob(".*"))
    with pytest.raises(UnreadableFile, match=f"mjrec evaluate --resume {tmp_path} "):
        read_results(tmp_path)


DAMAGE = {
    "wrong header": ("results.csv", b"task,seed", b"task,sed"),
    "a missing row": ("results.csv", b'"a,b-v0",3,1,-inf,5,false,true,,\n', b""),
    "half a row": ("results.csv", b",5,false,true,,\n", b""),
    "empty row": ("results.csv", b"true,true,\n", b"true,true,\n\n"),
    "duplicate row": ("results.csv", b'"a,b-v0",7,1', b'"a,b-v0",7,0'),
    "a huge number": ("results.csv", b",5,", b"," + b"9" * 5000 + b","),
    "other notation of NaN": ("results.csv", b"nan", b"NaN()"),
    "a huge line": ("results.csv", b"nan", b"1" * 100_000),
    "an open quote": ("results.csv", b'"it', b'""it'),
    "a row over two lines": ("results.csv", b"said ", b"said\n"),
    "not UTF-8": ("results.csv", b"said", b"\xff"),
    "other notation of false": ("results.csv", b"false", b"0"),
    "a return and a failure": ("results.csv", b"3,0,,", b"3,0,1.0,"),
    "a NUL": ("results.csv", b"said", b"\0"),
    "a path as a video": ("timing.csv", VIDEO.encode(), b"../../etc/passwd.mp4"),
    "a video of another episode": ("timing.csv", b"video000000", b"video000001"),
    "a path as a folder": ("timing.csv", b"/seed-007", b"/../seed-007"),
    "a bad infix": ("timing.csv", b",0.w,", b",../0.w,"),
    "another version": ("results.json", b'"format_version": 1', b'"format_version": 2'),
    "not JSON": ("results.json", b"{", b"["),
    "a text for a number": ("results.json", b'"mean": 1.5', b'"mean": "1.5"'),
    "another task": ("results.json", b'"task": "a,b-v0"', b'"task": "c"'),
    "many episodes": ("results.json", b'"episodes": 2', b'"episodes": 999999999'),
    "an invalid choice": ("results.json", b'"best"', b'"best", 2'),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_an_error_that_names_the_file(tmp_path, damage):
    name, good, bad = DAMAGE[damage]
    path = write(tmp_path) / name
    data = path.read_bytes()
    assert good in data
    path.write_bytes(data.replace(good, bad, 1))
    with pytest.raises(UnreadableFile) as caught:
        read_results(tmp_path)
    # The error may blame the table if the plan does not match it.
    assert caught.value.path.name in {name, "results.csv"}


def test_link_out_of_the_directory_is_not_followed(tmp_path):
    (tmp_path / "there").mkdir()
    path = write(tmp_path / "there") / "results.csv"
    path.rename(tmp_path / "results.csv")
    path.symlink_to(tmp_path / "results.csv")
    with pytest.raises(UnreadableFile, match="leads out"):
        read_results(tmp_path / "there")


def test_many_episodes_need_little_memory(tmp_path):
    count = 20_000
    task = {"tasks": (EvaluatedTask("T-v0", "T"),), "seeds": (0,), "episodes": count}
    write(
        tmp_path,
        plan=dataclasses.replace(PLAN, **task),
        results=[],
        summaries=[TaskSummary(task="T-v0", runs=1, episodes=count)],
        selection={},
    )
    row = "T-v0,0,{n},{reward!r},1000,false,true,,\n"
    times = "T-v0,0,{n},1790000000.{n},0.5,T/seed-000,0.worker,{n},,\n"
    for name, line in (("results", row), ("timing", times)):
        with (tmp_path / f"{name}.csv").open("a") as file:
            file.writelines(line.format(n=n, reward=n / 7) for n in range(count))
    tracemalloc.start()
    try:
        read = read_results(tmp_path)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(read.by_task["T-v0"]) == count
    assert most < count * 150 + 1_000_000
