# SPDX-License-Identifier: Apache-2.0
"""Test how recordings are displayed in notebooks."""

import base64
import re

import pytest

import mjrec
from mjrec.formats import notebook


def videos_in(text):
    found = re.findall(r'src="data:video/mp4;base64,([^"]+)"', text)
    return [base64.b64decode(each) for each in found]


# Takes more than five seconds: it evaluates an episode and renders it twice.
@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Evaluate an episode; return its video and a displayable object of each kind."""
    small = {"episodes": 1, "num_seeds": 1, "max_steps": 2, "height": 32, "width": 32}
    directory = tmp_path_factory.mktemp("evaluation") / "results"
    options = {"policy": "zero", "directory": directory, "workers": 1, "keep": "all"}
    evaluation = mjrec.evaluate(["InvertedPendulum-v5"], **options, **small)
    [video] = evaluation.videos
    [episode] = mjrec.iter_episodes(video.parent)
    chosen = {"episode": episode.episode_id, "height": 48, "width": 48}
    rendered = mjrec.render_videos(video.parent, **chosen)
    return video, {
        "evaluation": evaluation,
        "episode": episode,
        "trajectory": mjrec.load_trajectory(episode.trajectory),
        "rendered": rendered,
    }


@pytest.mark.parametrize(
    ("kind", "texts"),
    [
        ("evaluation", ["<td>episodes</td><td>1</td>", "InvertedPendulum-v5", "95%"]),
        ("episode", ["Episode 0", "<td>steps</td><td>2</td>", "truncated"]),
        ("trajectory", ["InvertedPendulum-v5, episode 0", "<td>return</td><td>2</td>"]),
        ("rendered", ["1 rendered, 0 failed", "<td>frames</td><td>3</td>", "48x48"]),
    ],
)
def test_recording_shows_numbers_and_a_player(kind, texts, recorded):
    """The output embeds the video and shows its file name."""
    path, displayed = recorded
    text = displayed[kind]._repr_html_()
    if kind == "rendered":
        [path] = [path.parent / name for name in displayed[kind].videos]
    assert videos_in(text) == [path.read_bytes()]
    for words in (*texts, path.name, "<video "):
        assert words in text


def test_text_of_files_is_escaped(tmp_path):
    bad = "<script>alert(1)</script>"
    paths = [tmp_path / f"{bad}.mp4"]
    text = notebook.shown(bad, {bad: bad}, paths, columns=[bad], rows=[[bad]])
    assert "<script" not in text
    assert text.count("&lt;script") >= 5


def test_large_and_missing_videos_are_named(tmp_path, monkeypatch):
    """Videos over the limit, missing videos and links are shown only by name."""
    monkeypatch.setattr(notebook, "MOST_BYTES", 10)
    for name, size in (("a", 6), ("b", 5), ("c", 4)):
        (tmp_path / f"{name}.mp4").write_bytes(name.encode() * size)
    (tmp_path / "link.mp4").symlink_to("/etc/hostname")
    paths = [tmp_path / f"{name}.mp4" for name in ("a", "b", "c", "gone", "link")]
    text = notebook.shown("x", videos=paths)
    assert videos_in(text) == [b"a" * 6, b"c" * 4]
    assert all(path.name in text for path in paths)
