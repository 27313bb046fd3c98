# SPDX-License-Identifier: Apache-2.0
"""What an author states of a packed run: its title, its authors, its licence."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from ...errors import InvalidArgument, MissingDependency

_AUTHOR = re.compile(r"(?P<name>[^<>]+?)\s*(<\s*(?P<inside>[^<>\s]+)\s*>)?")
_ORCID = re.compile(r"(https?://orcid\.org/)?(?P<digits>(\d{4}-){3}\d{3}[\dX])")
_EMAIL = re.compile(r"[^@\s]+@[^@\s]+\.[^@\s]+")
_URL = re.compile(r"https?://\S+")
_LONGEST = 1000


@dataclass(frozen=True, kw_only=True)
class Author:
    """One of the authors.

    Attributes:
        name: as it is to be shown.
        given: the given names, as far as the name tells.
        family: the family name, or the only one.
        orcid: the URL of the ORCID, where it is known.
        email: where it is known.
    """

    name: str
    given: str
    family: str
    orcid: str | None = None
    email: str | None = None


@dataclass(frozen=True, kw_only=True)
class License:
    """A licence.

    Attributes:
        name: what it is called: its SPDX identifier, or its URL.
        url: where it can be read.
        spdx: its SPDX identifier, where it has one.
    """

    name: str
    url: str
    spdx: str | None = None


@dataclass(frozen=True, kw_only=True)
class Statements:
    """What is stated of a run.

    Attributes:
        title: of the run; None where it is to be called by what was recorded.
        authors: in their order.
        license: None where none was stated.
        anonymous: nobody is to be named; there are no authors then.
    """

    title: str | None = None
    authors: tuple[Author, ...] = ()
    license: License | None = None
    anonymous: bool = False


def state(
    *,
    title: str | None,
    authors: Iterable[str] | None,
    license: str | None,
    anonymous: bool,
) -> Statements:
    """Return what is stated, checked. What is anonymous has no authors.

    Raises:
        InvalidArgument: a title, an author or a licence that cannot be.
    """
    if isinstance(authors, str):
        raise InvalidArgument(
            f"authors is a list of texts, one for each author, got {authors!r}."
        )
    known = tuple(_author(text) for text in authors or ())
    return Statements(
        title=None if title is None else _line("title", title),
        authors=() if anonymous else known,
        license=None if license is None else _license(license),
        anonymous=anonymous,
    )


def _author(text: object) -> Author:
    line = _line("An author", text)
    match = _AUTHOR.fullmatch(line)
    orcid, email = _inside(match["inside"]) if match else (None, None)
    if match is None or (match["inside"] and not (orcid or email)):
        raise InvalidArgument(
            'An author is "Name", "Name <address>" or "Name <ORCID>", such as '
            f'"Ada Lovelace <0000-0002-1825-0097>", got {text!r}.'
        )
    given, family = _names(match["name"])
    name = " ".join(filter(None, [given, family]))
    return Author(name=name, given=given, family=family, orcid=orcid, email=email)


def _inside(text: str | None) -> tuple[str | None, str | None]:
    """Return the ORCID's URL and the address that stand behind a name."""
    orcid = _ORCID.fullmatch(text or "")
    if orcid is not None and _is_orcid(orcid["digits"]):
        return f"https://orcid.org/{orcid['digits']}", None
    return None, text if _EMAIL.fullmatch(text or "") else None


def _is_orcid(text: str) -> bool:
    """Tell whether the last character fits the digits before it (ISO 7064, 11-2)."""
    total = 0
    for digit in text.replace("-", "")[:-1]:
        total = (total + int(digit)) * 2
    check = (12 - total % 11) % 11
    return text[-1] == ("X" if check == 10 else str(check))


def _names(name: str) -> tuple[str, str]:
    """Return the given names and the family name.

    "Family, Given" says which is which; else the last word is the family name.
    """
    if "," in name:
        family, _, given = name.partition(",")
        return given.strip(), family.strip()
    given, _, family = name.rpartition(" ")
    return given.strip(), family


def _license(text: object) -> License:
    line = _line("license", text)
    if _URL.fullmatch(line):
        return License(name=line, url=line)
    spdx = _spdx_identifier(line)
    # No expression of several, and none that only its author knows.
    if not spdx or " " in spdx or spdx.startswith("LicenseRef-"):
        raise InvalidArgument(
            "license is the identifier of one licence in the list of SPDX "
            '(https://spdx.org/licenses), such as "CC-BY-4.0", or the URL of its text, '
            f"got {text!r}."
        )
    return License(name=spdx, url=f"https://spdx.org/licenses/{spdx}", spdx=spdx)


def _spdx_identifier(text: str) -> str:
    """Return a licence as SPDX writes it; "" where it does not know it."""
    # Not at the top: only the extra `evidence` asks for a `packaging` that has it.
    try:
        from packaging import licenses
    except ImportError as error:
        raise MissingDependency(
            "packaging 24.2 or newer",
            purpose="Stating a licence",
            install='pip install "mjrec[evidence]"',
        ) from error
    try:
        return str(licenses.canonicalize_license_expression(text))
    except licenses.InvalidLicenseExpression:
        return ""


def _line(what: str, text: object) -> str:
    if not isinstance(text, str) or not text.strip():
        raise InvalidArgument(f"{what} must be a text, got {text!r}.")
    line = text.strip()
    if not line.isprintable() or len(line) > _LONGEST:
        raise InvalidArgument(
            f"{what} must be one line of at most {_LONGEST} characters, got "
            f"{text[:80]!r}."
        )
    return line
