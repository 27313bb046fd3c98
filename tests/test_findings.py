# SPDX-License-Identifier: Apache-2.0
"""The verdict that findings and excuses come to."""

import json

import pytest
from verifications import excuse, finding, verification

from mjrec.evidence.findings import Excuse, Finding, Level, Outcome, Topic, Verdict
from mjrec.formats.json_fields import from_json

MADE, WITHIN = finding(), finding(Outcome.WITHIN_TOLERANCE, excuse="gl")
BELIEVED = finding(Outcome.BELIEVED, reason="actions were not kept")
DIFFERENT, NOTED = finding(Outcome.DIFFERENT), finding(Outcome.NOTED)
OF_FILES = finding(topic=Topic.FILES)
PARTLY = Verdict.PARTLY


@pytest.mark.parametrize(
    ("findings", "excuses", "level", "verdict"),
    [
        ((MADE, NOTED), (), Level.PIXELS, Verdict.PASS),
        ((MADE, BELIEVED), (), Level.PIXELS, Verdict.PARTLY),
        ((MADE,), (), Level.PHYSICS, Verdict.PARTLY),
        ((MADE, WITHIN), (excuse(),), Level.PIXELS, Verdict.PARTLY),
        ((MADE, WITHIN), (excuse(allowed=True),), Level.PIXELS, Verdict.PASS),
        ((MADE, BELIEVED), (excuse(allowed=True),), Level.PIXELS, Verdict.PARTLY),
        # One graphics card is taken, and another one drew some of the videos.
        ((MADE, WITHIN), (excuse(allowed=True), excuse()), Level.PIXELS, PARTLY),
        ((MADE, DIFFERENT), (), Level.PIXELS, Verdict.FAIL),
        ((MADE,), (excuse(refuted=True, allowed=True),), Level.PIXELS, Verdict.FAIL),
        # Nothing of what only a simulation gives was recreated.
        ((OF_FILES, BELIEVED), (), Level.PIXELS, Verdict.FAIL),
        ((), (), Level.PIXELS, Verdict.FAIL),
        ((OF_FILES,), (), Level.FILES, Verdict.PARTLY),
    ],
)
def test_the_verdict_is_never_better_than_the_proof(findings, excuses, level, verdict):
    """PASS only where all is equal or allowed; FAIL where nothing is proved."""
    assert verification(*findings, excuses=excuses, level=level).verdict is verdict


def test_exit_statuses_tell_verdicts_apart():
    """As documented, for CI."""
    statuses = [verdict.exit_status for verdict in Verdict]
    assert statuses == [0, 3, 1]


def test_all_of_it_is_json():
    """The verdict, findings, excuses, inputs and facts."""
    made = verification(MADE, excuses=(excuse(),), inputs={"a": 1}, facts={"b": 2})
    said = json.loads(json.dumps(made.as_json()))
    assert said["verdict"] == "PASS"
    assert from_json(Finding, said["findings"][0]) == MADE
    assert from_json(Excuse, said["excuses"][0]) == excuse()
    assert (said["inputs"], said["facts"]) == ({"a": 1}, {"b": 2})
