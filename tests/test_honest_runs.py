# SPDX-License-Identifier: Apache-2.0
"""Honest runs of each kind, packed: the verdict, and the excuses that it rests on."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from parts import parametrize

import honest_runs as honest
import mjrec
from mjrec.evidence.findings import Verdict

PASS, PARTLY = Verdict.PASS, Verdict.PARTLY


class Honest(NamedTuple):
    """A row of the table.

    Attributes:
        record: the run.
        verdict: of it.
        believed: the names of the excuses.
        packing: options of `pack`.
        verifying: options of `verify`.
        quick: whether it is tried by default.
    """

    record: Callable[[Path], object]
    verdict: Verdict = PASS
    believed: set[str] = set()  # noqa: RUF012  never changed
    packing: dict[str, Any] = {}  # noqa: RUF012  likewise
    verifying: dict[str, Any] = {}  # noqa: RUF012  likewise
    quick: bool = False

    @property
    def name(self):
        """What the test is called."""
        options = {**self.packing, **self.verifying}
        return f"{self.record.__name__} {' '.join(map(str, options))}".strip()


_STATS = {"level": "stats"}

HONEST = (
    Honest(honest.pendulum, quick=True),
    Honest(honest.cheetah),
    Honest(honest.suite, quick=True),
    Honest(honest.vector),
    Honest(honest.evaluated),
    Honest(honest.evaluated_in_part, PARTLY, {"exception"}),
    Honest(honest.evaluated_to_death, PARTLY, {"exception", "kill"}),
    Honest(honest.evaluated_again, PARTLY, {"kill"}),
    Honest(honest.extended, PARTLY, {"rule"}),
    Honest(honest.clips, PARTLY, {"schedule"}),
    Honest(honest.kept, quick=True),
    Honest(honest.kept_in_training, PARTLY, {"actions not kept"}),
    Honest(honest.kept_in_training, PARTLY, {"actions not kept"}, verifying=_STATS),
    Honest(honest.live),
    Honest(honest.text, verifying={"trust": ["Taxi-v4"]}),
    Honest(honest.several, PARTLY),
    Honest(honest.resumed, PARTLY),
    Honest(honest.killed, PARTLY, {"kill"}, quick=True),
    Honest(honest.tracker_away, quick=True),
    Honest(honest.schedule_raises, PARTLY, {"schedule"}),
    Honest(honest.trigger_raises, PARTLY, {"schedule"}),
    Honest(honest.encoder_killed, PARTLY, {"broken video"}),
    Honest(honest.encoder_killed, PARTLY, {"broken video"}, verifying=_STATS),
    Honest(honest.frame_missing, PARTLY, {"broken video"}),
    Honest(honest.unseeded, PARTLY, {"unseeded beginning"}),
    Honest(honest.early, PARTLY, {"early reset"}),
    Honest(honest.wrapped),
    Honest(honest.wrapped_in_code, PARTLY, {"wrappers"}),
    Honest(honest.mjcf),
    Honest(honest.training, PARTLY, {"actions not kept"}),
    Honest(honest.doubles),
    Honest(honest.views, PARTLY, {"schedule"}),
    Honest(honest.pendulum, packing={"anonymous": True}),
    Honest(honest.pendulum, packing={"episodes": [1]}),
    Honest(honest.pendulum, packing={"max_size": 120_000}),
    Honest(honest.pendulum, PARTLY, verifying={"sample": 2}),
    Honest(honest.pendulum, PARTLY, verifying={"level": "stats"}),
    Honest(honest.pendulum, PARTLY, verifying={"level": "physics"}),
)


def said(found):
    """Return what is not recreated."""
    return "\n".join(
        f"{each.outcome} {each.topic} {each.item}: {each.reason} [{each.excuse}]"
        for each in found.findings
    )


# Some take more than five seconds: a run is recorded, packed, recreated and drawn.
@parametrize(
    "run", HONEST, default=[each for each in HONEST if each.quick], ids=lambda r: r.name
)
def test_honest_run_comes_out_again(run, tmp_path):
    """Nothing contradicts it, and what is believed has its excuse."""
    run.record(tmp_path / "recorded")
    archive = mjrec.pack(tmp_path / "recorded", tmp_path / "run.zip", **run.packing)
    found = mjrec.verify(archive, **run.verifying)
    assert found.verdict is run.verdict, said(found)
    assert {each.name for each in found.excuses} == run.believed, said(found)
