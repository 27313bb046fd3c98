# SPDX-License-Identifier: Apache-2.0
"""The page of a verification: what it says, and that nothing can be slipped into it."""

from __future__ import annotations

import base64
import html.parser
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imageio.v3 import imwrite

from mjrec.evidence.verification import Check, Level, Verdict, Verification
from mjrec.evidence.verifying.verification_report import write_verification_report

HOSTILE = (
    "</li><script>alert(1)</script><img src=x onerror=alert(1)>\u202e\x00'\"{{7*7}}"
)


def check(verdict: Verdict = Verdict.PASS, **changes: Any) -> Check:
    usual: dict[str, Any] = {
        "level": Level.PIXELS,
        "claim": "the shipped frames show the pictures drawn",
        "subject": "a.mp4",
        "verdict": verdict,
        "reason": "21 frames",
    }
    return Check(**{**usual, **changes})


def page(tmp_path: Path, *checks: Check, **changes: Any) -> str:
    pictures = changes.pop("pictures", None)
    usual: dict[str, Any] = {
        "path": Path("somewhere/run.zip"),
        "level": Level.PIXELS,
        "checks": checks,
    }
    verification = Verification(**{**usual, **changes})
    write_verification_report(verification, tmp_path / "verify.html", pictures=pictures)
    return (tmp_path / "verify.html").read_text(encoding="utf-8")


class Elements(html.parser.HTMLParser):
    """Collects what a page is made of."""

    VOID = ("meta", "img", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.text.append(" ".join(data.split()))


def words(text: str) -> str:
    return " ".join(filter(None, Elements(text).text))


@pytest.mark.parametrize(
    ("verdicts", "headline"),
    [
        ([Verdict.PASS], "Everything holds."),
        ([Verdict.PASS, Verdict.NOT_CHECKABLE], "Everything that could be checked"),
        ([Verdict.NOT_CHECKABLE], "Nothing was proved"),
        ([], "Nothing was proved"),
        ([Verdict.PASS, Verdict.FAIL], "This run does not hold: 1 of 2 checks failed."),
    ],
)
def test_the_verdict_comes_first(
    tmp_path: Path, verdicts: list[Verdict], headline: str
) -> None:
    """In words, and never better than what was proved."""
    shown = words(page(tmp_path, *map(check, verdicts)))
    assert shown.startswith(
        f"Verification of run.zip Verification of run.zip {headline}"
    )


def test_failures_stand_before_all_else(tmp_path: Path) -> None:
    """With their reason; and what could not be checked, with its own."""
    shown = words(
        page(
            tmp_path,
            check(reason="seven frames"),
            check(Verdict.NOT_CHECKABLE, subject="b.mp4", reason="no model is there"),
            check(Verdict.FAIL, subject="c.mp4", reason="frame 3 is another"),
        )
    )
    assert shown.index("frame 3 is another") < shown.index("What was checked")
    assert "Not so: the shipped frames show the pictures drawn." in shown
    assert "no model is there" in shown
    assert "The shipped frames show the pictures drawn: 1 of 3." in shown


def test_levels_that_were_not_asked_for_are_said_so(tmp_path: Path) -> None:
    """A report of the files alone does not look like one of everything."""
    shown = words(page(tmp_path, check(level=Level.FILES), level=Level.FILES))
    assert shown.count("Not asked for.") == 3
    assert "mjrec verify run.zip --level files" in shown


def test_the_page_is_whole_and_loads_nothing(tmp_path: Path) -> None:
    """Its elements close, and no attribute leads anywhere."""
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    imwrite(pictures / "worst-000000.png", np.zeros((4, 4, 3), np.uint8))
    figures = {"picture": "worst-000000.png", "worst_frame": 3, "psnr": 44.0}
    text = page(tmp_path, check(figures=figures), pictures=pictures)
    elements = Elements(text)
    assert elements.open == []
    names = {name for name, _ in elements.found}
    assert names.isdisjoint({"script", "link", "iframe", "object", "form", "base"})
    sources = [
        v for _, a in elements.found for k, v in a.items() if k in ("src", "href")
    ]
    [source] = sources
    kind, _, data = str(source).partition(",")
    assert kind == "data:image/png;base64"
    assert base64.b64decode(data).startswith(b"\x89PNG")
    assert "default-src 'none'" in text
    assert not re.search(r"url\(|@import|https?:", text)


def test_hostile_text_stays_text(tmp_path: Path) -> None:
    """Wherever it comes from: nothing is marked up, nothing is hidden."""
    clean = Elements(page(tmp_path, *map(check, Verdict), facts={"a": {"b": "c"}}))
    hostile = {"claim": HOSTILE, "subject": HOSTILE, "reason": HOSTILE}
    text = page(
        tmp_path,
        *(check(verdict, **hostile) for verdict in Verdict),
        path=Path(f"somewhere/{HOSTILE.replace('/', '')}"),
        facts={HOSTILE: {"x": HOSTILE}, "sample": 2, "seed": 1, "trust": [HOSTILE]},
    )
    dirty = Elements(text)
    kinds = {name for name, _ in dirty.found}
    assert kinds == {name for name, _ in clean.found}
    assert all(not name.startswith("on") for _, a in dirty.found for name in a)
    assert "\u202e" not in text
    assert "\x00" not in text
    assert "\\u202e" in text
    assert "{{7*7}}" in text


@pytest.mark.parametrize(
    "name", ["../secret.png", "/etc/passwd", "absent.png", "link.png", 7, "a\n.png"]
)
def test_only_pictures_of_the_folder_are_shown(tmp_path: Path, name: Any) -> None:
    """A name comes from a process that has read hostile files."""
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    secret = tmp_path / "secret.png"
    imwrite(secret, np.zeros((4, 4, 3), np.uint8))
    (pictures / "link.png").symlink_to(secret)
    text = page(tmp_path, check(figures={"picture": name}), pictures=pictures)
    assert "<img" not in text


def test_many_checks_make_no_endless_page(tmp_path: Path) -> None:
    """What is left out is counted."""
    many = [
        check(Verdict.FAIL, subject=f"{n}.mp4", reason="x" * 5000) for n in range(1500)
    ]
    text = page(tmp_path, *many)
    assert len(text) < 4_000_000
    assert "And 1300 more" in words(text)
    assert "500 more are not listed" in words(text)


def test_without_jinja_it_is_said_what_to_install(tmp_path: Path) -> None:
    """Verifying without a report needs none."""
    program = (
        "import sys; sys.modules['jinja2'] = None\n"
        "from pathlib import Path\n"
        "from mjrec.evidence.verification import Level, Verification\n"
        "from mjrec.evidence.verifying import verification_report as report\n"
        "found = Verification(path=Path('x'), level=Level.FILES, checks=())\n"
        "try:\n"
        "    report.write_verification_report(found, Path(sys.argv[1]))\n"
        "except report.MissingDependency as error:\n"
        "    print(error)\n"
    )
    said = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "verify.html")],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert "pip install 'mjrec[evidence]'" in said
    assert not (tmp_path / "verify.html").exists()
