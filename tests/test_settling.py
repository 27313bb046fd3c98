# SPDX-License-Identifier: Apache-2.0
"""Settling which episodes of an evaluation get a video."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from recordings import in_flight, videos_in

import mjrec
from evaluated import FOLDER, PENDULUM, facts_of, plan_of, run_job, worker_of
from mjrec.evaluation import settling
from mjrec.evaluation.dataclass_json import to_json
from mjrec.evaluation.episode_results import EpisodeResult
from mjrec.evaluation.ledger import read_ledgers
from mjrec.evaluation.settling import settle, unsettled_monitors
from mjrec.evidence.verification import Verdict
from mjrec.formats.trajectory_file import finish_trajectory
from mjrec.recorder.keep_rules import UNDECIDED
from mjrec.rendering.finish import finish
from mjrec.rendering.recordings import recorded_episodes

RULE = "best"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a task all of whose episodes are done, by two monitors."""
    plan = plan_of()
    worker = worker_of(tmp_path, plan)
    for seed in plan.seeds:
        worker(run_job(plan, seed))
    return tmp_path / FOLDER


def best_of(folder: Path) -> EpisodeResult:
    """Return the episode that is to get a video."""
    return max(read_ledgers(folder).values(), key=lambda each: each.total_reward or 0)


def settle_best(folder: Path) -> EpisodeResult:
    """Settle a folder in favour of its best episode, and return that."""
    best = best_of(folder)
    assert best.monitor is not None
    assert best.episode_id is not None
    settle(folder, {(best.monitor, best.episode_id): {"finished": 6}}, rule=RULE)
    return best


def manifests_of(folder: Path) -> dict[str, Mapping[str, Any]]:
    """Return what each manifest says of mjrec's, by infix."""
    found = {}
    for path in folder.glob("*.manifest.json"):
        infix = path.name.removeprefix("openaigym.manifest.").split(".manifest")[0]
        found[infix] = json.loads(path.read_text())["mjrec"]
    return found


def promises_of(folder: Path) -> dict[tuple[str, int], Any]:
    """Return what each trajectory says of its video."""
    found = {}
    for path in folder.glob("*.h5"):
        facts = facts_of(path)
        assert facts["candidate"] is False
        found[facts["infix"], facts["episode_id"]] = facts["video"]
    return found


def content_of(folder: Path) -> dict[str, bytes]:
    """Return all files."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def check_settled(folder: Path, best: EpisodeResult) -> None:
    """Check that one of six episodes gets a video, and that all say so."""
    promises = promises_of(folder)
    assert len(promises) == 6
    assert {key for key, video in promises.items() if video} == {
        (best.monitor, best.episode_id)
    }
    assert not in_flight(folder)
    assert unsettled_monitors(folder) == []
    for infix, details in manifests_of(folder).items():
        chosen = [best.episode_id] if infix == best.monitor else []
        assert [entry["episode_id"] for entry in details["pending"]] == chosen
        assert details["schedule"] == {"name": f"keep:{RULE}", "recorded": chosen}
        keep = details["keep"]
        assert (keep["decided"], keep["chosen"]) == (True, chosen)
        assert "left_open" not in keep


def test_before_it_all_are_candidates_that_recovery_leaves_alone(folder: Path) -> None:
    """The logs of monitors that closed in order wait, whoever comes by."""
    before = content_of(folder)
    assert len(unsettled_monitors(folder)) == 2
    assert {facts_of(log)["candidate"] for log in in_flight(folder)} == {True}
    for details in manifests_of(folder).values():
        assert details["keep"]["decided"] is False
    assert not mjrec.recover(folder)
    assert content_of(folder) == before


@pytest.mark.parametrize("said", [None, -1, 10**15])
def test_monitor_whose_manifest_says_no_numbers_is_settled(
    folder: Path, said: int | None
) -> None:
    """Its episodes are found by their names then."""
    for path in folder.glob("*.manifest.json"):
        manifest = json.loads(path.read_text())
        manifest["mjrec"]["first_episode_id"] = said
        path.write_text(json.dumps(manifest))
    check_settled(folder, settle_best(folder))


def test_what_is_chosen_is_pending_and_the_rest_is_not(folder: Path) -> None:
    """Trajectories get their final form, and manifests say what there will be."""
    best = settle_best(folder)
    check_settled(folder, best)
    [selection] = [v["selection"] for v in promises_of(folder).values() if v]
    assert selection == {
        "rule": RULE,
        "decided": True,
        "scope": "evaluation",
        "finished": 6,
    }


def test_it_is_done_once(folder: Path) -> None:
    """Whatever is chosen the next time."""
    settle_best(folder)
    before = content_of(folder)
    settle(folder, {}, rule="worst")
    assert content_of(folder) == before


@pytest.mark.parametrize("finished", [1, 3])
def test_trajectories_that_are_final_already_are_settled_too(
    folder: Path, finished: int
) -> None:
    """As they are after a recovery, or where somebody was killed in between."""
    for path in in_flight(folder)[:finished]:
        finish_trajectory(path)
    check_settled(folder, settle_best(folder))


@pytest.mark.parametrize(
    "step",
    ["add_facts", "finish_trajectory", "_journal_choice", "write_manifest_and_stats"],
)
@pytest.mark.parametrize("times", [0, 1])
def test_it_goes_on_where_it_was_killed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, step: str, times: int
) -> None:
    """At each of its steps."""
    real, calls = getattr(settling, step), []

    def killed(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) > times:
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(settling, step, killed)
    with pytest.raises(KeyboardInterrupt):
        settle_best(folder)
    monkeypatch.undo()
    check_settled(folder, settle_best(folder))


def test_the_videos_are_rendered_of_what_was_chosen(folder: Path) -> None:
    """Manifest and metadata say so, and nothing is pending any more."""
    best = settle_best(folder)
    outcomes = list(finish(folder, workers=1))
    assert [outcome.failures for outcome in outcomes] == [{}]
    assert videos_in(folder) == [best.episode_id]
    assert all(not each["pending"] for each in manifests_of(folder).values())
    [metadata] = folder.glob("*.meta.json")
    assert json.loads(metadata.read_text())["selection"]["rule"] == RULE


def test_a_video_that_somebody_has_rendered_meanwhile_stays(folder: Path) -> None:
    """What is there is listed, chosen or not."""
    best = best_of(folder)
    other = next(key for key in recorded_episodes(folder) if _is_not(key, best))
    list(finish(folder, [other], workers=1))
    settle_best(folder)
    details = manifests_of(folder)[str(other.infix)]
    assert other.number in details["schedule"]["recorded"]
    assert other.number not in [each["episode_id"] for each in details["pending"]]
    assert videos_in(folder) == [other.number]
    name = f"openaigym.manifest.{other.infix}.manifest.json"
    assert len(json.loads((folder / name).read_text())["videos"]) == 1


def _is_not(key: Any, best: EpisodeResult) -> bool:
    return (str(key.infix), key.number) != (best.monitor, best.episode_id)


def test_a_monitor_that_is_open_is_left_alone(folder: Path) -> None:
    """It may still record."""
    env = gymnasium.make(PENDULUM, width=32, height=32)
    with mjrec.Monitor(
        env, folder, resume=True, mode="evaluation", keep=UNDECIDED, workers=0
    ) as monitor:
        monitor.reset(seed=0)
        monitor.step(monitor.action_space.sample())
        assert monitor.infix not in unsettled_monitors(folder)
        best = settle_best(folder)
        infix = monitor.infix
    assert unsettled_monitors(folder) == [infix]
    [log] = in_flight(folder)
    assert facts_of(log)["candidate"] is True
    settle(folder, {}, rule=RULE)
    assert unsettled_monitors(folder) == []
    assert promises_of(folder)[str(best.monitor), best.episode_id or 0]


_KILLED = """
import json, os, signal, sys
import cloudpickle
from mjrec.evaluation.worker import EvaluationWorker

class Deadly:
    steps = 0
    def __call__(self, observation):
        self.steps += 1
        if self.steps == 20:
            os.kill(os.getpid(), signal.SIGKILL)
        return observation[:1] * 0

settings, job = map(json.loads, sys.argv[1:])
EvaluationWorker(settings, cloudpickle.dumps(Deadly()))(job)
"""


def test_after_a_kill_nothing_finished_is_repeated_or_lost(tmp_path: Path) -> None:
    """What the killed worker had done counts; what it was at is run again."""
    plan = plan_of(seeds=(0,), policy="zero", is_object=True)
    settings = {"directory": str(tmp_path), "plan": to_json(plan)}
    arguments = map(json.dumps, (settings, run_job(plan, 0)))
    command = [sys.executable, "-c", _KILLED, *arguments]
    killed = subprocess.run(command, check=False, capture_output=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    before = read_ledgers(tmp_path / FOLDER)
    assert [*before] == [(0, 0), (0, 1)]
    plan = plan_of(seeds=(0,), policy="zero")
    worker = worker_of(tmp_path, plan)
    assert worker(run_job(plan, 0, again=True))["episodes"] == 1
    monitors = worker({"kind": "recover", "folder": FOLDER})["monitors"]
    results = read_ledgers(tmp_path / FOLDER)
    assert len(monitors) == 2
    assert {unit: results[unit] for unit in before} == before
    # Chosen is one that the dead monitor recorded.
    chosen = results[0, 1]
    for monitor in monitors:
        own = [[chosen.episode_id, {}]] if monitor == chosen.monitor else []
        worker({"kind": "settle", "folder": FOLDER, "monitor": monitor, "chosen": own})
    promises = promises_of(tmp_path / FOLDER)
    assert len(promises) >= 3
    assert {key for key, video in promises.items() if video} == {
        (chosen.monitor, chosen.episode_id)
    }
    pending = [each["pending"] for each in manifests_of(tmp_path / FOLDER).values()]
    assert sorted(map(len, pending)) == [0, 1]


def test_what_was_begun_again_is_never_chosen(tmp_path: Path) -> None:
    """Of a random stream that was cut there are episodes that no result speaks of."""
    plan = plan_of(seeds=(0,), protocol="suite")
    folder = tmp_path / FOLDER
    worker_of(tmp_path, plan)(run_job(plan, 0))
    [ledger] = folder.glob("mjrec.evaluation.*")
    *lines, _, _ = ledger.read_text().splitlines(keepends=True)
    ledger.write_text("".join(lines))
    worker_of(tmp_path, plan)(run_job(plan, 0))
    check_settled(folder, settle_best(folder))


@pytest.mark.thorough
def test_a_settled_folder_can_be_packed_and_verified(
    folder: Path, tmp_path: Path
) -> None:
    """Nothing fails; who chose among all monitors' episodes is not proved."""
    settle_best(folder)
    list(finish(folder, workers=1))
    archive = tmp_path / "run.zip"
    mjrec.pack(folder, archive)
    checks = mjrec.verify(archive, level="stats").checks
    assert not [check for check in checks if check.verdict is Verdict.FAIL]
    [reason, *_] = [c.reason for c in checks if "of an evaluation" in (c.reason or "")]
    assert RULE in reason
