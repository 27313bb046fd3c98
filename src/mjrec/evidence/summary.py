# SPDX-License-Identifier: Apache-2.0
"""Summary of a verification: verdict, excuses, and one line for each topic.

The terminal and the HTML report show the same text.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple

from .. import json_text
from ..formats.monitor_directory import FILE_PREFIX
from ..plain_text import counted, listed
from .findings import (
    Excuse,
    ExcuseKind,
    Finding,
    Level,
    Outcome,
    Topic,
    Verdict,
    Verification,
)

_MOST_ITEMS: Final = 3
_LONGEST_INPUT: Final = 100
# Worst first, because a line shows the worst outcome.
_ORDER: Final = (
    Outcome.DIFFERENT,
    Outcome.BELIEVED,
    Outcome.WITHIN_TOLERANCE,
    Outcome.RECREATED,
)
# Whether a verdict or an outcome is good, open or bad.
STYLES: Final[Mapping[str, str]] = {
    **dict.fromkeys(map(str, (Verdict.PASS, Outcome.RECREATED)), "pass"),
    **dict.fromkeys(
        map(str, (Verdict.PARTLY, Outcome.WITHIN_TOLERANCE, Outcome.BELIEVED)), "open"
    ),
    **dict.fromkeys(map(str, (Verdict.FAIL, Outcome.DIFFERENT)), "fail"),
}
_NOT_LOOKED_AT: Final = "not looked at"
# The outcome at the level "files".
_UNCHANGED: Final = "unchanged"
# The unit to show for a topic that is counted in several units.
_UNITS: Final = {
    Topic.REWARDS: "episode",
    Topic.SELECTION: "recording",
    Topic.FILES: "file",
}


class Line(NamedTuple):
    """The result for one topic.

    Attributes:
        topic: the topic.
        outcome: the worst outcome of its findings; "not looked at" if it has none.
        text: the number of recreated items, and any remarks.
    """

    topic: Topic
    outcome: str
    text: str


def headline(verification: Verification) -> str:
    """Return the verdict as a sentence."""
    name = verification.path.name or str(verification.path)
    match verification.verdict:
        case Verdict.PASS:
            taken = [e.name for e in verification.excuses if e.allowed]
            allowed = f" or is allowed ({', '.join(taken)})" if taken else ""
            return f"{name}: everything was recreated and matches{allowed}."
        case Verdict.PARTLY if verification.level is Level.FILES:
            return f"{name}: files are unchanged; nothing was recreated."
        case Verdict.PARTLY:
            return f"{name}: nothing contradicts it, but not everything is proved."
    count = sum(finding.count for finding in verification.failures)
    if count or any(excuse.refuted for excuse in verification.excuses):
        differ = f"{counted(count, 'place')} differ{'s' if count == 1 else ''}"
        return f"{name}: it does not match what its inputs produce; {differ}."
    return f"{name}: nothing could be recreated, so nothing is proved."


def remarks(verification: Verification) -> list[str]:
    """Return the remarks shown next to the verdict: gaps, identical episodes."""
    return [_said(each) for each in verification.findings if each.is_headline]


def failures(verification: Verification) -> list[str]:
    """Return the findings that contradict the archive."""
    return [_said(finding) for finding in verification.failures]


def excuses(verification: Verification) -> list[str]:
    """Return the excuses with their costs; those without a cost share one line."""
    known = verification.excuses
    needed = [each for each in known if each.is_needed or each.refuted]
    others = dict.fromkeys(_claim(each) for each in known if each not in needed)
    idle = [f"claimed, but not needed: {'; '.join(others)}"] if others else []
    return [*(_excuse(each, verification) for each in needed), *idle]


def lines(verification: Verification) -> list[Line]:
    """Return a line for each topic, in the topics' order."""
    found: dict[Topic, list[Finding]] = {topic: [] for topic in Topic}
    for finding in verification.findings:
        if not finding.is_headline:
            found[finding.topic].append(finding)
    return [Line(topic, *_line(topic, said)) for topic, said in found.items()]


def inputs(verification: Verification) -> list[str]:
    """Return the inputs that are not the default."""
    return [
        f"{name}: " + ", ".join(f"{key} {_short(value)}" for key, value in said.items())
        if isinstance(said, Mapping)
        else f"{name} {_short(said)}"
        for name, said in verification.inputs.items()
    ]


def sampled(verification: Verification) -> str | None:
    """Return the size and seed of the sample of frames; None if all were rendered."""
    count, seed = (verification.facts.get(key) for key in ("sample", "seed"))
    if count is None:
        return None
    return f"{count} frames of each video were rendered, chosen with --seed {seed}"


def _line(topic: Topic, found: list[Finding]) -> tuple[str, str]:
    outcomes = [each.outcome for each in found]
    worst = next((outcome for outcome in _ORDER if outcome in outcomes), None)
    if worst is None:
        is_bag = topic is Topic.FILES and found
        return _UNCHANGED if is_bag else _NOT_LOOKED_AT, "; ".join(_notes(found))
    texts = [
        f"{_counts(topic, (f for f in found if f.outcome is outcome))}"
        + (f" {outcome}" if outcome is not worst else "")
        for outcome in reversed(_ORDER)
        if outcome in outcomes and outcome is not Outcome.BELIEVED
    ]
    return str(worst), "; ".join([*texts, *_beliefs(found), *_notes(found)])


def _counts(topic: Topic, found: Iterable[Finding]) -> str:
    counts: Counter[str] = Counter()
    for finding in found:
        counts[finding.unit] += finding.count
    if (unit := _UNITS.get(topic)) in counts:
        counts = Counter({str(unit): counts[str(unit)]})
    if len(counts) > 1:
        # Counts of single values in files add little to the other units.
        del counts["value"]
    return ", ".join(counted(count, unit) for unit, count in counts.items())


def _beliefs(found: list[Finding]) -> Iterator[str]:
    for each in found:
        if each.outcome is Outcome.BELIEVED:
            yield f"{counted(each.count, each.unit)} believed: {each.reason}"


def _notes(found: list[Finding]) -> Iterator[str]:
    for each in found:
        if each.outcome is Outcome.NOTED and each.excuse is None:
            # The count of several findings that were merged.
            many = f" ({counted(each.count, each.unit)})" if each.count > 1 else ""
            yield f"{each.reason}{many}"


def _said(finding: Finding) -> str:
    subject = f"{finding.item}: " if finding.item else ""
    return f"{subject}{finding.reason}"


def _excuse(excuse: Excuse, verification: Verification) -> str:
    if excuse.refuted:
        return f"{_claim(excuse)}: refuted, because its effects would be visible"
    groups: dict[tuple[str, str], list[Finding]] = {}
    for each in verification.findings:
        if each.excuse == excuse.name and each.outcome is not Outcome.NOTED:
            groups.setdefault((each.unit, each.outcome), []).append(each)
    costs = [
        f"{counted(sum(each.count for each in found), unit)} {outcome}"
        f"{max(map(_worst, found))}"
        for (unit, outcome), found in groups.items()
        if unit != "value"
    ]
    # If recordings are named, their files need not be.
    items = tuple(i for i in excuse.items if not i.startswith(FILE_PREFIX))
    of = f" of {listed(items or excuse.items, _MOST_ITEMS)}" if excuse.items else ""
    allowed = ", allowed" if excuse.allowed else ""
    counts = f"; {', '.join(costs)}" if costs else ""
    return f"{_claim(excuse)}{of}{allowed}: {excuse.costs}{counts}"


def _claim(excuse: Excuse) -> str:
    here = f" (here {excuse.here})" if excuse.here else ""
    if excuse.kind is ExcuseKind.CODE and excuse.claimed:
        # The claim is a sentence.
        return f"{excuse.name} ({excuse.claimed})"
    return f"{excuse.name} {excuse.claimed}{here}".strip()


def _worst(finding: Finding) -> str:
    figures = finding.figures
    if "psnr" in figures:
        return f", the worst {figures['psnr']:.1f} dB"
    return f", at most {figures['maximum']:.1g} apart" if "maximum" in figures else ""


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json_text.dumps(value)
    return text if len(text) <= _LONGEST_INPUT else f"{text[:_LONGEST_INPUT]} ..."
