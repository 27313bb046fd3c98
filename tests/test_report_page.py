# SPDX-License-Identifier: Apache-2.0
"""The text of a report's page, and its figures; `test_report_browser` opens it."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from importlib.metadata import version
from urllib.parse import quote

import numpy as np
import pytest
from report_contents import HOSTILE, contents, hostile_report, task, video

from mjrec.evaluation.summaries import AcrossTasks, TaskSummary
from mjrec.reporting.contents import ReportContents
from mjrec.reporting.curves import evaluation_curve, learning_curve
from mjrec.reporting.page import page_of
from mjrec.reporting.page_text import number


class Elements(HTMLParser):
    """What a page consists of."""

    def __init__(self, page):
        super().__init__()
        self.found = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def named(self, tag):
        return [attributes for name, attributes in self.found if name == tag]

    def players(self):
        return [link for link in self.named("a") if link.get("class") == "play"]


def data_of(page):
    """Return what the page's script reads."""
    found = re.search(r'id="episodes-data">(.*?)</script>', page, re.DOTALL)
    return json.loads(found[1])


def page_with(*videos):
    """Return the page of the usual report, whose first task has these videos."""
    made = contents()
    made.tasks[0].videos = videos
    return page_of(made)


# --- Texts of strangers -----------------------------------------------------------


def test_texts_of_strangers_stay_text():
    """There are no elements, handlers or styles but the page's own, nothing unseen."""
    page = page_of(hostile_report())
    elements = Elements(page)
    assert len(elements.named("script")) == 2
    assert {image["src"] for image in elements.named("img")} == {
        f"./{quote(text, safe='/')}" for text in HOSTILE
    }
    attributes = {name for _, found in elements.found for name in found}
    assert not [name for name in attributes if name[:2] == "on" or name == "style"]
    assert not set("\u202e\u2028\x00\x1b") & set(page)
    assert r"abc\u202edef\u2028ghi" in page
    # Every address is of a file beside the page, or a place on it.
    addresses = [
        found[name]
        for _, found in elements.found
        for name in ("src", "href", "poster", "action", "data", "xlink:href")
        if name in found
    ]
    assert addresses
    assert all(re.match(r"\./|#|data:,$", address or "") for address in addresses)
    assert not re.search(r"https?://|url\(", page)
    # Long texts are cut, so that a page of them can be read.
    assert not re.search("x{1001}", page.split('id="videos"')[0])
    # No name ends the element that the script reads.
    assert data_of(page)["tasks"][1]["name"] == HOSTILE[1]


# --- What it shows ----------------------------------------------------------------


def test_a_card_says_what_a_video_shows():
    """Its episode, its size, how it is made again, and by which rule it was chosen."""
    made = video(12, notes=["Chosen by best:2, median."])
    page = page_with(made)
    (image,) = Elements(page).named("img")
    assert (image["width"], image["height"]) == ("64", "48")
    assert image["src"] == "./videos/a%20b.png"
    gallery = page[page.index('id="videos"') : page.index('id="episodes"')]
    for words in (
        "best, median and worst",
        "Play <bdi>dm_control/walker-walk, seed 1, episode 2, side</bdi>",
        *("15 steps", "truncated", "2.0 s", "Chosen by best:2, median."),
        *(made.sha256, made.command),
    ):
        assert words in gallery
    # A page is known by its mark, and may then be replaced; it is the same each time.
    mark = {"name": "generator", "content": f"mjrec {version('mjrec')}"}
    assert mark in Elements(page).named("meta")
    assert page == page_with(made)
    # A video that is no part of the report has no player.
    page = page_with(replace(made, file=""))
    assert Elements(page).players() == []
    assert "./videos/a%20b.png" in page
    assert made.command in page


def test_what_the_figures_do_not_say_is_said_beside_them():
    """How most were made, which are missing or made otherwise, and what differs."""
    usual = [("GL", "llvmpipe"), ("Policy", "p")]
    first, second, odd, large = (
        task(name, returns, provenance=[*usual, ("Seeds", name)])
        for name, returns in (
            ("a", [1.0, 2.0, 4.5]),
            *(("b", [1.0, 2.0, 3.0]), ("odd", [1.0]), ("large", [7.0, 8.0])),
        )
    )
    odd.summary = TaskSummary(task="odd", runs=1, episodes=3, not_finite=1)
    method = "large-sample normal interval"
    large.summary = replace(large.summary, interval_method=method)
    scores = AcrossTasks(tasks=("a",), left_out={"b": "no episode was completed"})
    page = page_of(contents(first, second, large, odd, across={"one": scores}))
    [said] = re.findall(r"intervals of 95%: ([^.]*)\.", page)
    assert said.endswith("50 resamples, seed 0")
    notes = re.findall(r"<li><span[^>]*>(\w+)</span>: ([^<]*)\.</li>", page)
    assert notes == [
        ("large", f"Intervals by a different method, {method}"),
        ("odd", "No figures for the returns: 1 of 3 returns is not finite"),
    ]
    assert "<summary>1 left out</summary>" in page
    assert ">b</span>: no episode was completed</li>" in page
    # The standard deviation has n - 1; of one episode there is none.
    body = page.split('<table id="summary-table">')[1].split("</table>")[0]
    assert ">1.803</td>" in body
    assert 'data-value="">\N{EN DASH}</td>' in body
    # What is the same for all tasks is said once.
    assert page.count("llvmpipe") == 1
    assert page.count("<dt>Seeds</dt>") == 4


def test_a_page_opens_with_a_part_of_many_episodes():
    """Those with videos, failures, the best and the worst; players for some videos."""
    returns = np.arange(30_000.0)
    # Those of any size are told; one that is no number is not.
    returns[:3] = (-1e307, 0.123456789, 1e307)
    made = task("a", returns, failures={17_000: "boom"}, score_range=None)
    made.videos = [
        video(15_000 + i, file=f"{i}.mp4", roles=("best",) if i == 599 else ())
        for i in range(600)
    ]
    page = page_of(contents(made, across={}))
    (shown,) = data_of(page)["tasks"]
    assert len(shown["run"]) < 20_000
    rewards = dict(zip(shown["episode"], shown["total_reward"], strict=True))
    assert (rewards[0], rewards[2], rewards[17_000]) == (-1e307, 1e307, None)
    assert "evaluation/results.csv" in page
    assert "30\u202f000" in page
    # The table of episodes links to the videos that have no player.
    assert len(Elements(page).players()) == 300
    places = [
        shown["videos"][str(shown["episode"].index(15_000 + i))] for i in (599, 598)
    ]
    assert places == [["#video-599"], ["./598.mp4"]]


def test_a_report_of_nothing_is_a_page():
    """So is one of a task without a completed episode; neither has figures."""
    assert "0 tasks, 0 episodes, 0 videos" in page_of(ReportContents())
    page = page_of(contents(task("a", [1.0], failures={0: "PolicyError: NaN"})))
    assert "PolicyError: NaN" in page
    assert 'class="curve"' not in page


# --- Figures ----------------------------------------------------------------------


@pytest.mark.parametrize("draw", [learning_curve, evaluation_curve])
@pytest.mark.parametrize(
    "returns",
    [
        *([0.0], [5.0] * 3, [-1e300, -1e300, -5e299], [5e-324, 5e-324, 0.0]),
        *(np.sin(np.arange(count)) * 1e4 for count in (600, 601, 20_000)),
    ],
    ids=len,
)
def test_any_returns_make_a_small_figure(draw, returns):
    """However many there are, equal or extreme; every coordinate is a number."""
    for seeds in (1, min(100, len(returns))):
        svg = draw(task("a", returns, seeds=seeds, score_range=None), key="k")
        assert len(svg) < 40_000
        assert ">Return</text>" in svg
        paths = re.findall(r' d="([^"]*)"', svg)
        assert paths
        assert not re.search("nan|inf", "".join(paths))


def test_a_learning_curve_is_in_the_order_of_time():
    """Several monitors write side by side."""
    rising = task("a", np.arange(100.0), runs=["0.1"])
    order = np.random.default_rng(0).permutation(100)
    mixed = replace(rising, episodes=rising.episodes[order])
    assert learning_curve(mixed, key="k") == learning_curve(rising, key="k")


@pytest.mark.parametrize(
    ("value", "decimals", "shown"),
    [
        (float("nan"), 1, "\N{EN DASH}"),
        (-0.04, 1, "0.0"),
        (-12345.678, 2, "-12\u202f345.68"),
        (1.5e300, 0, "1.5e+300"),
    ],
)
def test_a_number_is_shown_as_people_read_it(value, decimals, shown):
    """With thousands apart where there are many."""
    assert number(value, decimals) == shown
