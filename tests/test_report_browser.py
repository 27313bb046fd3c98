# SPDX-License-Identifier: Apache-2.0
"""Test report pages in headless Chromium with Playwright."""

import contextlib
import re
import shutil

import numpy as np
import pytest
from browsers import barriers_of, chromium, complaints_of
from parts import parametrize
from playwright.sync_api import expect
from report_contents import HOSTILE, contents, hostile_report, task, video

import mjrec
from mjrec.reporting.contents import Verdict
from mjrec.reporting.page import page_of
from mjrec.reporting.report_folder import write_report

pytestmark = pytest.mark.browser

FPS = 25
FRAMES = 50


@pytest.fixture(scope="module")
def browser():
    with chromium() as start:
        yield start()


@pytest.fixture
def page(browser):
    with page_of_width(browser, 1280) as page:
        yield page


@contextlib.contextmanager
def page_of_width(browser, width, **options):
    """Open a page, and check that it logs no errors and requests only files."""
    size = {"width": width, "height": 900}
    with browser.new_context(viewport=size, **options) as context:
        page = context.new_page()
        page.set_default_timeout(10_000)
        complaints = complaints_of(page, ("file://", "data:"))
        page.on("console", lambda line: complaints.append(line.text))
        yield page
        assert complaints == []


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report #1")
    frames = np.tile(np.arange(64, dtype=np.uint8)[:, None], (FRAMES, 48, 1, 3))
    for name in ("best", "worst"):
        mjrec.save_video(
            frames, folder, name_prefix=name, fps=FPS, episode_trigger=lambda _: True
        )
    return folder


def benchmark_report():
    """Return a report of two tasks with fifty episodes, with best and worst videos."""
    report = contents(problems=["b"])
    for each in report.tasks:
        order = np.argsort(each.episodes["total_reward"]).tolist()
        each.videos = [
            video(episode, file=f"{role}-episode-0.mp4", poster="", roles=(role,))
            for role, episode in (("best", order[-1]), ("worst", order[0]))
        ]
    report.verdicts.append(
        Verdict(source="run", verdict="PARTLY", counts={"believed": 3}, level="pixels")
    )
    return report


def open_report(page, folder, report):
    file = folder / "index.html"
    file.write_text(page_of(report), encoding="utf-8")
    page.goto(file.as_uri())


@pytest.fixture
def benchmark(page, videos):
    open_report(page, videos, benchmark_report())
    return page


def test_videos_play(benchmark):
    """Only one video plays at a time."""
    players = benchmark.locator("video")
    expect(players).to_have_count(0)
    buttons = benchmark.get_by_role("button", name="Play dm_control/")
    expect(buttons).to_have_count(4)
    for i, start in enumerate(("click", "Enter", "Space", "click")):
        button = buttons.first
        button.click() if start == "click" else button.press(start)
        player = players.nth(i)
        expect(player).to_be_focused()
        expect(player).to_have_accessible_name(re.compile(r"^dm_control/\S+, seed"))
        benchmark.wait_for_function(
            "i => document.querySelectorAll('video')[i].currentTime > 0.1", arg=i
        )
        facts = player.evaluate("v => [v.videoWidth, v.videoHeight, v.duration]")
        assert facts == [64, 48, pytest.approx(FRAMES / FPS, abs=1 / FPS)]
    playing = "[...document.querySelectorAll('video')].filter(v => !v.paused).length"
    assert benchmark.evaluate(playing) <= 1


@parametrize("single_file", [False, True])
def test_report_of_a_recording_plays(page, tmp_path, make_corridor, play, single_file):
    """The report works after the recording has been deleted."""
    directory = tmp_path / "recordings #1"
    with mjrec.Monitor(make_corridor(length=20), directory) as monitor:
        play(monitor, 3, seed=0)
    index = write_report(directory, tmp_path / "a report", single_file=single_file)
    shutil.rmtree(directory)
    page.goto(index.resolve().as_uri())
    expect(page.locator("#summary-table tbody tr")).to_have_count(1)
    expect(page.locator("#episodes-count")).to_have_text("Rows 1 to 3 of 3")
    page.get_by_role("button", name="Play").first.click()
    player = page.locator("video").first
    page.wait_for_function("() => document.querySelector('video').currentTime > 0.1")
    # There are 21 frames, for the reset and 20 steps, at 10 frames per second.
    assert player.evaluate("v => v.duration") == pytest.approx(2.1, abs=0.1)
    assert player.evaluate("v => v.poster") != ""


@pytest.mark.thorough
def test_tables_sort_by_mouse_and_keyboard(page, tmp_path):
    """Unknown values come last in both directions."""
    unknown = task("c", [2.0], failures={0: "x"})
    known = task("a", [3.0, 3.0]), task("b", [1.0])
    open_report(page, tmp_path, contents(*known, unknown))
    mean = page.locator("#summary-table th", has_text="Mean")
    names = page.locator("#summary-table tbody th")
    mean.get_by_role("button").click()
    expect(mean).to_have_attribute("aria-sort", "descending")
    assert names.all_inner_texts() == ["a", "b", "c"]
    mean.get_by_role("button").press("Enter")
    expect(mean).to_have_attribute("aria-sort", "ascending")
    assert names.all_inner_texts() == ["b", "a", "c"]
    expect(page.locator("#said")).to_have_text("Sorted by Mean, ascending")
    assert page.locator("[aria-sort]").count() == 1


@pytest.mark.thorough
def test_gallery_filters_by_mouse_and_keyboard(benchmark):
    """A link in the episode table makes a hidden video visible again."""

    def shown():
        cards = benchmark.locator(".card:not([hidden])").all()
        return [card.get_attribute("id") for card in cards]

    benchmark.get_by_role("radio", name="Worst").click()
    assert shown() == ["video-1", "video-3"]
    expect(benchmark.locator("#gallery-count")).to_have_text("2 of 4 videos")
    benchmark.locator("#gallery-task").select_option(label="dm_control/cheetah-run")
    assert shown() == ["video-3"]
    benchmark.get_by_role("radio", name="Worst").press("ArrowLeft")
    expect(benchmark.get_by_role("radio", name="Best")).to_be_checked()
    assert shown() == ["video-2"]
    benchmark.locator("#episodes-table").get_by_role("button", name="Return").click()
    benchmark.locator("#episodes-table tbody a").first.click()
    expect(benchmark.locator("#video-0")).to_be_in_viewport()
    assert benchmark.url.endswith("#video-0")


@pytest.mark.thorough
def test_command_is_copied_or_selected(benchmark):
    """If the browser denies access to the clipboard, the text is selected instead."""
    card = benchmark.locator("#video-0")
    card.get_by_text("File, hash and command").click()
    command = card.get_by_role("button", name="Copy the command")
    sha256 = card.get_by_role("button", name="Copy the hash")
    command.click()
    expect(command).to_have_text("Copied")
    benchmark.evaluate(
        """() => {
            navigator.clipboard.writeText = () => Promise.reject(new Error("no"));
            document.execCommand = () => false;
        }"""
    )
    sha256.click()
    expect(sha256).to_have_text("Selected")
    assert benchmark.evaluate("getSelection().toString()") == "0123456789abcdef" * 4


@pytest.mark.thorough
def test_large_tables_show_a_hundred_rows_a_page(page, tmp_path):
    shown = [video(i, file=f"{i}.mp4", poster="") for i in range(20)]
    tasks = [task(name, np.arange(2000.0), videos=shown) for name in "abcde"]
    open_report(page, tmp_path, contents(*tasks, task("short", np.arange(152.0))))
    count = page.locator("#episodes-count")
    rows = page.locator("#episodes tbody tr")
    expect(count).to_have_text("Rows 1 to 100 of 10\u202f152")
    expect(rows).to_have_count(100)
    assert page.evaluate("document.querySelectorAll('*').length") < 10_000
    page.locator("#episodes-task").select_option(label="short")
    page.locator("#episodes-next").click()
    expect(count).to_have_text("Rows 101 to 152 of 152")
    expect(page.locator("#episodes-next")).to_have_attribute("aria-disabled", "true")
    page.locator("#episodes-next").press("Enter")
    expect(rows).to_have_count(52)
    page.locator("[data-key=total_reward] button").click()
    expect(count).to_have_text("Rows 1 to 100 of 152")
    cells = rows.first.locator("td").all_inner_texts()
    assert cells[:5] == ["short", "truncated", "0", "151", "151.0"]


@pytest.mark.axe
@pytest.mark.parametrize("width", [360, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("report", [benchmark_report, hostile_report])
def test_page_is_accessible(browser, videos, width, scheme, report):
    """axe-core finds no serious problem, and phones need no horizontal scrolling."""
    with page_of_width(browser, width, color_scheme=scheme) as page:
        open_report(page, videos, report())
        page.evaluate(
            "document.querySelectorAll('details').forEach(d => d.open = true)"
        )
        assert page.evaluate("document.scrollingElement.scrollWidth") <= width
        assert barriers_of(page) == []


@pytest.mark.thorough
def test_printed_page_has_all_frames_and_no_buttons(browser, videos):
    """The page is as wide as A4 paper with margins of one centimeter."""
    with page_of_width(browser, 718) as page:
        page.emulate_media(media="print")
        open_report(page, videos, benchmark_report())
        assert page.evaluate("document.scrollingElement.scrollWidth") <= 718
        expect(page.locator("#gallery-filter")).to_be_hidden()
        expect(page.locator("nav")).to_be_hidden()
        frame = page.locator(".play").first
        expect(frame).to_be_visible()
        signs = "['::before', '::after'].map(p => getComputedStyle(e, p).display)"
        assert frame.evaluate(f"e => {signs}") == ["none", "none"]


def test_hostile_text_stays_text(page, browser, videos):
    """Even if a script were injected, the page's security policy would block it."""
    open_report(page, videos, hostile_report())
    assert page.title() == HOSTILE[0]
    expect(page.locator("h1")).to_have_text(HOSTILE[0])
    assert HOSTILE[1] in page.locator("#summary-table").inner_text()
    assert HOSTILE[2] in page.locator("#episodes-table").inner_text()
    assert page.locator("img[onerror]").count() == 0
    assert page.locator("img").count() == len(HOSTILE)
    assert page.locator("script").count() == 2
    # Blocking logs an error, so this page must be opened without the check for errors.
    with browser.new_context() as context:
        page = context.new_page()
        open_report(page, videos, benchmark_report())
        page.evaluate(
            """document.body.append(Object.assign(
                document.createElement("script"), {textContent: "hasRun = true"}))"""
        )
        assert page.evaluate("window.hasRun") is None


@pytest.mark.thorough
def test_page_without_scripts_lacks_only_its_tools(browser, videos):
    with browser.new_context(java_script_enabled=False) as context:
        page = context.new_page()
        open_report(page, videos, benchmark_report())
        links = page.get_by_role("link", name="Play dm_control/")
        expect(links).to_have_count(4)
        assert (links.first.get_attribute("href") or "").endswith(".mp4")
        expect(page.locator("#summary-table tbody tr")).to_have_count(2)
        expect(page.locator("noscript")).to_be_visible()
        expect(page.locator("#gallery-filter")).to_be_hidden()
        expect(page.locator("#episodes-tools")).to_be_hidden()
