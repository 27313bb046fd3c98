# SPDX-License-Identifier: Apache-2.0
"""`CITATION.cff`: how a packed run is cited, in the Citation File Format 1.2.0."""

from __future__ import annotations

import json
from collections.abc import Iterator

from .packed_run import PackedRun
from .statements import Author


def citation(run: PackedRun) -> str:
    """Return the content of the file, which is YAML.

    The format wants at least one author; where none was stated it says that.
    """
    return "".join(f"{line}\n" for line in _lines(run))


def _lines(run: PackedRun) -> Iterator[str]:
    yield "cff-version: 1.2.0"
    yield 'message: "If you use these recordings, please cite them as below."'
    yield "type: dataset"
    yield f"title: {_quoted(run.title)}"
    yield "authors:"
    for author in run.statements.authors:
        yield from _of_author(author)
    if not run.statements.authors:
        withheld = run.statements.anonymous
        yield f"  - name: {_quoted('Anonymous' if withheld else 'Not stated')}"
    yield f"date-released: {_quoted(run.date)}"
    license_ = run.statements.license
    if license_ is not None and license_.spdx is not None:
        yield f"license: {_quoted(license_.spdx)}"
    elif license_ is not None:
        yield f"license-url: {_quoted(license_.url)}"


def _of_author(author: Author) -> Iterator[str]:
    fields = {
        "family-names": author.family,
        "given-names": author.given,
        "email": author.email,
        "orcid": author.orcid,
    }
    known = [f"{key}: {_quoted(value)}" for key, value in fields.items() if value]
    yield f"  - {known[0]}"
    yield from (f"    {line}" for line in known[1:])


def _quoted(text: str) -> str:
    # A JSON string is a double-quoted YAML scalar, as long as nothing is escaped as a
    # pair of surrogates.
    return json.dumps(text, ensure_ascii=False)
