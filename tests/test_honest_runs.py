# SPDX-License-Identifier: Apache-2.0
"""Honest runs of each kind, packed: the verdict, and the excuses that it rests on."""

import pytest
from parts import parametrize

import honest_runs as honest
import mjrec
from mjrec.evidence.findings import Verdict

PASS, PARTLY = Verdict.PASS, Verdict.PARTLY
STATS = {"level": "stats"}
NO_ACTIONS, BROKEN = {"actions not kept"}, {"broken video"}

# The run, its verdict, the names of the excuses; options of `pack`, and of `verify`.
QUICK = [
    (honest.pendulum, PASS, (), {}, {}),
    (honest.suite, PASS, (), {}, {}),
    (honest.kept, PASS, (), {}, {}),
    (honest.killed, PARTLY, {"kill"}, {}, {}),
    (honest.trajectory_lost, PARTLY, {"fault"}, {}, {}),
    (honest.tracker_away, PASS, (), {}, {}),
]
THOROUGH = [
    (honest.cheetah, PASS, (), {}, {}),
    (honest.vector, PASS, (), {}, {}),
    (honest.evaluated, PASS, (), {}, {}),
    (honest.evaluated_in_part, PARTLY, {"exception"}, {}, {}),
    (honest.evaluated_to_death, PARTLY, {"exception", "kill"}, {}, {}),
    (honest.evaluated_again, PARTLY, {"kill"}, {}, {}),
    (honest.extended, PARTLY, {"rule"}, {}, {}),
    (honest.clips, PARTLY, {"schedule"}, {}, {}),
    (honest.kept_in_training, PARTLY, NO_ACTIONS, {}, {}),
    (honest.kept_in_training, PARTLY, NO_ACTIONS, {}, STATS),
    (honest.live, PASS, (), {}, {}),
    (honest.text, PASS, (), {}, {"trust": ["Taxi-v4"]}),
    (honest.several, PARTLY, (), {}, {}),
    (honest.resumed, PARTLY, (), {}, {}),
    (honest.schedule_raises, PARTLY, {"schedule"}, {}, {}),
    (honest.trigger_raises, PARTLY, {"schedule"}, {}, {}),
    (honest.encoder_killed, PARTLY, BROKEN, {}, {}),
    (honest.encoder_killed, PARTLY, BROKEN, {}, STATS),
    (honest.frame_missing, PARTLY, BROKEN, {}, {}),
    (honest.end_lost, PARTLY, {"fault"}, {}, {}),
    (honest.end_written_late, PASS, (), {}, {}),
    (honest.unseeded, PARTLY, {"unseeded beginning"}, {}, {}),
    (honest.early, PARTLY, {"early reset"}, {}, {}),
    (honest.wrapped, PASS, (), {}, {}),
    (honest.wrapped_in_code, PARTLY, {"wrappers"}, {}, {}),
    (honest.mjcf, PASS, (), {}, {}),
    (honest.training, PARTLY, NO_ACTIONS, {}, {}),
    (honest.doubles, PASS, (), {}, {}),
    (honest.views, PARTLY, {"schedule"}, {}, {}),
    (honest.pendulum, PASS, (), {"anonymous": True}, {}),
    (honest.pendulum, PASS, (), {"episodes": [1]}, {}),
    # Whole, the archive has 121,000 bytes.
    (honest.large, PASS, (), {"max_size": 110_000}, {}),
    (honest.pendulum, PARTLY, (), {}, {"sample": 2}),
    (honest.pendulum, PARTLY, (), {}, STATS),
    (honest.pendulum, PARTLY, (), {}, {"level": "physics"}),
]


def name_of(record, verdict, believed, packing, verifying):
    return " ".join([record.__name__, *packing, *verifying])


# Some take more than five seconds: a run is recorded, packed, recreated and drawn.
@parametrize(
    ("record", "verdict", "believed", "packing", "verifying"),
    [pytest.param(*run, id=name_of(*run)) for run in QUICK + THOROUGH],
    default=len(QUICK),
)
def test_honest_run_comes_out_again(
    record, verdict, believed, packing, verifying, tmp_path
):
    """Nothing contradicts it, and what is believed has its excuse."""
    record(tmp_path / "recorded")
    archive = mjrec.pack(tmp_path / "recorded", tmp_path / "run.zip", **packing)
    found = mjrec.verify(archive, **verifying)
    said = "\n".join(map(str, found.findings))
    assert found.verdict is verdict, said
    assert {each.name for each in found.excuses} == set(believed), said
    assert ("at a smaller size for packing" in said) == ("max_size" in packing), said
