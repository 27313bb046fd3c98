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

from mjrec.evaluation.statistics import Interval
from mjrec.evaluation.summaries import AcrossTasks, Profile, TaskSummary
from mjrec.reporting.contents import ReportContents
from mjrec.reporting.curves import evaluation_curve, learning_curve, profile_curve
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


def with_videos(*videos):
    """Return the usual report, whose first task has these videos."""
    made = contents()
    made.tasks[0].videos = videos
    return made


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
    # No name ends the element that the script reads.
    assert data_of(page)["tasks"][1]["name"] == HOSTILE[1]


def test_long_texts_are_cut():
    """So that a page of them can be read; only a command is left as it is."""
    long = "x" * 10_000
    report = contents(task(long, [1.0, 2.0]), title=long, problems=[long])
    assert not re.search("x{1001}", page_of(report))
    assert "y" * 5000 in page_of(with_videos(video(command="y" * 5000)))


@pytest.mark.parametrize(
    ("path", "address"),
    [
        ("videos/a b#?.mp4", "./videos/a%20b%23%3F.mp4"),
        ("javascript:alert(1)", "./javascript%3Aalert%281%29"),
        ("//host/x.mp4", ".///host/x.mp4"),
        ("data:text/html;base64,PGI+", "./data%3Atext/html%3Bbase64%2CPGI%2B"),
        ("data:video/mp4;base64,AAAA", "data:video/mp4;base64,AAAA"),
    ],
)
def test_a_path_becomes_an_address(path, address):
    """Of a file beside the page, whatever it looks like, or a video's bytes, once."""
    page = page_of(with_videos(video(file=path)))
    (link,) = Elements(page).players()
    assert link["href"] == address
    is_embedded = address.startswith("data:")
    # A link saves it, for no browser opens a page that is such an address.
    assert ("download" in link) == is_embedded
    assert not is_embedded or page.count(path) == 1


# --- What it shows ----------------------------------------------------------------


def test_the_same_contents_give_the_same_page():
    """Byte for byte, with the mark by which a report is known and may be replaced."""
    page = page_of(with_videos(video()))
    assert page == page_of(with_videos(video()))
    mark = {"name": "generator", "content": f"mjrec {version('mjrec')}"}
    assert mark in Elements(page).named("meta")


def test_a_card_says_what_a_video_shows():
    """Its episode, its size, how it is made again, and by which rule it was chosen."""
    page = page_of(with_videos(video(12, notes=["Chosen by best:2, median."])))
    (image,) = Elements(page).named("img")
    assert (image["width"], image["height"]) == ("64", "48")
    assert image["src"] == "./videos/a%20b.png"
    gallery = page[page.index('id="videos"') : page.index('id="episodes"')]
    for words in (
        "best, median and worst",
        "Play <bdi>dm_control/walker-walk, seed 1, episode 2, side</bdi>",
        "seed 1, episode 2",
        "15 steps",
        "truncated",
        "side",
        "2.0 s",
        "0123456789abcdef" * 4,
        "mjrec render evaluation/walker --episode 3 -o again.mp4",
        "Chosen by best:2, median.",
    ):
        assert words in gallery


def test_a_video_that_is_no_part_of_the_report_has_no_player():
    """But its frame, its notes, and the command that renders it."""
    page = page_of(with_videos(video(file="", notes=["It is too large."])))
    elements = Elements(page)
    assert elements.players() == []
    assert [image["src"] for image in elements.named("img")] == ["./videos/a%20b.png"]
    assert "It is too large." in page
    assert "mjrec render" in page


def test_why_figures_are_missing_or_made_in_another_way_is_said():
    """Most tasks' intervals are described in the head, others below the table."""
    few = [1.0, 2.0, 3.0]
    odd, large = task("odd", few), task("large", [1.0, 2.0])
    odd.summary = TaskSummary(task="odd", runs=1, episodes=3, not_finite=1)
    method = "large-sample normal interval"
    large.summary = replace(large.summary, interval_method=method)
    page = page_of(contents(task("a", few), task("b", few), large, odd))
    [usual] = re.findall(r"intervals of 95%: ([^.]*)\.", page)
    assert usual.endswith("50 resamples, seed 0")
    notes = re.findall(r"<li><span[^>]*>(\w+)</span>: ([^<]*)\.</li>", page)
    assert notes == [
        ("large", f"Intervals by a different method, {method}"),
        ("odd", "No figures for the returns: 1 of 3 returns is not finite"),
    ]


def test_the_summary_has_the_standard_deviation():
    """With n - 1, beside the mean; one episode has none."""
    page = page_of(contents(task("a", [1.0, 2.0, 4.5]), task("b", [7.0])))
    body = page.split('<table id="summary-table">')[1].split("</table>")[0]
    assert ">1.803</td>" in body
    assert 'data-value="">\N{EN DASH}</td>' in body


def test_what_is_left_out_of_the_scores_is_said():
    """With its own reason."""
    scores = AcrossTasks(tasks=("a",), left_out={"b": "no episode was completed"})
    page = page_of(contents(across={"one": scores}))
    assert "<summary>1 left out</summary>" in page
    assert ">b</span>: no episode was completed</li>" in page


def test_what_is_the_same_for_all_tasks_is_said_once():
    """And what differs, for each."""
    pairs = [("GL", "llvmpipe"), ("Policy", "p")]
    first = task("a", [1.0, 2.0], provenance=[*pairs, ("Seeds", "0")])
    second = task("b", [1.0, 2.0], provenance=[*pairs, ("Seeds", "1")])
    page = page_of(contents(first, second))
    assert page.count("llvmpipe") == 1
    assert page.count("<dt>Seeds</dt>") == 2


def test_more_episodes_than_a_page_opens_with_are_left_to_the_files():
    """Those with videos, those that failed, the best and the worst stay."""
    made = task("a", np.arange(30_000.0), failures={17_000: "boom"})
    made.videos = [video(15_000)]
    page = page_of(contents(made))
    (shown,) = data_of(page)["tasks"]
    assert len(shown["run"]) < 20_000
    assert {0, 15_000, 17_000, 29_999} <= set(shown["episode"])
    row = shown["episode"].index(15_000)
    assert shown["videos"] == {str(row): ["#video-0"]}
    assert "evaluation/results.csv" in page
    assert "30\u202f000" in page


def test_returns_of_any_size_are_told():
    """And one that is no number is not."""
    made = task("a", [1e307, -2.5, 0.123456789], score_range=None)
    made.episodes["total_reward"][2] = np.nan
    shown = data_of(page_of(contents(made, across={})))
    assert shown["tasks"][0]["total_reward"] == [1e307, -2.5, None]


def test_not_every_video_of_thousands_has_a_player():
    """Those that are best or worst first; the table of episodes links to the others."""
    made = task("a", [1.0] * 600)
    made.videos = [
        video(i, file=f"{i}.mp4", roles=("best",) if i == 599 else ())
        for i in range(600)
    ]
    page = page_of(contents(made))
    assert len(Elements(page).players()) == 300
    places = data_of(page)["tasks"][0]["videos"]
    assert (places["599"], places["598"]) == (["#video-599"], ["./598.mp4"])


def test_a_report_of_nothing_is_a_page():
    """So is one of a task without a completed episode; neither has figures."""
    assert "0 tasks, 0 episodes, 0 videos" in page_of(ReportContents())
    page = page_of(contents(task("a", [1.0], failures={0: "PolicyError: NaN"})))
    assert "PolicyError: NaN" in page
    assert 'class="curve"' not in page


# --- Figures ----------------------------------------------------------------------


def test_a_figure_takes_the_pages_colours_and_says_what_it_shows():
    """It has classes, but no colours, styles, or ids that another could have."""
    svg = evaluation_curve(task("<b>$x$", [10.0, 30.0, 20.0]), key="k")
    assert "s-accent" in svg
    assert not re.search(r"#[0-9a-f]{6}|style=|url\(|xlink|xmlns", svg)
    assert set(re.findall(r' id="([^"]*)"', svg)) == {"k-title", "k-desc"}
    assert '<title id="k-title">Returns of &lt;b&gt;$x$ by seed</title>' in svg
    assert "3 episodes: mean 20.00" in svg
    assert "from 10.00 to 30.00." in svg


@pytest.mark.parametrize("seeds", [1, 100])
@pytest.mark.parametrize("count", [1, 2, 5, 600, 601, 20_000])
def test_any_number_of_episodes_makes_a_small_figure(count, seeds):
    """However many there are."""
    returns = np.sin(np.arange(count)) * 1e4
    for draw in (learning_curve, evaluation_curve):
        svg = draw(task("a", returns, seeds=min(seeds, count)), key="k")
        assert len(svg) < 40_000
        assert ">Return</text>" in svg


@pytest.mark.parametrize("value", [0.0, 5.0, -1e300, 1.7e308, 1e-300, 5e-324])
def test_equal_and_extreme_returns_are_drawn(value):
    """Every coordinate is a number."""
    for returns in ([value, value, value / 2], [value]):
        made = task("a", returns, score_range=None)
        for draw in (learning_curve, evaluation_curve):
            paths = re.findall(r' d="([^"]*)"', draw(made, key="k"))
            assert paths
            assert not re.search("nan|inf", "".join(paths))


def test_a_learning_curve_is_in_the_order_of_time():
    """Several monitors write side by side."""
    rising = task("a", np.arange(100.0), runs=["0.1"])
    order = np.random.default_rng(0).permutation(100)
    mixed = replace(rising, episodes=rising.episodes[order])
    assert learning_curve(mixed, key="k") == learning_curve(rising, key="k")


@pytest.mark.parametrize(
    ("count", "expected"), [(1, ["0"]), (2, ["0", "1"]), (6, ["0", "2", "4"])]
)
def test_a_learning_curve_begins_with_episode_0(count, expected):
    """As the cards and the table count; the first dot is over the tick."""
    svg = learning_curve(task("a", np.arange(float(count)), runs=["0.1"]), key="k")
    ticks = re.findall(r'x="([\d.]+)" y="188"[^>]*>(.*?)</text>', svg)
    assert [text for _, text in ticks] == expected
    dots = re.search(r'd="M([\d.]+) [^"]*h0"', svg)
    assert dots[1] == ticks[0][0]


def test_each_profile_has_a_line_of_its_own():
    """Told apart by class and by dashes."""
    shares = (1.0, 0.5, 0.0)
    profile = Profile(
        thresholds=(0.0, 0.5, 1.0), shares=shares, low=shares, high=shares
    )
    scores = AcrossTasks(
        tasks=("a",), iqm=0.5, iqm_interval=Interval(0.4, 0.6), profile=profile
    )
    svg = profile_curve({"one": scores, "<two>": scores}, key="k")
    assert 'class="s-series-0 dash-0"' in svg
    assert 'class="s-series-1 dash-1"' in svg
    assert "&lt;two&gt;: interquartile mean of scores 0.500 over 1 task." in svg


# --- Numbers ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "decimals", "shown"),
    [
        (None, 1, "\N{EN DASH}"),
        (float("nan"), 1, "\N{EN DASH}"),
        (-0.04, 1, "0.0"),
        (9999.5, 1, "9999.5"),
        (10_000, 0, "10\u202f000"),
        (-12345.678, 2, "-12\u202f345.68"),
        (float("inf"), 1, "∞"),
        (1.5e300, 0, "1.5e+300"),
    ],
)
def test_a_number_is_shown_as_people_read_it(value, decimals, shown):
    """With thousands apart where there are many."""
    assert number(value, decimals) == shown
