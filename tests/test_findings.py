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
TAKEN, REFUTED = excuse(allowed=True), excuse(refuted=True, allowed=True)


@pytest.mark.parametrize(
    ("findings", "excuses", "level", "verdict"),
    [
        ([MADE, NOTED], [], Level.PIXELS, "PASS"),
        ([MADE, BELIEVED], [], Level.PIXELS, "PARTLY"),
        ([MADE], [], Level.PHYSICS, "PARTLY"),
        ([MADE, WITHIN], [excuse()], Level.PIXELS, "PARTLY"),
        ([MADE, WITHIN], [TAKEN], Level.PIXELS, "PASS"),
        ([MADE, BELIEVED], [TAKEN], Level.PIXELS, "PARTLY"),
        # One graphics card is taken, and another one drew some of the videos.
        ([MADE, WITHIN], [TAKEN, excuse()], Level.PIXELS, "PARTLY"),
        ([MADE, DIFFERENT], [], Level.PIXELS, "FAIL"),
        ([MADE], [REFUTED], Level.PIXELS, "FAIL"),
        # Nothing of what only a simulation gives was recreated.
        ([OF_FILES, BELIEVED], [], Level.PIXELS, "FAIL"),
        ([], [], Level.PIXELS, "FAIL"),
        ([OF_FILES], [], Level.FILES, "PARTLY"),
    ],
)
def test_the_verdict_is_never_better_than_the_proof(findings, excuses, level, verdict):
    """PASS only where all is equal or allowed; FAIL where nothing is proved."""
    found = verification(*findings, excuses=excuses, level=level)
    assert found.verdict is Verdict[verdict]
    # As documented, for CI.
    assert [each.exit_status for each in Verdict] == [0, 3, 1]


def test_all_of_it_is_json():
    """The verdict, findings, excuses, inputs and facts."""
    made = verification(MADE, excuses=(excuse(),), inputs={"a": 1}, facts={"b": 2})
    said = json.loads(json.dumps(made.as_json()))
    assert said["verdict"] == "PASS"
    assert from_json(Finding, said["findings"][0]) == MADE
    assert from_json(Excuse, said["excuses"][0]) == excuse()
    assert (said["inputs"], said["facts"]) == ({"a": 1}, {"b": 2})
