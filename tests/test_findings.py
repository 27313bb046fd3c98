# SPDX-License-Identifier: Apache-2.0
"""The verdict from findings and excuses."""

import json

import pytest
from verifications import excuse, finding, verification

from mjrec.evidence.findings import Excuse, Finding, Level, Outcome, Topic, Verdict
from mjrec.formats.json_fields import from_json

RECREATED, WITHIN = finding(), finding(Outcome.WITHIN_TOLERANCE, excuse="gl")
BELIEVED = finding(Outcome.BELIEVED, reason="actions were not kept")
DIFFERENT, NOTED = finding(Outcome.DIFFERENT), finding(Outcome.NOTED)
FILES = finding(topic=Topic.FILES)
ALLOWED, REFUTED = excuse(allowed=True), excuse(refuted=True, allowed=True)


@pytest.mark.parametrize(
    ("findings", "excuses", "level", "verdict"),
    [
        ([RECREATED, NOTED], [], Level.PIXELS, "PASS"),
        ([RECREATED, BELIEVED], [], Level.PIXELS, "PARTLY"),
        ([RECREATED], [], Level.PHYSICS, "PARTLY"),
        ([RECREATED, WITHIN], [excuse()], Level.PIXELS, "PARTLY"),
        ([RECREATED, WITHIN], [ALLOWED], Level.PIXELS, "PASS"),
        ([RECREATED, BELIEVED], [ALLOWED], Level.PIXELS, "PARTLY"),
        # One of two graphics cards is allowed.
        ([RECREATED, WITHIN], [ALLOWED, excuse()], Level.PIXELS, "PARTLY"),
        ([RECREATED, DIFFERENT], [], Level.PIXELS, "FAIL"),
        ([RECREATED], [REFUTED], Level.PIXELS, "FAIL"),
        # Nothing was recreated by simulation.
        ([FILES, BELIEVED], [], Level.PIXELS, "FAIL"),
        ([], [], Level.PIXELS, "FAIL"),
        ([FILES], [], Level.FILES, "PARTLY"),
    ],
)
def test_verdict_is_never_better_than_the_proof(findings, excuses, level, verdict):
    result = verification(*findings, excuses=excuses, level=level)
    assert result.verdict is Verdict[verdict]
    # As documented, for CI.
    assert [each.exit_status for each in Verdict] == [0, 3, 1]


def test_verification_as_json():
    rest = {"inputs": {"a": 1}, "facts": {"b": 2}}
    result = verification(RECREATED, excuses=(excuse(),), **rest)
    content = json.loads(json.dumps(result.as_json()))
    assert content["verdict"] == "PASS"
    assert from_json(Finding, content["findings"][0]) == RECREATED
    assert from_json(Excuse, content["excuses"][0]) == excuse()
    assert (content["inputs"], content["facts"]) == ({"a": 1}, {"b": 2})
