# SPDX-License-Identifier: Apache-2.0
"""Test the text and figures of report pages without a browser."""

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
    """Return the data that the page embeds for its script."""
    found = re.search(r'id="episodes-data">(.*?)</script>', page, re.DOTALL)
    return json.loads(found[1])


def page_with(*videos):
    report = contents()
    report.tasks[0].videos = videos
    return page_of(report)


def test_hostile_text_stays_text():
    """Hostile text adds no element, handler, style or invisible character."""
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
    # All addresses must be files next to the page or anchors within it.
    addresses = [
        found[name]
        for _, found in elements.found
        for name in ("src", "href", "poster", "action", "data", "xlink:href")
        if name in found
    ]
    assert addresses
    assert all(re.match(r"\./|#|data:,$", address or "") for address in addresses)
    assert not re.search(r"https?://|url\(", page)
    assert not re.search("x{1001}", page.split('id="videos"')[0])  # Long text is cut.
    assert data_of(page)["tasks"][1]["name"] == HOSTILE[1]


def test_video_card_shows_episode_size_command_and_rule():
    best = video(12, notes=["Chosen by best:2, median."])
    page = page_with(best)
    (image,) = Elements(page).named("img")
    assert (image["width"], image["height"]) == ("64", "48")
    assert image["src"] == "./videos/a%20b.png"
    gallery = page[page.index('id="videos"') : page.index('id="episodes"')]
    for words in (
        "best, median and worst",
        "Play <bdi>dm_control/walker-walk, seed 1, episode 2, side</bdi>",
        *("15 steps", "truncated", "2.0 s", "Chosen by best:2, median."),
        *(best.sha256, best.command),
    ):
        assert words in gallery
    # A later report may replace the page only because of this mark.
    mark = {"name": "generator", "content": f"mjrec {version('mjrec')}"}
    assert mark in Elements(page).named("meta")
    assert page == page_with(best)
    # A video that is not in the report has no player.
    page = page_with(replace(best, file=""))
    assert Elements(page).players() == []
    assert "./videos/a%20b.png" in page
    assert best.command in page


def test_notes_explain_missing_and_different_figures():
    shared = [("GL", "llvmpipe"), ("Policy", "p")]
    first, second, odd, large = (
        task(name, returns, provenance=[*shared, ("Seeds", name)])
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
    [note] = re.findall(r"intervals of 95%: ([^.]*)\.", page)
    assert note.endswith("50 resamples, seed 0")
    notes = re.findall(r"<li><span[^>]*>(\w+)</span>: ([^<]*)\.</li>", page)
    assert notes == [
        ("large", f"Intervals by a different method, {method}"),
        ("odd", "No figures for the returns: 1 of 3 returns is not finite"),
    ]
    assert "<summary>1 left out</summary>" in page
    assert ">b</span>: no episode was completed</li>" in page
    # The standard deviation divides by n - 1, so one episode has none.
    body = page.split('<table id="summary-table">')[1].split("</table>")[0]
    assert ">1.803</td>" in body
    assert 'data-value="">\N{EN DASH}</td>' in body
    # Facts that all tasks share appear only once.
    assert page.count("llvmpipe") == 1
    assert page.count("<dt>Seeds</dt>") == 4


def test_page_of_many_episodes_holds_a_selection():
    """The page keeps the best and worst episodes and those with videos or failures."""
    returns = np.arange(30_000.0)
    returns[:3] = (-1e307, 0.123456789, 1e307)
    large = task("a", returns, failures={17_000: "boom"}, score_range=None)
    large.videos = [
        video(15_000 + i, file=f"{i}.mp4", roles=("best",) if i == 599 else ())
        for i in range(600)
    ]
    page = page_of(contents(large, across={}))
    (listed,) = data_of(page)["tasks"]
    assert len(listed["run"]) < 20_000
    rewards = dict(zip(listed["episode"], listed["total_reward"], strict=True))
    assert (rewards[0], rewards[2], rewards[17_000]) == (-1e307, 1e307, None)
    assert "evaluation/results.csv" in page
    assert "30\u202f000" in page
    # The table only links to the files of further videos.
    assert len(Elements(page).players()) == 300
    places = [
        listed["videos"][str(listed["episode"].index(15_000 + i))] for i in (599, 598)
    ]
    assert places == [["#video-599"], ["./598.mp4"]]


def test_report_without_episodes_is_a_page_without_figures():
    assert "0 tasks, 0 episodes, 0 videos" in page_of(ReportContents())
    page = page_of(contents(task("a", [1.0], failures={0: "PolicyError: NaN"})))
    assert "PolicyError: NaN" in page
    assert 'class="curve"' not in page


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
    for seeds in (1, min(100, len(returns))):
        svg = draw(task("a", returns, seeds=seeds, score_range=None), key="k")
        assert len(svg) < 40_000
        assert ">Return</text>" in svg
        paths = re.findall(r' d="([^"]*)"', svg)
        assert paths
        assert not re.search("nan|inf", "".join(paths))


def test_learning_curve_is_ordered_by_time():
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
def test_numbers_are_readable(value, decimals, shown):
    assert number(value, decimals) == shown
