# SPDX-License-Identifier: Apache-2.0
"""The page of a verification, also with hostile text."""

import html.parser
import re
import sys
from pathlib import Path

import pytest
from browsers import barriers_of, chromium
from verifications import HOSTILE, excuse, finding, verification

from mjrec import MissingDependency
from mjrec.evidence.findings import Outcome, Topic
from mjrec.evidence.verification_report import write_verification_report


class Page(html.parser.HTMLParser):
    """Writes and parses a page about findings."""

    def __init__(self, tmp_path, *findings, **changes):
        super().__init__()
        self.path = tmp_path / "verify.html"
        write_verification_report(verification(*findings, **changes), self.path)
        self.text = self.path.read_text(encoding="utf-8")
        self.kinds, self.attributes, self.open, self.words = set(), set(), [], []
        self.feed(self.text)
        self.close()
        self.shown = " ".join(filter(None, self.words))

    def handle_starttag(self, tag, attrs):
        self.kinds.add(tag)
        self.attributes.update(name for name, _ in attrs)
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.words.append(" ".join(data.split()))


def test_the_verdict_comes_first_and_then_differences(tmp_path):
    """Excuses, inputs, and lines for topics and findings follow."""
    page = Page(
        tmp_path,
        finding(reason="seven steps"),
        finding(Outcome.DIFFERENT, reason="frame 3 is another"),
        finding(Outcome.BELIEVED, reason="one is missing", is_headline=True),
        excuses=(excuse(),),
        inputs={"recording 0.u": {"max_episode_steps": 12}},
        facts={"versions": {"mujoco": "3.17.0"}},
    )
    order = [
        "FAIL run.zip: it does not match what its inputs produce",
        "one is missing",
        "frame 3 is another",
        "NVIDIA H100 (here llvmpipe)",
        "What was recreated",
        "max_episode_steps 12",
        "All findings",
        "seven steps",
        "versions: mujoco 3.17.0",
    ]
    assert sorted(order, key=page.shown.index) == order
    assert all(str(topic) in page.shown for topic in Topic)


def test_the_command_has_the_options_of_the_verification(tmp_path):
    facts = {"sample": 20, "seed": 7, "trust": ["A b-v0"], "allow": ["gl=H100"]}
    shown = Page(tmp_path, facts=facts).shown
    assert (
        "mjrec verify run.zip --level pixels --sample 20 --seed 7 --trust 'A b-v0' "
        "--allow gl=H100"
    ) in shown
    assert "It runs the installed code of A b-v0, but no other code that" in shown
    assert "It runs no code that the archive names" in Page(tmp_path).shown


def test_hostile_text_stays_text_and_the_page_loads_nothing(tmp_path):
    inputs = {"a": {"b": "c"}}
    rest = {"excuses": (excuse(),), "inputs": inputs, "facts": inputs}
    clean = Page(tmp_path, *map(finding, Outcome), **rest)
    hostile = Page(
        tmp_path,
        *(finding(each, item=HOSTILE, reason=HOSTILE) for each in Outcome),
        path=Path(f"somewhere/{HOSTILE.replace('/', '')}"),
        excuses=(excuse(claimed=HOSTILE, here=HOSTILE),),
        inputs={HOSTILE: {HOSTILE: HOSTILE}},
        facts={HOSTILE: {"x": HOSTILE}, "sample": 2, "seed": 1, "trust": [HOSTILE]},
    )
    assert hostile.kinds == clean.kinds
    kinds = {"script", "link", "iframe", "object", "form", "base"}
    assert clean.kinds.isdisjoint(kinds)
    for page in (clean, hostile):
        assert page.open == []
        assert page.attributes.isdisjoint({"src", "href"})
        assert not any(name.startswith("on") for name in page.attributes)
        assert "default-src 'none'" in page.text
    assert not re.search(r"url\(|@import|https?:", clean.text)
    assert "\u202e" not in hostile.text
    assert "\x00" not in hostile.text
    assert "\\u202e" in hostile.text
    assert "{{7*7}}" in hostile.text


def test_size_of_the_page_is_limited(tmp_path):
    """Omitted findings are counted."""
    many = [finding(Outcome.DIFFERENT, reason=f"{n} {'x' * 5000}") for n in range(1500)]
    page = Page(tmp_path, *many)
    assert len(page.text) < 2_000_000
    assert "And 1300 more" in page.shown
    assert "1300 more are not listed" in page.shown


def test_error_without_jinja_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(MissingDependency, match=r"pip install 'mjrec\[evidence\]'"):
        Page(tmp_path)
    assert not (tmp_path / "verify.html").exists()


@pytest.mark.axe
@pytest.mark.browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_is_accessible_and_fits_a_phone(tmp_path, scheme):
    """axe-core finds no serious barrier, and the page scrolls vertically only."""
    page = Page(
        tmp_path,
        *(finding(each, reason="x" * 300, is_headline=False) for each in Outcome),
        finding(Outcome.BELIEVED, reason=HOSTILE, is_headline=True),
        excuses=(excuse(),),
        inputs={"recording 0.u": {"camera": "side"}},
        facts={"versions": {"mujoco": "3.17.0"}},
    )
    viewport = {"width": 360, "height": 800}
    with chromium() as launch, launch() as browser:
        shown = browser.new_page(viewport=viewport, color_scheme=scheme)
        shown.goto(page.path.as_uri())
        shown.evaluate("document.querySelector('details').open = true")
        assert shown.evaluate("document.scrollingElement.scrollWidth") <= 360
        assert barriers_of(shown) == []
