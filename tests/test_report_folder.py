# SPDX-License-Identifier: Apache-2.0
"""Test reports as a self-contained folder and as a single file."""

import base64
import hashlib
import io
import json
import re
import shutil

import gymnasium
import numpy as np
import pytest
from PIL import Image

import mjrec
from mjrec.commands import main
from mjrec.commands.report import report
from mjrec.errors import DirectoryNotWritable, InvalidArgument
from mjrec.reporting.gathering import gather
from mjrec.reporting.media import ReportProgress, add_images
from mjrec.reporting.report_folder import write_report
from report_recordings import GYM, entry, record, write_journal


@pytest.fixture
def recordings(corridor, tmp_path):
    directory = tmp_path / "recordings"
    record(corridor, directory, 2)
    return directory


def names(folder):
    return sorted(
        str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()
    )


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_report_is_a_page_with_copies_of_media(recordings, tmp_path):
    """The report works without the recordings, and each step's progress is reported."""
    hashes = [sha256(path) for path in sorted(recordings.glob("*.mp4"))]
    progress = []
    page = write_report(
        recordings, tmp_path / "report", title="Mine", on_progress=progress.append
    )
    assert page == tmp_path / "report" / "index.html"
    steps = [("posters", 1), ("posters", 2), ("videos", 1), ("videos", 2)]
    assert progress == [ReportProgress(what, done, 2) for what, done in steps]
    shutil.rmtree(recordings)
    files = [
        f"{kind}/000{number}-unknown-corridor.{ending}"
        for kind, ending in (("posters", "jpg"), ("videos", "mp4"))
        for number in (0, 1)
    ]
    assert names(page.parent) == ["index.html", *files]
    copies = sorted((page.parent / "videos").iterdir())
    assert [sha256(path) for path in copies] == hashes
    assert all(path.stat().st_nlink == 1 for path in copies)
    text = page.read_text()
    for words in (*files, *hashes, "<title>Mine</title>"):
        assert words in text


def test_command_writes_a_report_of_several_directories(tmp_path, capsys, monkeypatch):
    """The command prints the path of the page; with `--json` the path is absolute."""
    monkeypatch.chdir(tmp_path)
    run = write_journal(tmp_path / "run", "0.a", "X-v0", [entry(0)]).parent
    verdict = {"path": "run", "level": "stats", "verdict": "FAIL", "findings": []}
    (tmp_path / "verdict.json").write_text(json.dumps(verdict))
    page = tmp_path / "r" / "index.html"
    directories = (run, GYM / "0.7.4" / "plain")
    options = {"title": "Both", "verification": (tmp_path / "verdict.json",)}
    assert report(directories, out=page.parent, **options) == 0
    assert capsys.readouterr().out == f"{page}\n"
    text = page.read_text()
    for words in ("<title>Both</title>", "X-v0", "Tiny-v0", "verdict.json"):
        assert words in text
    assert report((run,), as_json=True) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == {"page": str(tmp_path / "report" / "index.html")}
    with pytest.raises(InvalidArgument, match="max_single_file_bytes"):
        report((run,), out=page, single_file=True, max_single_file_bytes=10)


def test_posters_show_the_middle_frame(recordings):
    sizes = [(400, 800), (48, 64)]
    for video, size in zip(sorted(recordings.glob("*.mp4")), sizes, strict=True):
        with mjrec.VideoWriter(video, fps=10) as writer:
            for color in ((255, 0, 0), (20, 160, 90), (0, 0, 255)):
                writer.write(np.full((*size, 3), color, np.uint8))
    contents = gather(recordings)
    add_images(contents, lambda progress: None)
    posters = [Image.open(io.BytesIO(video.image)) for video in contents.videos]
    assert [image.size for image in posters] == [(640, 320), (64, 48)]
    for image in posters:
        assert image.format == "JPEG"
        np.testing.assert_allclose(image.getpixel((20, 20)), (20, 160, 90), atol=4)


def test_invalid_videos_are_named(recordings, tmp_path):
    """A truncated video is copied, but not an HTML file with the name of a video."""
    first, second = sorted(recordings.glob("*.mp4"))
    first.write_bytes(first.read_bytes()[:200])
    second.write_text("<html><script>alert(1)</script></html>")
    page = write_report(recordings, tmp_path / "report")
    assert names(page.parent) == ["index.html", "videos/0000-unknown-corridor.mp4"]
    text = page.read_text()
    assert "A video has no poster" in text
    assert "does not match its metadata" in text
    assert sha256(first) in text
    assert f"The video {second} is left out" in text


def test_hostile_env_id_is_text_and_no_file_name(tmp_path):
    env_id = "../<script>alert(1)</script>\u202e"
    write_journal(tmp_path / "run", "0.a", env_id, [entry(0)])
    for path in (GYM / "0.22.0" / "text").glob("*.video000000*.json"):
        name = path.name.replace("0.20545", "0.a")
        shutil.copyfile(path, tmp_path / "run" / name)
    page = write_report(tmp_path / "run", tmp_path / "report")
    copied = "videos/0000-script-alert-1-script.json"
    assert names(page.parent) == ["index.html", copied]
    assert "<script>alert" not in page.read_text()


def test_report_replaces_a_report_or_an_empty_folder(recordings, tmp_path):
    """If writing a report fails, the older report is kept."""
    (tmp_path / "report").mkdir()
    page = write_report(recordings, tmp_path / "report")
    before = page.read_text()

    def stop(progress):
        if progress == ReportProgress("videos", 2, 2):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_report(recordings, tmp_path / "report", title="2", on_progress=stop)
    assert page.read_text() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["recordings", "report"]
    run = tmp_path / "run"
    run.mkdir()
    # Even a directory with nothing but a damaged file gets a report.
    (run / "openaigym.manifest.1.b.manifest.json").write_text("{")
    page = write_report(run, tmp_path / "report")
    assert names(tmp_path / "report") == ["index.html"]
    assert "openaigym.manifest.1.b.manifest.json" in page.read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["recordings", "report", "run"]


@pytest.mark.parametrize(
    ("target", "mine", "options", "words"),
    [
        ("other", "other/index.html", {}, "index.html"),
        # Files were added to these reports, so they must not be replaced.
        ("report", "report/videos/mine.mp4", {}, "videos/mine.mp4"),
        ("report", "report/notes.txt", {}, "notes.txt"),
        ("recordings", "recordings/notes.txt", {}, "belong to a report"),
        ("mine.html", "mine.html", {"single_file": True}, "is not a report"),
        ("mine.html", "mine.html", {}, "single_file"),
        ("file", "file", {}, "is a file"),
        ("file/report", "file", {}, "file"),
    ],
)
def test_other_files_are_not_replaced(
    recordings, tmp_path, target, mine, options, words
):
    write_report(recordings, tmp_path / "report")
    (tmp_path / mine).parent.mkdir(exist_ok=True)
    (tmp_path / mine).write_text("mine")
    before = names(tmp_path)
    with pytest.raises((InvalidArgument, DirectoryNotWritable), match=words):
        write_report(recordings, tmp_path / target, **options)
    assert names(tmp_path) == before
    assert (tmp_path / mine).read_text() == "mine"


IMAGE = "<img[^>]* src=.data:image/jpeg;base64,"
VIDEO = "<a [^>]*href=.data:video/mp4;base64,"


def test_single_file_embeds_media_up_to_its_limit(recordings, tmp_path):
    """Posters take precedence over videos, and the page counts missing videos."""

    def write(name, **options):
        page = write_report(recordings, tmp_path / name, single_file=True, **options)
        return page, page.read_text()

    # A single file can replace an older one, and can be in a folder.
    for name in ("one.html", "one.html", "folder"):
        page, text = write(name)
        # Both videos are identical, so each occurs twice.
        for path in recordings.glob("*.mp4"):
            assert text.count(base64.b64encode(path.read_bytes()).decode()) == 2
        assert len(re.findall(VIDEO, text)) == len(re.findall(IMAGE, text)) == 2
        # Browsers do not open data URLs as pages, so links must download the video.
        assert all("download" in link for link in re.findall(VIDEO + "[^>]*", text))
    assert names(tmp_path / "folder") == ["index.html"]
    most = page.stat().st_size - 100
    part, text = write("part.html", max_single_file_bytes=most)
    assert part.stat().st_size <= most
    assert (len(re.findall(IMAGE, text)), len(re.findall(VIDEO, text))) == (2, 1)
    assert "1 of 2 videos are not embedded" in text
    with pytest.raises(InvalidArgument, match="without any image or video"):
        write("tiny.html", max_single_file_bytes=1000)
    assert not (tmp_path / "tiny.html").exists()


def test_replay_option_adds_three_pages_in_3d(tmp_path):
    """The pages show the best, the median and the worst episode."""
    pytest.importorskip("mjviser")
    env = gymnasium.make("Hopper-v5", max_episode_steps=3)
    record(env, tmp_path / "run", 4, height=48, width=64, video_callable=lambda _: True)
    page = tmp_path / "report/index.html"
    command = ["report", str(tmp_path / "run"), "--replay", "-o", str(page.parent)]
    assert main(command) == 0
    links = re.findall(r'href="\./(replays/[^"]+)"', page.read_text())
    assert len(set(links)) == 3
    assert all("replay-data" in (page.parent / each).read_text() for each in links)
    # A later report replaces this one.
    write_report(tmp_path / "run", tmp_path / "report")
    assert not (tmp_path / "report" / "replays").exists()
    with pytest.raises(InvalidArgument, match="Replays are separate pages"):
        write_report(tmp_path / "run", tmp_path / "x", single_file=True, replays=True)
