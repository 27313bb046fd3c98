# SPDX-License-Identifier: Apache-2.0
"""The page of a report in a real browser: headless Chromium, driven by Playwright."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from parts import parametrize
from playwright.sync_api import Browser, Page, expect, sync_playwright
from report_contents import HOSTILE, contents, hostile_report, task, video

import mjrec
from mjrec.reporting.contents import ReportContents, Verdict
from mjrec.reporting.page import page_of
from mjrec.reporting.report_folder import write_report

# No sandbox, which root and most containers cannot have: it opens our own pages only.
_OPTIONS = (
    *("--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--disable-default-apps"),
)
pytestmark = pytest.mark.browser

_FPS = 25
_FRAMES = 50


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Start the system's Chromium, or the one that Playwright has installed."""
    with sync_playwright() as playwright:
        found = shutil.which("chromium") or playwright.chromium.executable_path
        started = playwright.chromium.launch(executable_path=found, args=_OPTIONS)
        yield started
        started.close()


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    """Open a page that must neither complain nor ask for anything but files."""
    with browser.new_context(viewport={"width": 1280, "height": 900}) as context:
        yield from watched(context.new_page())


def watched(page: Page) -> Iterator[Page]:
    """Yield a page, and then look at what it has said and asked for."""
    complaints: list[str] = []
    page.on("console", lambda said: complaints.append(f"{said.type}: {said.text}"))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", lambda shown: complaints.append(f"dialog: {shown.message}"))
    page.on(
        "request",
        lambda asked: complaints.extend(
            [] if asked.url.startswith(("file://", "data:")) else [asked.url]
        ),
    )
    page.set_default_timeout(10_000)
    yield page
    assert complaints == []


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder of short videos: a bar that goes from left to right."""
    folder = tmp_path_factory.mktemp("report #1")
    frames = np.zeros((_FRAMES, 48, 64, 3), np.uint8)
    for i, frame in enumerate(frames):
        frame[:, : i + 2] = (200, 120, 40)
    for name in ("best", "worst"):
        mjrec.save_video(
            frames, folder, name_prefix=name, fps=_FPS, episode_trigger=lambda _: True
        )
    return folder


def usual_report() -> ReportContents:
    """Return two tasks of fifty episodes, and the best and the worst of each."""
    made = contents(problems=["b"])
    for of in made.tasks:
        order = np.argsort(of.episodes["total_reward"])
        of.videos = [
            video(
                int(order[place]),
                path=Path(f"{role}-episode-0.mp4"),
                file=f"{role}-episode-0.mp4",
                poster="",
                roles=(role,),
            )
            for role, place in (("best", -1), ("worst", 0))
        ]
    made.verdicts.append(
        Verdict(source="run", passed=True, counts={"passed": 3}, level="pixels")
    )
    return made


def open_report(page: Page, folder: Path, report: ReportContents) -> None:
    """Write a report into a folder, and open it from there."""
    file = folder / "index.html"
    file.write_text(page_of(report), encoding="utf-8")
    page.goto(file.as_uri())


@pytest.fixture
def usual(page: Page, videos: Path) -> Page:
    """Open the usual report."""
    open_report(page, videos, usual_report())
    return page


# --- Videos -----------------------------------------------------------------------


def test_videos_play(usual: Page) -> None:
    """Each at its size and for its time, and one at a time."""
    expect(usual.locator("video")).to_have_count(0)
    buttons = usual.get_by_role("button", name="Play dm_control/")
    expect(buttons).to_have_count(4)
    players = usual.locator("video")
    for i in range(4):
        buttons.first.click()
        usual.wait_for_function(
            "i => document.querySelectorAll('video')[i].currentTime > 0.1", arg=i
        )
        told = players.nth(i).evaluate(
            "v => [v.readyState, v.videoWidth, v.videoHeight, v.duration, v.error]"
        )
        assert told[0] >= 2
        assert told[1:3] == [64, 48]
        assert told[3] == pytest.approx(_FRAMES / _FPS, abs=1 / _FPS)
        assert told[4] is None
    playing = "[...document.querySelectorAll('video')].filter(v => !v.paused).length"
    assert usual.evaluate(playing) <= 1


@pytest.mark.thorough
@pytest.mark.parametrize("key", ["Enter", "Space"])
def test_a_video_is_played_by_keyboard(usual: Page, key: str) -> None:
    """Its player has the keyboard then, and the name of what it plays."""
    button = usual.locator("#video-1").get_by_role("button", name="Play dm_control/")
    button.press(key)
    player = usual.locator("#video-1 video")
    expect(player).to_be_focused()
    expect(player).to_have_accessible_name(re.compile("^dm_control/walker-walk, seed"))
    usual.wait_for_function("() => document.querySelector('video').currentTime > 0.1")
    usual.keyboard.press("Space")
    assert player.evaluate("v => v.paused")
    expect(usual.locator("video")).to_have_count(1)


@parametrize("single_file", [False, True])
def test_a_recordings_report_plays(
    page: Page, tmp_path: Path, make_corridor: Any, play: Any, single_file: bool
) -> None:
    """From the monitor's files to the picture in the browser."""
    directory = tmp_path / "recordings #1"
    with mjrec.Monitor(make_corridor(length=20), directory) as monitor:
        play(monitor, 3, seed=0)
    index = write_report(directory, tmp_path / "a report", single_file=single_file)
    # The folder is whole by itself.
    shutil.rmtree(directory)
    page.goto(index.resolve().as_uri())
    expect(page.locator("#summary-table tbody tr")).to_have_count(1)
    expect(page.locator("#episodes-count")).to_have_text("Rows 1 to 3 of 3")
    expect(page.locator("video")).to_have_count(0)
    page.get_by_role("button", name="Play").first.click()
    player = page.locator("video").first
    page.wait_for_function("() => document.querySelector('video').currentTime > 0.1")
    # The environment's own rate is 10, and the first picture is the reset's.
    assert player.evaluate("v => v.duration") == pytest.approx(2.1, abs=0.1)
    assert player.evaluate("v => v.poster") != ""


# --- Sorting ----------------------------------------------------------------------


def names_of(page: Page) -> list[str]:
    """Return the tasks in the summary, from the top."""
    return page.locator("#summary-table tbody th").all_inner_texts()


@pytest.mark.thorough
def test_the_summary_sorts_by_mouse_and_by_keyboard(usual: Page) -> None:
    """Either way, and says which."""
    mean = usual.locator("#summary-table th", has_text="Mean")
    button = mean.get_by_role("button")
    button.click()
    expect(mean).to_have_attribute("aria-sort", "descending")
    best_first = names_of(usual)
    assert best_first[0] == "dm_control/walker-walk"
    button.press("Enter")
    expect(mean).to_have_attribute("aria-sort", "ascending")
    assert names_of(usual) == best_first[::-1]
    usual.keyboard.press("Space")
    expect(mean).to_have_attribute("aria-sort", "descending")
    expect(usual.locator("#said")).to_have_text("Sorted by Mean, descending")
    assert usual.locator("[aria-sort]").count() == 1


@pytest.mark.thorough
def test_what_is_not_known_comes_last(page: Page, tmp_path: Path) -> None:
    """Whichever way a table is sorted."""
    named = {"a": [3.0, 3.0], "b": [1.0, 1.0], "c": [2.0]}
    tasks = [
        task(name, v, failures={0: "x"} if name == "c" else None)
        for name, v in named.items()
    ]
    open_report(page, tmp_path, contents(*tasks))
    button = page.locator("#summary-table").get_by_role("button", name="Mean")
    orders = []
    for _ in range(2):
        button.click()
        orders.append(names_of(page))
    assert orders == [["a", "b", "c"], ["b", "a", "c"]]
    rewards = page.locator("#episodes-table").get_by_role("button", name="Return")
    for shown in (["3.000", "3.000", "1.000", "1.000"], ["1.000", "1.000", "3.000"]):
        rewards.click()
        cells = page.locator("#episodes-table tbody td:nth-child(5)").all_inner_texts()
        assert cells[: len(shown)] == shown
        assert cells[-1] == "\N{EN DASH}"


# --- The gallery ------------------------------------------------------------------


def shown_cards(page: Page) -> list[str]:
    """Return the ids of the videos that are to be seen."""
    cards = page.locator(".card:not([hidden])")
    return [card.get_attribute("id") or "" for card in cards.all()]


@pytest.mark.thorough
def test_the_gallery_filters_by_mouse_and_by_keyboard(usual: Page) -> None:
    """By task, by best or worst, and by both; and says how many are left."""
    count = usual.locator("#gallery-count")
    usual.get_by_role("radio", name="Worst").click()
    assert shown_cards(usual) == ["video-1", "video-3"]
    expect(count).to_have_text("2 of 4 videos")
    usual.locator("#gallery-task").select_option(label="dm_control/cheetah-run")
    assert shown_cards(usual) == ["video-3"]
    usual.get_by_role("radio", name="Worst").press("ArrowLeft")
    expect(usual.get_by_role("radio", name="Best")).to_be_checked()
    assert shown_cards(usual) == ["video-2"]
    usual.locator("#gallery-task").press("Home")
    expect(usual.locator("#gallery-task")).to_have_value("")
    assert shown_cards(usual) == ["video-0", "video-2"]


@pytest.mark.thorough
def test_a_command_is_copied_or_selected(usual: Page) -> None:
    """Whatever the browser allows to a page from the disk."""
    card = usual.locator("#video-0")
    card.get_by_text("File, hash and command").click()
    button = card.get_by_role("button", name="Copy the command")
    button.click()
    expect(button).to_have_text("Copied")
    usual.evaluate(
        """() => {
            navigator.clipboard.writeText = () => Promise.reject(new Error("no"));
            document.execCommand = () => false;
        }"""
    )
    card.get_by_role("button", name="Copy the hash").click()
    expect(card.get_by_role("button", name="Copy the hash")).to_have_text("Selected")
    assert usual.evaluate("getSelection().toString()") == "0123456789abcdef" * 4


# --- All episodes -----------------------------------------------------------------


@pytest.mark.thorough
def test_the_table_of_episodes_filters_sorts_and_turns_pages(
    page: Page, tmp_path: Path
) -> None:
    """No more than a hundred rows are there at once."""
    long = task("long", np.arange(250.0))
    open_report(page, tmp_path, contents(long, task("short", [5.0, 6.0])))
    count = page.locator("#episodes-count")
    rows = page.locator("#episodes-table tbody tr")
    expect(count).to_have_text("Rows 1 to 100 of 252")
    expect(rows).to_have_count(100)
    page.locator("#episodes-next").press("Enter")
    page.locator("#episodes-next").click()
    expect(count).to_have_text("Rows 201 to 252 of 252")
    expect(page.locator("#episodes-next")).to_have_attribute("aria-disabled", "true")
    page.locator("#episodes-next").press("Enter")
    expect(rows).to_have_count(52)
    page.locator("#episodes-task").select_option(label="long")
    page.locator("#episodes-table").get_by_role("button", name="Return").click()
    expect(count).to_have_text("Rows 1 to 100 of 250")
    assert rows.first.locator("td").all_inner_texts()[:5] == [
        "long",
        "truncated",
        "0",
        "249",
        "249.0",
    ]


@pytest.mark.thorough
def test_a_phone_shows_which_episodes_failed(browser: Browser, tmp_path: Path) -> None:
    """And why, beside the task's name, without scrolling to the right."""
    reason = "PolicyError: " + "it gave an action of the wrong shape " * 4
    named = task("gymnasium/HalfCheetah-v5", [1.0] * 5, failures={0: reason})
    size: Any = {"width": 360, "height": 800}
    with browser.new_context(viewport=size) as context:
        for page in watched(context.new_page()):
            open_report(page, tmp_path, contents(named))
            outcome = page.locator("#episodes-table tbody tr").first.locator(".bad")
            expect(outcome).to_have_text(f"failed: {reason.strip()}")
            box = outcome.bounding_box()
            assert box is not None
            assert box["x"] + box["width"] <= 360


@pytest.mark.thorough
def test_the_summary_fits_on_paper(browser: Browser, tmp_path: Path) -> None:
    """With all of its columns, on A4 with margins of a centimetre."""
    known = {"success_known": 50, "success_rate": 0.5, "warnings": {"BADQACC": 12}}
    made = contents()
    tasks = [replace(t, summary=replace(t.summary, **known)) for t in made.tasks]
    with browser.new_context(viewport={"width": 718, "height": 900}) as context:
        for page in watched(context.new_page()):
            page.emulate_media(media="print")
            open_report(page, tmp_path, replace(made, tasks=tasks))
            assert page.evaluate("document.scrollingElement.scrollWidth") <= 718


@pytest.mark.thorough
def test_an_episodes_video_is_one_click_away(usual: Page) -> None:
    """Also where the gallery's filter has hidden it."""
    usual.get_by_role("radio", name="Worst").click()
    expect(usual.locator("#video-0")).to_be_hidden()
    usual.locator("#episodes-table").get_by_role("button", name="Return").click()
    usual.locator("#episodes-table tbody a").first.click()
    expect(usual.locator("#video-0")).to_be_in_viewport()
    assert usual.url.endswith("#video-0")


# --- For everybody ----------------------------------------------------------------


@pytest.mark.axe
@pytest.mark.parametrize("width", [360, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("report", [usual_report, hostile_report])
def test_nothing_keeps_people_out(
    browser: Browser, videos: Path, width: int, scheme: Any, report: Any
) -> None:
    """axe-core finds nothing serious, and a phone scrolls in one direction only."""
    size: Any = {"width": width, "height": 800}
    with browser.new_context(viewport=size, color_scheme=scheme) as context:
        for page in watched(context.new_page()):
            open_report(page, videos, report())
            page.evaluate(
                "document.querySelectorAll('details').forEach(d => d.open = true)"
            )
            assert page.evaluate("document.scrollingElement.scrollWidth") <= width
            found = Axe().run(page).response["violations"]
            bad = [
                (v["id"], v["impact"], [node["html"][:200] for node in v["nodes"]][:3])
                for v in found
                if v["impact"] in ("serious", "critical")
            ]
            assert bad == []


def test_what_a_stranger_wrote_stays_text(page: Page, videos: Path) -> None:
    """Markup is read, not run."""
    open_report(page, videos, hostile_report())
    assert page.title() == HOSTILE[0]
    expect(page.locator("h1")).to_have_text(HOSTILE[0])
    assert HOSTILE[1] in page.locator("#summary-table").inner_text()
    assert HOSTILE[2] in page.locator("#episodes-table").inner_text()
    assert page.locator("img[onerror]").count() == 0
    assert page.locator("img").count() == len(HOSTILE)
    assert page.locator("script").count() == 2


def test_the_policy_stops_what_is_not_the_pages_own(
    browser: Browser, videos: Path
) -> None:
    """Even if some markup came through, no script of it would run."""
    with browser.new_context() as context:
        page = context.new_page()
        open_report(page, videos, usual_report())
        page.evaluate(
            """() => {
                const script = document.createElement("script");
                script.textContent = "window.hasRun = true";
                document.body.append(script);
                const image = document.createElement("img");
                image.src = "http://127.0.0.1:9/x.png";
                document.body.append(image);
            }"""
        )
        assert page.evaluate("window.hasRun") is None


@pytest.mark.thorough
def test_the_keyboard_reaches_the_content_first(usual: Page) -> None:
    """By a link that shows itself only then."""
    usual.keyboard.press("Tab")
    skip = usual.get_by_role("link", name="Skip to the content")
    expect(skip).to_be_focused()
    expect(skip).to_be_in_viewport()
    usual.keyboard.press("Enter")
    expect(usual.locator("#content")).to_be_focused()


@pytest.mark.thorough
def test_without_scripts_everything_but_the_tools_is_there(
    browser: Browser, videos: Path
) -> None:
    """And the page says what is missing."""
    with browser.new_context(java_script_enabled=False) as context:
        page = context.new_page()
        open_report(page, videos, usual_report())
        links = page.get_by_role("link", name="Play dm_control/")
        expect(links).to_have_count(4)
        assert (links.first.get_attribute("href") or "").endswith(".mp4")
        expect(page.locator("#summary-table tbody tr")).to_have_count(2)
        expect(page.locator("noscript")).to_be_visible()
        expect(page.locator("#gallery-filter")).to_be_hidden()
        expect(page.locator("#episodes-tools")).to_be_hidden()


@pytest.mark.thorough
def test_paper_has_pictures_and_no_buttons(usual: Page) -> None:
    """The gallery is printed, the tools are not."""
    usual.emulate_media(media="print")
    expect(usual.locator("#gallery-filter")).to_be_hidden()
    expect(usual.locator("nav")).to_be_hidden()
    picture = usual.locator(".play").first
    expect(picture).to_be_visible()
    sign = "e => [getComputedStyle(e, '::before'), getComputedStyle(e, '::after')]"
    shown = picture.evaluate(f"e => ({sign})(e).map(s => s.display)")
    assert shown == ["none", "none"]


@pytest.mark.thorough
def test_of_ten_thousand_episodes_a_hundred_are_laid_out(
    page: Page, tmp_path: Path
) -> None:
    """Opening and sorting the page cost no more than what is shown."""
    returns = np.random.default_rng(0).normal(500, 200, 2000).tolist()
    shown = [video(i, file=f"{i}.mp4", poster=_PIXEL) for i in range(20)]
    tasks = [
        task(f"dm_control/task-{i}", returns, seeds=5, videos=shown) for i in range(5)
    ]
    open_report(page, tmp_path, contents(*tasks))
    expect(page.locator("#episodes-count")).to_have_text("Rows 1 to 100 of 10\u202f000")
    expect(page.locator("#episodes tbody tr")).to_have_count(100)
    page.locator("[data-key=total_reward] button").click()
    expect(page.locator("#episodes tbody tr")).to_have_count(100)
    assert page.evaluate("document.querySelectorAll('*').length") < 10_000


_PIXEL = (
    "data:image/png;base64,iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk"
    "YPhfDwAChwGA60e6kgAAAABJRU5ErkJggg=="
)
