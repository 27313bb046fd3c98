# SPDX-License-Identifier: Apache-2.0
"""The report of a verification: one HTML file for people, that loads nothing.

Whatever is in it may come from a hostile archive. It is shown as text: escaped, cut
where it is long, and with what nobody sees (control characters, marks that turn the
direction of writing) spelled out.
"""

from __future__ import annotations

import base64
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from ...atomic_files import write_text
from ...errors import MissingDependency
from ..verification import Check, Level, Verdict, Verification
from .difference_picture import AMPLIFIED

_TEMPLATE: Final = "verification_report.html.jinja"

_MEANINGS: Final = {
    Level.FILES: "Every file is there and unchanged since it was packed, and nothing "
    "was added.",
    Level.STATS: "Lengths and returns follow from the recorded rewards, and the "
    "episodes with a video are those that the stated rule chooses.",
    Level.PHYSICS: "The recorded states follow from the recorded actions by the "
    "simulator's own laws.",
    Level.PIXELS: "The videos show the recorded states, frame by frame.",
}
_STYLES: Final = {
    Verdict.PASS: "pass",
    Verdict.FAIL: "fail",
    Verdict.NOT_CHECKABLE: "open",
}
# Failures first.
_ORDER: Final = (Verdict.FAIL, Verdict.NOT_CHECKABLE, Verdict.PASS)

# What a browser shows at once, and somebody reads.
_MOST_ROWS: Final = 1000
_MOST_GROUPS: Final = 200
_MOST_PICTURES: Final = 24
_MOST_SUBJECTS: Final = 5
_LONGEST_TEXT: Final = 1500
_LARGEST_PICTURE: Final = 1 << 26

_PICTURE: Final = re.compile(r"[A-Za-z0-9-]{1,80}\.png", re.ASCII)


def write_verification_report(
    verification: Verification, path: Path, *, pictures: Path | None = None
) -> None:
    """Write what a verification has found as one HTML file.

    It needs no network and no scripts, and can be read on a phone, in the dark and on
    paper. A file of that name is replaced when the new one is whole.

    Args:
        verification: what was found.
        path: the file.
        pictures: the folder of the pictures that the checks name.

    Raises:
        MissingDependency: there is no Jinja2.
        FileNotWritten: the file cannot be written.
    """
    template = _template()
    write_text(path, template.render(**_page(verification, pictures)) + "\n")


def _template() -> Any:
    try:
        # Here, because it is an extra: verifying without a report needs none.
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


class _Row(NamedTuple):
    """A check, as the page shows it."""

    level: str
    claim: str
    subject: str
    verdict: str
    style: str
    reason: str


class _Group(NamedTuple):
    """Checks of one claim that end alike."""

    level: str
    claim: str
    reason: str
    subjects: str


class _Holding(NamedTuple):
    """A claim that holds, and of how much."""

    claim: str
    extent: str


class _LevelRows(NamedTuple):
    """A level, and what came of it."""

    name: str
    meaning: str
    was_asked: bool
    passed: int
    failed: int
    not_checkable: int
    total: str
    rows: Sequence[_Row]
    left_out: int


class _Encoded(str):
    """What this module has encoded itself, however long it is."""

    __slots__ = ()


class _Figure(NamedTuple):
    """The frame of a video that differs most."""

    subject: str
    frame: str
    told: str
    data: _Encoded


def _page(verification: Verification, pictures: Path | None) -> dict[str, Any]:
    """Return what the template shows."""
    checks = verification.checks
    failed = [_row(check) for check in verification.failures]
    still_open = _grouped(c for c in checks if c.verdict is Verdict.NOT_CHECKABLE)
    with_pictures = _with_pictures(checks, pictures)
    return {
        "name": verification.path.name or str(verification.path),
        "headline": _headline(verification),
        "extent": _extent(verification),
        "failed": failed[:_MOST_GROUPS],
        "failed_left_out": len(failed[_MOST_GROUPS:]),
        "levels": [_level(verification, level) for level in Level],
        "proved": _proved(checks)[:_MOST_GROUPS],
        "open": still_open[:_MOST_GROUPS],
        "open_left_out": len(still_open[_MOST_GROUPS:]),
        "figures": [_figure(*pair) for pair in with_pictures[:_MOST_PICTURES]],
        "figures_left_out": len(with_pictures[_MOST_PICTURES:]),
        "amplified": AMPLIFIED,
        "facts": list(_flat(verification.facts)),
        "command": _command(verification),
    }


def _headline(verification: Verification) -> str:
    total, failed = len(verification.checks), len(verification.failures)
    if failed:
        return f"This run does not hold: {failed} of {_checks(total)} failed."
    if not verification.count(Verdict.PASS):
        return "Nothing was proved: nothing could be checked."
    if verification.count(Verdict.NOT_CHECKABLE):
        return "Everything that could be checked holds."
    return "Everything holds."


def _extent(verification: Verification) -> str:
    passed = verification.count(Verdict.PASS)
    still_open = verification.count(Verdict.NOT_CHECKABLE)
    asked = ", ".join(verification.level.included)
    not_made = f"; {still_open} could not be made" if still_open else ""
    return f"Levels: {asked}. {_checks(passed)} passed{not_made}."


def _checks(count: int) -> str:
    return "1 check" if count == 1 else f"{count} checks"


def _level(verification: Verification, level: Level) -> _LevelRows:
    checks = [check for check in verification.checks if check.level is level]
    ordered = sorted(checks, key=lambda check: _ORDER.index(check.verdict))
    verdicts = [check.verdict for check in checks]
    return _LevelRows(
        name=str(level),
        meaning=_MEANINGS[level],
        was_asked=level in verification.level.included,
        passed=verdicts.count(Verdict.PASS),
        failed=verdicts.count(Verdict.FAIL),
        not_checkable=verdicts.count(Verdict.NOT_CHECKABLE),
        total=_checks(len(checks)),
        rows=[_row(check) for check in ordered[:_MOST_ROWS]],
        left_out=len(ordered[_MOST_ROWS:]),
    )


def _row(check: Check) -> _Row:
    return _Row(
        level=str(check.level),
        claim=check.claim,
        subject=check.subject,
        verdict=str(check.verdict),
        style=_STYLES[check.verdict],
        reason=check.reason,
    )


def _proved(checks: Sequence[Check]) -> list[_Holding]:
    """Return what holds of anything, one line for each claim."""
    claims: dict[str, list[Check]] = {}
    for check in checks:
        claims.setdefault(check.claim, []).append(check)
    return [
        _Holding(_sentence(claim), _extent_of(members))
        for claim, members in claims.items()
        if any(check.verdict is Verdict.PASS for check in members)
    ]


def _extent_of(checks: Sequence[Check]) -> str:
    """Return of how many a claim holds, or of what, where there is one only."""
    if len(checks) == 1:
        told = ", ".join(filter(None, (checks[0].subject, checks[0].reason)))
        return told or "so it is"
    held = sum(check.verdict is Verdict.PASS for check in checks)
    return f"{held} of {len(checks)}"


def _grouped(checks: Iterable[Check]) -> list[_Group]:
    """Return checks of one claim and with one reason as one."""
    groups: dict[tuple[str, str, str], list[Check]] = {}
    for check in checks:
        key = str(check.level), check.claim, check.reason
        groups.setdefault(key, []).append(check)
    return [
        _Group(level, _sentence(claim), reason, _subjects(members))
        for (level, claim, reason), members in groups.items()
    ]


def _sentence(claim: str) -> str:
    return claim[:1].upper() + claim[1:]


def _subjects(checks: Sequence[Check]) -> str:
    named = [check.subject for check in checks if check.subject]
    more = len(named) - _MOST_SUBJECTS
    shown = ", ".join(named[:_MOST_SUBJECTS])
    return f"{shown} and {more} more" if more > 0 else shown


def _with_pictures(
    checks: Sequence[Check], folder: Path | None
) -> list[tuple[Check, Path]]:
    """Return the checks that have a picture: failures first, then the worst frames."""
    if folder is None:
        return []
    shown = [(c, path) for c in checks if (path := _picture(c, folder)) is not None]
    return sorted(shown, key=lambda pair: _order_of_picture(pair[0]))


def _order_of_picture(check: Check) -> tuple[int, float]:
    psnr = check.figures.get("psnr")
    number = float(psnr) if isinstance(psnr, int | float) else 0.0
    return _ORDER.index(check.verdict), number


def _figure(check: Check, picture: Path) -> _Figure:
    return _Figure(
        subject=check.subject,
        frame=str(check.figures.get("worst_frame", "")),
        told=_sentence(check.reason),
        data=_Encoded(base64.b64encode(picture.read_bytes()).decode("ascii")),
    )


def _picture(check: Check, folder: Path) -> Path | None:
    """Return the picture that a check names, if there is one in the folder."""
    name = check.figures.get("picture")
    if not isinstance(name, str) or not _PICTURE.fullmatch(name):
        return None
    path = folder / name
    if path.is_symlink() or not path.is_file():
        return None
    return path if path.stat().st_size <= _LARGEST_PICTURE else None


def _flat(facts: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Yield facts in facts as one list, with names such as `versions: numpy`."""
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
    for option in ("sample", "seed"):
        value = verification.facts.get(option)
        if isinstance(value, int) and verification.facts.get("sample") is not None:
            command += [f"--{option}", str(value)]
    trusted = verification.facts.get("trust")
    for identity in trusted if isinstance(trusted, list | tuple) else ():
        command += ["--trust", str(identity)]
    return shlex.join(command)


def _shown(value: Any) -> Any:
    """Return a text with what nobody sees spelled out, and cut where it is long."""
    if not isinstance(value, str) or isinstance(value, _Encoded):
        return value
    if len(value) > _LONGEST_TEXT:
        value = f"{value[:_LONGEST_TEXT]} ..."
    if value.isprintable():
        return value
    return "".join(
        c if c.isprintable() or c == "\n" else f"\\u{ord(c):04x}" for c in value
    )
