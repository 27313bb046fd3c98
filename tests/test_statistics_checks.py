# SPDX-License-Identifier: Apache-2.0
"""The level `stats`: statistics that do not follow, videos that were picked."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from packed_runs import (
    edit_json,
    edit_trajectory,
    record_pendulum,
    set_reward,
    the,
)
from recordings import edit_journal

import mjrec
from mjrec.evidence.verification import Check, Level, Verdict
from mjrec.evidence.verifying.recorded_monitors import recorded_monitors
from mjrec.evidence.verifying.statistics_checks import check_statistics, sum_of
from mjrec.evidence.verifying.statistics_table import check_table
from mjrec.evidence.verifying.task import Task
from mjrec.schedules import record_all


@pytest.fixture(scope="module")
def honest(pendulums: Callable[..., Path]) -> Path:
    """Recordings of three episodes, all with states, the first two with videos."""
    return pendulums(3, mode="evaluation")


@pytest.fixture
def recordings(honest: Path, tmp_path: Path) -> Path:
    """The same, to be changed."""
    return Path(shutil.copytree(honest, tmp_path / "recordings"))


def checks_of(recordings: Path) -> list[Check]:
    task = Task(recordings=recordings, level=Level.STATS)
    return list(check_statistics(task, lambda *_: None))


def failures(recordings: Path) -> list[tuple[str, str]]:
    """Return subjects and reasons."""
    return [
        (check.subject, check.reason)
        for check in checks_of(recordings)
        if check.verdict is Verdict.FAIL
    ]


def unknown(recordings: Path) -> list[str]:
    """Return the reasons why something is not checkable."""
    return [
        check.reason
        for check in checks_of(recordings)
        if check.verdict is Verdict.NOT_CHECKABLE
    ]


def edit_stats(recordings: Path, key: str, row: int, value: Any) -> None:
    edit_json(the(recordings, "*.stats.json"), lambda s: s[key].__setitem__(row, value))


def edit_manifest(recordings: Path, edit: Callable[[Any], object]) -> None:
    edit_json(the(recordings, "*.manifest.json"), lambda m: edit(m["mjrec"]))


def test_honest_recordings_pass(honest: Path) -> None:
    """With nothing that could not be checked."""
    assert {check.verdict for check in checks_of(honest)} == {Verdict.PASS}


def test_episode_that_is_another_again_is_told(recordings: Path) -> None:
    """No failure: an author may begin from one seed twice, with the same policy."""
    first, second = (the(recordings, f"*.episode00000{n}.h5") for n in (0, 1))
    shutil.copy(first, second)
    [reason] = [reason for reason in unknown(recordings) if "same seed" in reason]
    assert reason.startswith("episodes 0, 1 have")


def test_returns_are_added_up_as_the_recorder_does() -> None:
    """One after the other: neither in pairs nor with compensation."""
    rewards = np.random.default_rng(0).normal(size=10_000) * 1e8
    total = 0.0
    for reward in rewards.tolist():
        total += reward
    assert sum_of(rewards) == total
    assert sum_of(rewards[:0]) == 0.0


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("reward", 7.000000000000001),
        ("length", 5),
        ("type", "t"),
        ("seed", 99),
        ("terminated", None),
        ("start_time", 0.0),
    ],
)
def test_edit_of_the_journal_alone_is_found(
    key: str, value: Any, recordings: Path
) -> None:
    """By one bit of a return, too."""
    if value is None:
        line = json.loads(the(recordings, "*.jsonl").read_text().splitlines()[1])
        value = not line[key]
    edit_journal(recordings, 1, **{key: value})
    assert any(
        subject.startswith("episode 1 of") for subject, _ in failures(recordings)
    )


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("episode_rewards", 1.5),
        ("episode_lengths", 5),
        ("timestamps", 2e9),
        ("episode_types", "t"),
    ],
)
def test_edit_of_the_statistics_file_alone_is_found(
    key: str, value: Any, recordings: Path
) -> None:
    """Each of its rows is a line of the journal."""
    edit_stats(recordings, key, 2, value)
    found = failures(recordings)
    assert [subject.split(" of")[0] for subject, _ in found] == ["episode 2"]


def test_journal_of_another_environment_is_found(recordings: Path) -> None:
    """The manifest says which it is."""
    journal = the(recordings, "*.jsonl")
    text = journal.read_text().replace("InvertedPendulum-v5", "Humanoid-v5")
    journal.write_text(text)
    [(_, reason)] = failures(recordings)
    assert reason.startswith("env_id: the journal says 'Humanoid-v5'")


def test_return_that_does_not_follow_from_the_rewards_is_found(
    recordings: Path,
) -> None:
    """Though journal, statistics and metadata all say the same."""
    edit_journal(recordings, 0, reward=1000.0)
    edit_stats(recordings, "episode_rewards", 0, 1000.0)
    edit_json(the(recordings, "*000000.meta.json"), lambda m: m.update(reward=1000.0))
    [(subject, reason)] = failures(recordings)
    assert subject.startswith("episode 0 of")
    assert "the recorded steps" in reason


def test_reward_edited_in_all_files_at_once_is_beyond_this_level(
    recordings: Path,
) -> None:
    """They are consistent; only the environment can say that it is another reward."""
    path = the(recordings, "*episode000002.h5")
    set_reward(path, 0, 50.0)
    total = float(np.add.accumulate(mjrec.load_trajectory(path).rewards)[-1])
    edit_journal(recordings, 2, reward=total)
    edit_stats(recordings, "episode_rewards", 2, total)
    assert failures(recordings) == []


@pytest.mark.parametrize(
    ("facts", "reason"),
    [
        ({"episode_id": 0}, "number"),
        ({"infix": "0.0"}, "recording"),
        ({"seed": 9}, "seed"),
        ({"complete": False}, "complete"),
        ({"length": 999}, "length"),
        ({"env_id": "Hopper-v5"}, "Hopper-v5"),
        ({"video": {"name": "openaigym.video.0.1.video000000.mp4"}}, "its video is"),
    ],
)
def test_trajectory_that_says_other_than_the_journal_is_found(
    facts: dict[str, Any], reason: str, recordings: Path
) -> None:
    """Each fact that both have."""
    edit_trajectory(the(recordings, "*episode000001.h5"), **facts)
    assert any(reason in why for _, why in failures(recordings))


def test_end_that_is_not_recorded_is_found(recordings: Path) -> None:
    """The last row says how an episode ended."""

    def flip(file: Any) -> None:
        for name in ("terminated", "truncated"):
            file[name][-1] = not file[name][-1]

    edit_trajectory(the(recordings, "*episode000001.h5"), flip)
    assert any("terminated: the recorded" in why for _, why in failures(recordings))


def test_swapped_trajectories_are_found(recordings: Path) -> None:
    """Each says whose it is."""
    one, other = (the(recordings, f"*episode00000{n}.h5") for n in (0, 1))
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)
    found = failures(recordings)
    assert {subject.split(" of")[0] for subject, _ in found} >= {
        "episode 0",
        "episode 1",
    }


def test_video_of_another_episode_is_found(recordings: Path) -> None:
    """The best episode's, relabelled: its metadata came with it."""
    for ending in ("mp4", "meta.json", "framehash"):
        one = the(recordings, f"*.video000001.{ending}")
        one.write_bytes(the(recordings, f"*.video000000.{ending}").read_bytes())
    [(subject, reason)] = failures(recordings)
    assert subject.endswith("video000001.mp4")
    assert "of episode 0" in reason


def test_relabelled_video_with_edited_metadata_is_found(recordings: Path) -> None:
    """Where its metadata gets the number only, the return gives it away."""
    for ending in ("mp4", "meta.json", "framehash"):
        one = the(recordings, f"*.video000001.{ending}")
        one.write_bytes(the(recordings, f"*.video000000.{ending}").read_bytes())
    edit_json(
        the(recordings, "*.video000001.meta.json"), lambda m: m.update(episode_id=1)
    )
    assert any("seed" in reason for _, reason in failures(recordings))


@pytest.mark.parametrize(
    ("schedule", "reason"),
    [
        ({"name": "capped_cubic_video_schedule", "recorded": [0]}, "chooses 0, 1"),
        ({"name": "record_all", "recorded": [0, 1]}, "chooses 0, 1, 2"),
        ({"name": "every:2", "recorded": [0, 1]}, "chooses 0, 2"),
        ({"name": "at:1", "recorded": [0, 1]}, "chooses 1"),
        ({"name": "disable_videos", "recorded": []}, "no schedule chose"),
        ({"name": "every:1", "recorded": [0, 1, 2]}, "there is none, nor a reason"),
        ({"name": "mine", "recorded": [0]}, "no schedule chose"),
        ({"name": "keep:best:2", "recorded": [0, 1]}, "two rules"),
        ({}, "does not say by which schedule"),
    ],
)
def test_schedule_that_does_not_match_is_found(
    schedule: dict[str, Any], reason: str, recordings: Path
) -> None:
    """It is asked again about every episode, and compared with the videos."""
    edit_manifest(recordings, lambda m: m.update(schedule=schedule))
    assert any(reason in why for _, why in failures(recordings))


def test_function_of_the_users_is_not_checkable_but_its_answers_are(
    tmp_path: Path,
) -> None:
    """It is not here to be asked; the manifest has its answers."""
    record_pendulum(tmp_path, video_callable=lambda n: n == 2, mode="evaluation")
    assert failures(tmp_path) == []
    assert any("a function of the user's" in reason for reason in unknown(tmp_path))


@pytest.mark.thorough
@pytest.mark.parametrize("rule", ["best:1", "worst:2", "median", "failures:1"])
def test_rule_that_chose_after_the_end_is_asked_again(
    rule: str, tmp_path: Path
) -> None:
    """About all episodes of the journal; another choice is found."""
    record_pendulum(tmp_path, 4, longest=30, keep=rule, mode="evaluation")
    assert failures(tmp_path) == []
    passed = [check.figures.get("schedule") for check in checks_of(tmp_path)]
    assert f"keep:{rule}" in passed

    def choose_others(details: Any) -> None:
        others = sorted({0, 1, 2, 3} - set(details["keep"]["chosen"]))
        details["keep"]["chosen"] = details["schedule"]["recorded"] = others

    edit_manifest(tmp_path, choose_others)
    subjects = [subject for subject, _ in failures(tmp_path)]
    assert any(subject.startswith("recording") for subject in subjects)


def test_videos_counted_in_steps_pass(tmp_path: Path) -> None:
    """One that goes on across a reset is the next episode's too."""
    record_pendulum(tmp_path, 3, longest=4, video_length=6)
    assert failures(tmp_path) == []


def test_videos_begun_at_steps_are_not_checkable(tmp_path: Path) -> None:
    """Which ones, a function of the user's decides."""
    record_pendulum(tmp_path, 3, step_trigger=lambda n: n == 3, video_length=2)
    assert failures(tmp_path) == []
    assert any("step_trigger" in reason for reason in unknown(tmp_path))


def test_video_rendered_later_of_an_episode_nobody_chose_is_told(
    recordings: Path,
) -> None:
    """It is honest, and somebody has picked it."""
    for ending in ("mp4", "meta.json", "framehash"):
        path = the(recordings, f"*.video000001.{ending}")
        name = path.name.replace("000001", "000002.64x48")
        shutil.copy(path, path.with_name(name))
    assert any("of episodes 2, which no schedule" in why for why in unknown(recordings))


@pytest.mark.thorough
def test_episode_that_was_begun_at_the_end_passes(tmp_path: Path) -> None:
    """Its number was decided about, and there was no step of it."""
    env = gymnasium.make("InvertedPendulum-v5", render_mode="rgb_array", width=32)
    with mjrec.Monitor(
        env, tmp_path, video_callable=record_all, workers=1, allow_early_reset=True
    ) as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())
        env.reset()
    assert failures(tmp_path) == []


@pytest.mark.thorough
def test_recovered_recordings_pass(tmp_path: Path) -> None:
    """Its journal says all that its manifest would."""
    record_pendulum(tmp_path, 2)
    the(tmp_path, "*.manifest.json").unlink()
    assert failures(tmp_path)
    mjrec.recover(tmp_path)
    assert failures(tmp_path) == []
    assert unknown(tmp_path) == []


def test_episodes_that_were_taken_out_are_told(recordings: Path) -> None:
    """Their numbers are missing; they may also have been reset early."""
    path = the(recordings, "*.jsonl")
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(x for x in lines if '"episode_id": 1,' not in x[:17]))
    for key in ("timestamps", "episode_lengths", "episode_rewards", "episode_types"):
        edit_json(the(recordings, "*.stats.json"), lambda s, key=key: s[key].pop(1))
    assert any("episodes 1 were begun" in reason for reason in unknown(recordings))
    # Its states are still there, and say that it was complete.
    assert any("no line of the journal" in why for _, why in failures(recordings))


@pytest.mark.thorough
def test_episodes_without_states_are_counted(tmp_path: Path) -> None:
    """One line, with their number."""
    record_pendulum(tmp_path)
    assert failures(tmp_path) == []
    assert any("1 of 3 episodes" in reason for reason in unknown(tmp_path))


@pytest.mark.parametrize("pattern", ["*.jsonl", "*.stats.json", "*.manifest.json"])
def test_damaged_file_is_a_failure_and_no_error(pattern: str, recordings: Path) -> None:
    """The others are checked all the same."""
    the(recordings, pattern).write_text("[")
    assert failures(recordings)


@pytest.mark.parametrize("value", [None, [[1]], {"x": [{}]}, 1e999, "x", True])
def test_values_that_cannot_be_are_no_error(value: Any, recordings: Path) -> None:
    """Whatever stands in a file where something else should be."""

    def spoil(details: Any) -> None:
        for key in details:
            details[key] = value

    for pattern in ("*.manifest.json", "*000000.meta.json"):
        path = the(recordings, pattern)
        content = path.read_text()
        edit_json(path, spoil)
        assert failures(recordings)
        path.write_text(content)
    edit_manifest(recordings, spoil)
    edit_trajectory(
        the(recordings, "*episode000001.h5"),
        **dict.fromkeys(("episode_id", "infix", "seed", "video", "length"), value),
    )
    assert failures(recordings)


def test_damaged_trajectory_is_a_failure_and_no_error(recordings: Path) -> None:
    """And names the episode."""
    path = the(recordings, "*episode000001.h5")
    path.write_bytes(path.read_bytes()[:2000])
    [(subject, reason)] = failures(recordings)
    assert subject.startswith("episode 1 of")
    assert "cannot be read" in reason


@pytest.mark.thorough
def test_chosen_videos_of_a_packed_run_are_told_apart_from_lost_ones(
    honest: Path, tmp_path: Path
) -> None:
    """Whoever packed it said which to leave out."""
    archive = mjrec.pack(honest, tmp_path / "run.zip", episodes=[0])
    verification = mjrec.verify(archive, level="stats")
    assert verification.failures == ()
    assert any("left out" in check.reason for check in verification.checks)


@pytest.mark.parametrize(
    ("column", "value"),
    [("reward", "9999.0"), ("length", "1"), ("video", ""), ("seed", "7")],
)
def test_edited_table_is_found(
    column: str, value: str, honest: Path, tmp_path: Path
) -> None:
    """It says what the journal says, digit for digit."""
    archive = mjrec.pack(honest, tmp_path / "run.zip")
    shutil.unpack_archive(archive, tmp_path / "unpacked")
    path = the(tmp_path / "unpacked", "statistics.csv")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    rows[1][column] = value
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    checks = check_table(path, recorded_monitors(honest))
    [failure] = [check for check in checks if check.verdict is Verdict.FAIL]
    assert failure.subject.startswith("episode 1 of")
    assert column in failure.reason
