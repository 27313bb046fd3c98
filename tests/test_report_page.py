# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import base64
import hashlib
import json
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from importlib.metadata import version
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from report_contents import HOSTILE, columns, contents, task, video

from mjrec.errors import MissingDependency
from mjrec.evaluation.statistics import Interval
from mjrec.evaluation.summaries import AcrossTasks, Profile, TaskSummary
from mjrec.reporting.contents import ReportContents, Verdict
from mjrec.reporting.curves import evaluation_curve, learning_curve, profile_curve
from mjrec.reporting.numbers import decimals_for, number, whole_number
from mjrec.reporting.page import page_of

pytest.importorskip("matplotlib")


class Elements(HTMLParser):
    """What a page consists of."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, str] = {}
        self.open: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        while self.open and self.open.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        tag = self.open[-1] if self.open else ""
        self.texts[tag] = self.texts.get(tag, "") + data

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.found if name == tag]


def data_of(page: str) -> Any:
    """Return what the page's script reads."""
    found = re.search(r'id="episodes-data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def hostile_report() -> ReportContents:
    """Return contents in which every text is one that means harm."""
    tasks = []
    for i, text in enumerate(HOSTILE):
        episodes = columns(
            [1.0, 2.0, 3.0],
            runs=[text] if i % 2 else None,
            failures={1: text},
            videos={0: [i]},
        )
        pairs = [(text, text), ("Selection rule", text)]
        tasks.append(task(text, episodes, source=text, provenance=pairs))
    videos = [
        video(i, 0, file=text, poster=text, name=text, camera=text, sha256=text)
        for i, text in enumerate(HOSTILE)
    ]
    videos = [
        replace(v, command=t, notes=[t]) for v, t in zip(videos, HOSTILE, strict=True)
    ]
    told = AcrossTasks(tasks=tuple(HOSTILE), left_out={t: t for t in HOSTILE}, iqm=0.5)
    return contents(
        *tasks,
        title=HOSTILE[0],
        videos=videos,
        across=dict.fromkeys(HOSTILE, told),
        problems=HOSTILE,
        verdicts=[
            Verdict(source=t, passed=False, counts={t: 1}, level=t) for t in HOSTILE
        ],
        made_with=dict.fromkeys(HOSTILE, HOSTILE[1]),
    )


def test_the_same_contents_give_the_same_page() -> None:
    """Byte for byte: no dates, no ids by chance."""
    assert page_of(contents(videos=[video()])) == page_of(contents(videos=[video()]))


def test_texts_of_strangers_stay_text() -> None:
    """There are no elements and no handlers but the page's own."""
    page = page_of(hostile_report())
    plain = Elements(page)
    assert len(plain.named("script")) == 2
    assert {image["src"] for image in plain.named("img")} == {
        f"./{quote(text, safe='/')}" for text in HOSTILE
    }
    handlers = [a for _, attributes in plain.found for a in attributes if a[:2] == "on"]
    assert handlers == []
    assert HOSTILE[0] in plain.texts["h1"]


def test_nothing_unseen_is_shown() -> None:
    """Marks that turn the direction of writing, and control characters, are told."""
    page = page_of(hostile_report())
    assert not set("\u202e\u2028\x00\x1b") & set(page)
    assert r"abc\u202edef\u2028ghi" in page


def test_long_texts_are_cut() -> None:
    """So that a page of them can be read; only a command is left as it is."""
    long = "x" * 10_000
    report = contents(task(long, columns([1.0, 2.0])), title=long, problems=[long])
    assert not re.search("x{1001}", page_of(report))
    command = page_of(contents(videos=[video(command="y" * 5000)]))
    assert "y" * 5000 in command


def test_the_data_cannot_end_its_element() -> None:
    """It holds no `<`, and says what was given."""
    page = page_of(contents(task("</script><b>", columns([1.0, 2.0]))))
    assert data_of(page)["tasks"][0]["name"] == "</script><b>"


def test_nothing_is_loaded_from_elsewhere() -> None:
    """Every address is of a file beside the page, or a place on it."""
    page = page_of(hostile_report())
    addresses = [
        attributes[name]
        for _, attributes in Elements(page).found
        for name in ("src", "href", "poster", "action", "data", "xlink:href")
        if name in attributes
    ]
    assert addresses
    assert all(re.match(r"\./|#|data:,$", address or "") for address in addresses)
    assert not re.search(r"https?://", page)
    assert "url(" not in page


def test_the_policy_lets_only_the_pages_own_style_and_script_run() -> None:
    """They have the hashes that it states, and no element has a style of its own."""
    page = page_of(contents(videos=[video()]))
    elements = Elements(page)
    (policy,) = [
        meta["content"] or ""
        for meta in elements.named("meta")
        if meta.get("http-equiv") == "Content-Security-Policy"
    ]
    assert policy.startswith("default-src 'none';")
    for kind, pattern in (
        ("style", r"<style>(.*?)</style>"),
        ("script", r"<script>(.*?)</script>"),
    ):
        (text,) = re.findall(pattern, page, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}';" in policy
    assert not [
        a for _, attributes in elements.found for a in attributes if a == "style"
    ]


@pytest.mark.parametrize(
    ("path", "address"),
    [
        ("videos/a b#?.mp4", "./videos/a%20b%23%3F.mp4"),
        ("../run/é.mp4", "./../run/%C3%A9.mp4"),
        ("javascript:alert(1)", "./javascript%3Aalert%281%29"),
        ("//host/x.mp4", ".///host/x.mp4"),
        ("data:text/html;base64,PGI+", "./data%3Atext/html%3Bbase64%2CPGI%2B"),
        ("data:video/mp4;base64,AAAA", "data:video/mp4;base64,AAAA"),
    ],
)
def test_a_path_becomes_an_address(path: str, address: str) -> None:
    """Of a file beside the page, whatever it looks like, or a video's bytes."""
    page = Elements(page_of(contents(videos=[video(file=path)])))
    (link,) = [a for a in page.named("a") if a.get("class") == "play"]
    assert link["href"] == address


def test_a_card_says_what_a_video_shows() -> None:
    """Its episode, its size, and how it is made again."""
    page = page_of(contents(videos=[video(index=12, roles=("worst", "best"))]))
    (picture,) = Elements(page).named("img")
    assert (picture["width"], picture["height"]) == ("64", "48")
    assert picture["src"] == "./videos/a%20b.png"
    assert picture["loading"] == "lazy"
    card = page[page.index('id="video-0"') : page.index('id="episodes"')]
    for words in (
        "Play <bdi>dm_control/walker-walk, seed 1, episode 2, side</bdi>",
        "seed 1, episode 2",
        "15 steps",
        "truncated",
        "side",
        "2.0 s",
        "0123456789abcdef" * 4,
        "mjrec render evaluation/walker --episode 3 -o again.mp4",
    ):
        assert words in card


def test_a_video_that_is_embedded_stands_in_the_page_once() -> None:
    """Its link saves it, for no browser opens a page that is such an address."""
    page = page_of(contents(videos=[video(file="data:video/mp4;base64,AAAA")]))
    assert page.count("data:video/mp4") == 1
    (link,) = [a for a in Elements(page).named("a") if a.get("class") == "play"]
    assert link["download"] == "a b.mp4"


def test_the_parts_of_a_rule_stand_apart() -> None:
    """Beside the videos, on a card, and in the provenance; nothing else changes."""
    pairs = [("Policy", "best,median"), ("Selection of videos", "best:2,median,worst")]
    made = task("a", columns([1.0, 2.0]), provenance=pairs)
    note = "Chosen by best:2,median,worst among 3 episodes."
    page = page_of(contents(made, videos=[video(notes=[note])]))
    assert page.count("best:2, median, worst") == 3
    assert "best:2,median" not in page
    assert "best,median" in page


def test_why_a_task_has_no_figures_is_said() -> None:
    """Where a return is no finite number, and only there."""
    made = task("odd", columns([1.0, 2.0, 3.0]))
    summary = TaskSummary(task="odd", runs=1, episodes=3, not_finite=1)
    page = page_of(contents(replace(made, summary=summary), task("b", columns([1.0]))))
    assert re.search(
        r"<li><span[^>]*>odd</span>: No figures of the returns: 1 of 3 returns is no "
        r"finite number\.</li>",
        page,
    )
    assert page.count("No figures of the returns") == 1


def test_it_is_said_how_intervals_were_made() -> None:
    """For most tasks in the head, for others below the table."""
    few = columns([1.0, 2.0, 3.0])
    large = task("large", columns([1.0, 2.0]))
    large = replace(
        large,
        summary=replace(large.summary, interval_method="large-sample normal interval"),
    )
    head = r"intervals of 95\xa0%: ([^.]*)\."
    mixed = page_of(contents(task("a", few), task("b", few), large))
    (usual,) = re.findall(head, mixed)
    assert usual.endswith("50 resamples, seed 0")
    assert re.search(
        r">large</span>: Intervals by another method, large-sample normal int", mixed
    )
    alone = page_of(contents(large, across={}))
    assert re.findall(head, alone) == ["large-sample normal interval"]
    assert "resamples" not in alone
    assert re.findall(head, page_of(contents(task("one", columns([1.0]))))) == []


def test_the_page_says_what_has_made_it() -> None:
    """By this mark a report is known as one, and may be replaced."""
    page = page_of(contents(), curves=False)
    mark = {"name": "generator", "content": f"mjrec {version('mjrec')}"}
    assert mark in Elements(page).named("meta")


def test_the_rule_of_selection_stands_beside_the_videos() -> None:
    """As the provenance states it, once."""
    page = page_of(contents(videos=[video()]))
    gallery = page[page.index('id="videos"') : page.index('id="gallery"')]
    assert gallery.count("best, median and worst") == 1


def test_more_episodes_than_a_page_opens_with_are_left_to_the_files() -> None:
    """Those with videos, those that failed, the best and the worst stay."""
    returns = np.arange(30_000.0)
    episodes = columns(
        returns.tolist(), failures={17_000: "boom"}, videos={15_000: [0]}
    )
    report = contents(task("a", episodes), videos=[video(index=15_000)])
    page = page_of(report)
    (shown,) = data_of(page)["tasks"]
    assert len(shown["run"]) < 20_000
    assert {0, 15_000, 17_000, 29_999} <= set(shown["episode"])
    row = shown["episode"].index(15_000)
    assert shown["videos"] == {str(row): ["#video-0"]}
    assert "evaluation/results.csv" in page
    assert "30\u202f000" in page


def test_returns_of_any_size_are_told() -> None:
    """And one that is no number is not."""
    made = task("a", columns([1e307, -2.5, 0.123456789]), score_range=None)
    inside = replace(made.episodes, total_reward=np.array([1e307, -2.5, np.nan]))
    shown = data_of(page_of(contents(replace(made, episodes=inside), across={})))
    assert shown["tasks"][0]["total_reward"] == [1e307, -2.5, None]


def test_not_every_video_of_thousands_has_a_player() -> None:
    """Those that are best or worst first; the table of episodes links to the others."""
    episodes = columns([1.0] * 600, videos={i: [i] for i in range(600)})
    videos = [
        video(index=i, file=f"{i}.mp4", roles=("best",) if i == 599 else ())
        for i in range(600)
    ]
    page = page_of(contents(task("a", episodes), videos=videos))
    links = [a for a in Elements(page).named("a") if a.get("class") == "play"]
    assert len(links) == 300
    places = data_of(page)["tasks"][0]["videos"]
    assert places["599"] == ["#video-599"]
    assert places["598"] == ["./598.mp4"]


def test_a_video_that_is_no_part_of_the_report_has_no_player() -> None:
    """But its picture, its notes, and the command that renders it."""
    page = page_of(contents(videos=[video(file="", notes=["It is too large."])]))
    elements = Elements(page)
    assert "play" not in [a.get("class") for a in elements.named("a")]
    assert [image["src"] for image in elements.named("img")] == ["./videos/a%20b.png"]
    assert "It is too large." in page
    assert "mjrec render" in page


def test_a_report_of_nothing_is_a_page() -> None:
    """It has neither curves nor videos."""
    page = page_of(ReportContents(title="empty", tasks=()))
    assert "0 tasks, 0 episodes, 0 videos" in page


def test_a_task_without_a_completed_episode_has_a_line() -> None:
    """And no figure."""
    broken = task("a", columns([1.0], failures={0: "PolicyError: NaN"}))
    page = page_of(contents(broken))
    assert "PolicyError: NaN" in page
    assert 'class="curve"' not in page


def test_what_is_the_same_for_all_tasks_is_said_once() -> None:
    """And what differs, for each."""
    pairs = [("GL", "llvmpipe"), ("Policy", "p")]
    first = task("a", columns([1.0, 2.0]), provenance=[*pairs, ("Seeds", "0")])
    second = task("b", columns([1.0, 2.0]), provenance=[*pairs, ("Seeds", "1")])
    page = page_of(contents(first, second))
    assert page.count("llvmpipe") == 1
    assert page.count("<dt>Seeds</dt>") == 2


# --- Figures ----------------------------------------------------------------------


def test_a_figure_takes_the_pages_colours() -> None:
    """It has classes, but no colours, styles, or ids that another could have."""
    svg = evaluation_curve(contents().tasks[0], key="k")
    assert "s-accent" in svg
    assert not re.search(r"#[0-9a-f]{6}|style=|url\(|xlink|xmlns", svg)
    assert set(re.findall(r' id="([^"]*)"', svg)) == {"k-title", "k-desc"}


def test_a_figure_says_in_words_what_it_shows() -> None:
    """Its title and description are text, whatever the name is."""
    svg = evaluation_curve(task("<b>$x$", columns([10.0, 30.0, 20.0])), key="k")
    assert '<title id="k-title">Returns of &lt;b&gt;$x$ by seed</title>' in svg
    assert "3 episodes: mean 20.00" in svg
    assert "from 10.00 to 30.00." in svg


@pytest.mark.parametrize("count", [1, 2, 5, 600, 601, 20_000])
def test_any_number_of_episodes_makes_a_small_figure(count: int) -> None:
    """However many there are."""
    returns = np.sin(np.arange(count)) * 1e4
    for runs, draw in ((["0.1"], learning_curve), (None, evaluation_curve)):
        made = task("a", columns(returns.tolist(), runs=runs))
        assert len(draw(made, key="k")) < 40_000


@pytest.mark.parametrize("value", [0.0, 5.0, -1e300, 1.7e308, 1e-300])
def test_equal_and_extreme_returns_are_drawn(value: float) -> None:
    """Every coordinate is a number."""
    made = task("a", columns([value, value, value / 2]), score_range=None)
    for draw in (learning_curve, evaluation_curve):
        assert "nan" not in draw(made, key="k").replace("nance", "")


def test_seeds_of_any_number_are_drawn() -> None:
    """Also more than there are columns for."""
    svg = evaluation_curve(task("a", columns([1.0, 2.0] * 100, seeds=100)), key="k")
    assert "Seed" in svg


def test_a_learning_curve_is_in_the_order_of_time() -> None:
    """Several monitors write side by side."""
    rising = columns(np.arange(100.0).tolist(), runs=["0.1"])
    order = np.random.default_rng(0).permutation(100)
    mixed = replace(
        rising, total_reward=rising.total_reward[order], end_time=rising.end_time[order]
    )
    assert learning_curve(task("a", mixed), key="k") == learning_curve(
        task("a", rising), key="k"
    )


def test_the_summary_has_the_standard_deviation() -> None:
    """With n - 1, beside the mean; one episode has none."""
    one, several = columns([7.0]), columns([1.0, 2.0, 4.5])
    page = page_of(contents(task("a", several), task("b", one)))
    body = page.split('<table id="summary-table">')[1].split("</table>")[0]
    assert 'title="standard deviation">SD</abbr>' in body
    assert ">1.803</td>" in body
    assert 'data-value="">\N{EN DASH}</td>' in body


def test_what_is_left_out_is_said_with_its_own_reason() -> None:
    """Which need not be that a task has no scale."""
    told = AcrossTasks(tasks=("a",), left_out={"b": "no episode was completed"})
    page = page_of(contents(across={"one": told}))
    assert "<summary>1 left out</summary>" in page
    assert ">b</span>: no episode was completed</li>" in page


@pytest.mark.parametrize(
    ("count", "expected"), [(1, ["0"]), (2, ["0", "1"]), (6, ["0", "2", "4"])]
)
def test_a_learning_curve_begins_with_episode_0(
    count: int, expected: list[str]
) -> None:
    """As the cards and the table count; the first dot is over the tick."""
    episodes = columns(np.arange(float(count)).tolist(), runs=["0.1"])
    svg = learning_curve(task("a", episodes), key="k")
    ticks = re.findall(r'x="([\d.]+)" y="188"[^>]*>(.*?)</text>', svg)
    assert [text for _, text in ticks] == expected
    dots = next(path for path in re.findall("<path[^>]*>", svg) if "round" in path)
    first = re.search(r"M ([\d.]+) ", dots)
    assert first is not None
    assert float(first[1]) == pytest.approx(float(ticks[0][0]), abs=0.02)


def test_each_profile_has_a_line_of_its_own() -> None:
    """Told apart by class and by dashes."""
    shares = (1.0, 0.5, 0.0)
    profile = Profile(
        thresholds=(0.0, 0.5, 1.0), shares=shares, low=shares, high=shares
    )
    told = AcrossTasks(
        tasks=("a",), iqm=0.5, iqm_interval=Interval(0.4, 0.6), profile=profile
    )
    svg = profile_curve({"one": told, "<two>": told}, key="k")
    assert "s-series-0" in svg
    assert re.search(r'class="s-series-1"[^>]*stroke-dasharray', svg)
    assert "&lt;two&gt;: interquartile mean of scores 0.500 over 1 task." in svg


def test_without_matplotlib_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """And what to install; without curves none is needed."""
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingDependency, match=r"mjrec\[report\]"):
        page_of(contents())
    assert "<table" in page_of(contents(), curves=False)


# --- Numbers ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "decimals", "shown"),
    [
        (None, 1, "\N{EN DASH}"),
        (float("nan"), 1, "\N{EN DASH}"),
        (-0.04, 1, "0.0"),
        (9999.5, 1, "9999.5"),
        (-12345.678, 2, "-12\u202f345.68"),
        (float("inf"), 1, "∞"),
        (1.5e300, 0, "1.5e+300"),
    ],
)
def test_a_number_is_shown_as_people_read_it(
    value: float | None, decimals: int, shown: str
) -> None:
    """With thousands apart where there are many."""
    assert number(value, decimals) == shown


@pytest.mark.parametrize(
    ("values", "decimals"),
    [((0.0, 12_000.0), 0), ((0.0, 999.0), 1), ((-0.5, 0.1), 4), ((None, 0.0), 0)],
)
def test_decimals_fit_the_largest(
    values: tuple[float | None, ...], decimals: int
) -> None:
    """Four figures of it."""
    assert decimals_for(values) == decimals


def test_whole_numbers_have_their_thousands_apart() -> None:
    """From ten thousand on."""
    assert [whole_number(n) for n in (9999, 10_000)] == ["9999", "10\u202f000"]
