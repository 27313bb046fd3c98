# SPDX-License-Identifier: Apache-2.0
"""What recordings look like in a notebook."""

from __future__ import annotations

import base64
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

import mjrec
from mjrec.formats import notebook


def videos_in(text: str) -> list[bytes]:
    """Return the videos that an output holds."""
    found = re.findall(r'src="data:video/mp4;base64,([^"]+)"', text)
    return [base64.b64decode(each) for each in found]


# Takes more than five seconds: an episode is evaluated, and drawn twice.
@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Evaluate an episode; return what can be shown of it, by kind."""
    evaluation = mjrec.evaluate(
        ["InvertedPendulum-v5"],
        policy="zero",
        directory=tmp_path_factory.mktemp("evaluation") / "results",
        episodes=1,
        num_seeds=1,
        max_steps=2,
        workers=1,
        height=32,
        width=32,
        keep="all",
    )
    [video] = evaluation.videos
    [episode] = mjrec.iter_episodes(video.parent)
    return {
        "evaluation": evaluation,
        "episode": episode,
        "trajectory": mjrec.load_trajectory(episode.trajectory or ""),
        "rendered": mjrec.render_videos(
            video.parent, episode=episode.episode_id, height=48, width=48
        ),
    }


SAID = {
    "evaluation": ["<td>episodes</td><td>1</td>", "InvertedPendulum-v5", "95%"],
    "episode": ["Episode 0", "<td>steps</td><td>2</td>", "truncated"],
    "trajectory": ["InvertedPendulum-v5, episode 0", "<td>return</td><td>2</td>"],
    "rendered": ["1 rendered, 0 failed", "<td>frames</td><td>3</td>", "48x48"],
}


@pytest.mark.parametrize("kind", SAID)
def test_a_recording_shows_numbers_and_a_player(
    kind: str, recorded: dict[str, Any]
) -> None:
    """The video is in the output itself, byte for byte, and its name below it."""
    text = recorded[kind]._repr_html_()
    for words in SAID[kind]:
        assert words in text
    [path] = recorded["evaluation"].videos
    if kind == "rendered":
        [path] = [path.parent / name for name in recorded[kind].videos]
    assert videos_in(text) == [path.read_bytes()]
    assert path.name in text


def test_text_of_files_is_escaped(tmp_path: Path) -> None:
    """What a stranger's file says never becomes a part of the page."""
    bad = "<script>alert(1)</script>"
    text = notebook.shown(
        bad, {bad: bad}, [tmp_path / f"{bad}.mp4"], columns=[bad], rows=[[bad]]
    )
    assert "<script" not in text
    assert text.count("&lt;script") >= 5


def test_large_and_missing_videos_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An output stays small: what does not fit, or is gone, or a link, is a name."""
    monkeypatch.setattr(notebook, "MOST_BYTES", 10)
    for name, size in (("a", 6), ("b", 5), ("c", 4)):
        (tmp_path / f"{name}.mp4").write_bytes(name.encode() * size)
    (tmp_path / "link.mp4").symlink_to("/etc/hostname")
    paths = [tmp_path / f"{name}.mp4" for name in ("a", "b", "c", "gone", "link")]
    text = notebook.shown("x", videos=paths)
    assert videos_in(text) == [b"a" * 6, b"c" * 4]
    assert all(path.name in text for path in paths)


@pytest.mark.browser
def test_a_browser_plays_it(recorded: dict[str, Any], tmp_path: Path) -> None:
    """Chromium decodes the video of the output, in its size."""
    # Here, because the environments without a browser have no Playwright.
    from playwright.sync_api import sync_playwright

    page = tmp_path / "page.html"
    page.write_text(recorded["trajectory"]._repr_html_())
    with sync_playwright() as playwright:
        found = shutil.which("chromium") or playwright.chromium.executable_path
        options = ["--no-sandbox", "--disable-gpu"]
        browser = playwright.chromium.launch(executable_path=found, args=options)
        shown = browser.new_page()
        shown.goto(page.as_uri())
        shown.wait_for_function("document.querySelector('video').readyState >= 2")
        assert shown.evaluate("document.querySelector('video').videoWidth") == 32
        browser.close()
