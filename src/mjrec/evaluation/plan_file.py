# SPDX-License-Identifier: Apache-2.0
"""`evaluation.json`: what was asked for, written before anything is run."""

from __future__ import annotations

from pathlib import Path

from .. import atomic_files
from ..errors import DifferentEvaluation, UnreadableFile
from ..formats.json_fields import field, integer, read_object, unreadable
from ..json_text import dumps
from .dataclass_json import from_json, to_json
from .plan import SUITE, EvaluationPlan
from .results_files import FORMAT_VERSION, PLAN_NAME

# What may be asked for anew, and what follows from it or changes no result.
_MAY_DIFFER = ("tasks", "chunks", "episode_timeout")


def write_plan(directory: Path, plan: EvaluationPlan) -> None:
    """Write the plan into an evaluation's directory.

    Raises:
        FileNotWritten: the disk is full, or the directory is gone or read-only.
    """
    value = {"format_version": FORMAT_VERSION, "plan": to_json(plan)}
    atomic_files.write_text(directory / PLAN_NAME, dumps(value, indent=2) + "\n")


def read_plan(directory: Path) -> EvaluationPlan:
    """Return the plan of the evaluation in a directory.

    Raises:
        UnreadableFile: it is missing, damaged, or of a newer format.
    """
    path = directory / PLAN_NAME
    with unreadable(path):
        value = read_object(path)
        version = field(value, "format_version", integer)
        if version != FORMAT_VERSION:
            raise UnreadableFile(
                path,
                f"its format is version {version}, and this mjrec reads "
                f"{FORMAT_VERSION}",
            )
        return field(value, "plan", lambda plan: from_json(EvaluationPlan, plan))


def check_continues(
    directory: Path, begun: EvaluationPlan, asked: EvaluationPlan
) -> None:
    """Check that what is asked for goes on with what was begun.

    Other tasks and more seeds may be asked for, and more episodes; with the protocol
    `"suite"` not those, whose number belongs to the unit of work. All else makes other
    results, or other videos; and those who leave episodes out have seen their returns.

    Raises:
        DifferentEvaluation: it does not.
    """
    was, now = to_json(begun), to_json(asked)
    for plan in (was, now):
        plan["policy"] = "an object" if plan.pop("is_object") else plan["policy"]
        for part, digest in plan.pop("policy_digests").items():
            plan[f"policy ({part})"] = f"{digest[:12]}..."
    may_differ = [*_MAY_DIFFER]
    if set(begun.seeds) <= set(asked.seeds):
        may_differ.append("seeds")
    if asked.protocol != SUITE and asked.episodes > begun.episodes:
        may_differ.append("episodes")
    differences = {
        name: (was.get(name), now.get(name))
        for name in was | now
        if was.get(name) != now.get(name) and name not in may_differ
    }
    if differences:
        raise DifferentEvaluation(directory, differences)
