# SPDX-License-Identifier: Apache-2.0
"""The report of a verification: one HTML file that loads no other files.

Its content may come from a hostile archive, so it is shown as text: escaped, shortened
if long, and with invisible characters (control characters, bidirectional marks) spelled
out.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from ..atomic_files import write_text
from ..errors import MissingDependency
from ..plain_text import counted, spelled_out
from . import summary
from .findings import Finding, Outcome, Topic, Verification

_TEMPLATE: Final = "verification_report.html.jinja"

_MEANINGS: Final = {
    Topic.IDENTITY: "The environment and the model match their names.",
    Topic.BEGINNING: "Seeds and options reproduce each episode's initial state.",
    Topic.PHYSICS: "The actions lead from each state to the next.",
    Topic.REWARDS: "Actions produce the rewards and ends, and so the statistics.",
    Topic.SELECTION: "The stated rule chooses the episodes that have a video.",
    Topic.VIDEOS: "Each video has the size, speed, length and camera that it states.",
    Topic.PICTURES: "The states produce the frames of the videos.",
    Topic.FILES: "All files are present and unchanged, with no extra files.",
}
# Failures first.
_ORDER: Final = (
    *(Outcome.DIFFERENT, Outcome.BELIEVED, Outcome.WITHIN_TOLERANCE),
    *(Outcome.NOTED, Outcome.RECREATED),
)
# Limits that keep the report readable and fast to load.
_MOST_LISTED: Final = 200
_LONGEST_TEXT: Final = 1500


def write_verification_report(verification: Verification, path: Path) -> None:
    """Write a verification as one HTML file.

    The page needs neither network nor scripts, and has styles for phones, dark mode and
    print. An existing file is replaced once the new one is complete.

    Raises:
        MissingDependency: Jinja2 is not installed.
        FileNotWritten: the file cannot be written.
    """
    template = _template()
    write_text(path, template.render(**_page(verification)) + "\n")


def _template() -> Any:
    try:
        # Imported here, because Jinja2 is an extra that only reports need.
        import jinja2
    except ImportError as error:
        raise MissingDependency(
            "Jinja2",
            purpose="Writing a report",
            install="pip install 'mjrec[evidence]'",
        ) from error
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_shown,
    )
    return environment.get_template(_TEMPLATE)


def _page(verification: Verification) -> dict[str, Any]:
    ordered = sorted(verification.findings, key=lambda f: _ORDER.index(f.outcome))
    different = summary.failures(verification)
    return {
        "name": verification.path.name or str(verification.path),
        "verdict": str(verification.verdict),
        "styles": summary.STYLES,
        "headline": summary.headline(verification),
        "remarks": summary.remarks(verification)[:_MOST_LISTED],
        "different": different[:_MOST_LISTED],
        "left_out": len(different[_MOST_LISTED:]),
        "lines": summary.lines(verification),
        "meanings": _MEANINGS,
        "excuses": summary.excuses(verification)[:_MOST_LISTED],
        "inputs": summary.inputs(verification)[:_MOST_LISTED],
        "findings": [_row(finding) for finding in ordered[:_MOST_LISTED]],
        "findings_left_out": len(ordered[_MOST_LISTED:]),
        "facts": list(_flat(verification.facts)),
        "trusted": list(verification.facts.get("trust") or ()),
        "command": _command(verification),
    }


def _row(finding: Finding) -> dict[str, str]:
    return {
        "outcome": str(finding.outcome),
        "topic": str(finding.topic),
        "subject": finding.item or "the whole run",
        "extent": counted(finding.count, finding.unit),
        "reason": finding.reason,
    }


def _flat(facts: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Yield nested facts as a flat list, with names such as `versions: numpy`."""
    for key, value in facts.items():
        name = f"{above}: {key}" if above else str(key)
        if isinstance(value, Mapping):
            yield from _flat(value, name)
        elif isinstance(value, list | tuple):
            yield name, ", ".join(map(str, value)) or "none"
        else:
            yield name, "none" if value is None else str(value)


def _command(verification: Verification) -> str:
    command = ["mjrec", "verify", verification.path.name or str(verification.path)]
    command += ["--level", str(verification.level)]
    facts = verification.facts
    for option in ("sample", "seed"):
        if isinstance(facts.get(option), int) and facts.get("sample") is not None:
            command += [f"--{option}", str(facts[option])]
    for option in ("trust", "allow"):
        for value in facts.get(option) or ():
            command += [f"--{option}", str(value)]
    return shlex.join(command)


def _shown(value: Any) -> Any:
    return spelled_out(value, _LONGEST_TEXT) if isinstance(value, str) else value
