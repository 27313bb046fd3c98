# SPDX-License-Identifier: Apache-2.0
"""An author's statements about a packed run: its title, authors and license."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from ..errors import InvalidArgument, MissingDependency

_AUTHOR = re.compile(
    r"(?P<name>[^<>]+?)\s*(<\s*((?P<email>[^@\s<>]+@[^@\s<>]+\.[^@\s<>]+)|"
    r"(?:https?://orcid\.org/)?(?P<orcid>(\d{4}-){3}\d{3}[\dX]))\s*>)?"
)
_URL = re.compile(r"https?://\S+")
_LONGEST = 1000


@dataclass(frozen=True, kw_only=True)
class Author:
    """An author.

    Attributes:
        given: the given names; empty if there is only one name.
        family: the family name, or the only name.
        orcid: the URL of the ORCID, or None if unknown.
        email: the email address, or None if unknown.
    """

    given: str
    family: str
    orcid: str | None = None
    email: str | None = None

    @property
    def name(self) -> str:
        """The full name."""
        return f"{self.given} {self.family}".strip()


@dataclass(frozen=True, kw_only=True)
class License:
    """A license.

    Attributes:
        name: its SPDX identifier, or its URL.
        url: the URL of its text.
        spdx: its SPDX identifier, or None.
    """

    name: str
    url: str
    spdx: str | None = None


@dataclass(frozen=True, kw_only=True)
class Statements:
    """Checked statements about a run.

    Attributes:
        title: the run's title; None to generate one from the recorded environments.
        authors: the authors, in order.
        license: the license, or None if none was stated.
    """

    title: str | None = None
    authors: tuple[Author, ...] = ()
    license: License | None = None


def state(
    *, title: str | None, authors: Iterable[str] | None, license: str | None
) -> Statements:
    """Check and parse the statements about a run.

    Raises:
        InvalidArgument: the title, an author or the license is invalid.
        MissingDependency: a license is given as an SPDX identifier, but a recent
            `packaging` is not installed.
    """
    if isinstance(authors, str):
        raise InvalidArgument(
            f"authors must be a list of strings, one for each author, got {authors!r}."
        )
    return Statements(
        title=None if title is None else _line("title", title),
        authors=tuple(_author(text) for text in authors or ()),
        license=None if license is None else _license(license),
    )


def _author(text: object) -> Author:
    match = _AUTHOR.fullmatch(_line("An author", text))
    if match is None or not _is_orcid(match["orcid"]):
        raise InvalidArgument(
            'An author must be "Name", "Name <address>" or "Name <ORCID>", such as '
            f'"Ada Lovelace <0000-0002-1825-0097>", got {text!r}.'
        )
    # In "Family, Given" the comma separates them; otherwise the last word is the family
    # name.
    family, comma, given = match["name"].partition(",")
    if not comma:
        given, _, family = match["name"].rpartition(" ")
    orcid = match["orcid"] and f"https://orcid.org/{match['orcid']}"
    return Author(
        given=given.strip(), family=family.strip(), orcid=orcid, email=match["email"]
    )


def _is_orcid(text: str | None) -> bool:
    """Return whether the last character fits the digits before it (ISO 7064, 11-2)."""
    if text is None:
        return True
    total = 0
    for digit in text.replace("-", "")[:-1]:
        total = (total + int(digit)) * 2
    return text[-1] == "0123456789X"[(12 - total % 11) % 11]


def _license(text: object) -> License:
    line = _line("license", text)
    if _URL.fullmatch(line):
        return License(name=line, url=line)
    spdx = _spdx_identifier(line)
    # Expressions with several licenses and LicenseRefs, which are private, are invalid.
    if not spdx or " " in spdx or spdx.startswith("LicenseRef-"):
        raise InvalidArgument(
            "license must be the identifier of one license in the SPDX list "
            '(https://spdx.org/licenses), such as "CC-BY-4.0", or the URL of its text, '
            f"got {text!r}."
        )
    return License(name=spdx, url=f"https://spdx.org/licenses/{spdx}", spdx=spdx)


def _spdx_identifier(text: str) -> str:
    """Return a license's SPDX spelling, or "" if it is not in the SPDX list."""
    # Imported here: only the extra `evidence` requires a `packaging` that has it.
    try:
        from packaging import licenses
    except ImportError as error:
        raise MissingDependency(
            "packaging 24.2 or newer",
            purpose="Stating a license",
            install='pip install "mjrec[evidence]"',
        ) from error
    try:
        return str(licenses.canonicalize_license_expression(text))
    except licenses.InvalidLicenseExpression:
        return ""


def _line(what: str, text: object) -> str:
    line = text.strip() if isinstance(text, str) else ""
    if not line or not line.isprintable() or len(line) > _LONGEST:
        raise InvalidArgument(
            f"{what} must be one line of text with at most {_LONGEST} characters, got "
            f"{str(text)[:80]!r}."
        )
    return line
