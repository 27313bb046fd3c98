# SPDX-License-Identifier: Apache-2.0
"""Test that film strips show the right frames and times."""

import json
import sys

import gymnasium
import numpy as np
import pytest
from PIL import Image
from recordings import frames_of

import mjrec
from mjrec.annotation import check_annotation
from mjrec.commands.strip import strip
from mjrec.errors import FileNotWritten, InvalidArgument, UnreadableFile
from mjrec.reporting import film_strips as module
from mjrec.reporting.film_strips import film_strip, write_film_strip
from mjrec.reporting.video_stream import frames_at, read_stream
from report_recordings import record

HEIGHT, WIDTH = 47, 64


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Record an episode of ten 0.05 s steps with frames of odd height."""
    directory = tmp_path_factory.mktemp("strip")
    size = {"width": WIDTH, "height": HEIGHT, "max_episode_steps": 10}
    env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array", **size)
    record(env, directory, 1)
    return directory


@pytest.fixture
def video(recorded):
    [path] = recorded.glob("*.mp4")
    return path


def cells(strip, rows, columns, height=HEIGHT, width=WIDTH):
    """Return the frames of a strip."""
    gap = max(2, round(0.03 * min(height, width)))
    row_height = (strip.shape[0] - gap) // rows
    return [
        strip[gap + row * row_height :, gap + column * (width + gap) :][:height, :width]
        for row in range(rows)
        for column in range(columns)
    ]


@pytest.fixture
def labels(monkeypatch):
    """Return a list that receives the labels under the frames."""
    written, labels_of = [], module._labels

    def write(seconds):
        written[:] = labels_of(seconds)
        return written

    monkeypatch.setattr(module, "_labels", write)
    return written


@pytest.mark.thorough
def test_frames_of_a_trajectory_are_rendered_from_any_camera(recorded, labels):
    [trajectory] = recorded.glob("*.h5")
    rendered = list(mjrec.render(trajectory))
    shown = cells(film_strip(trajectory, frames=3), 1, 3)
    np.testing.assert_array_equal(shown, [rendered[index] for index in (0, 5, 10)])
    assert labels == ["0.00 s", "0.25 s", "0.50 s"]
    other = {"height": 96, "width": 128, "camera": "track", "quality": "draft"}
    first, _ = cells(film_strip(trajectory, frames=2, **other), 1, 2, 96, 128)
    np.testing.assert_array_equal(first, next(mjrec.render(trajectory, **other)))


def test_frames_of_a_video_are_decoded_with_simulated_times(video, labels):
    """The frames omit the row of padding that makes the video's height even."""
    strip = film_strip(video, frames=6, columns=3)
    decoded = np.array(frames_of(video)[::2])[:, :HEIGHT].astype(int)
    assert np.abs(cells(strip, 2, 3) - decoded).max() <= 2
    # The margins are white, and the labels are below the frames.
    assert (strip[:2] == 255).all()
    assert (strip[:, :2] == 255).all()
    assert strip[2 + HEIGHT : strip.shape[0] // 2, :, 0].min() < 64
    assert labels == [f"{t:.2f} s" for t in (0, 0.1, 0.2, 0.3, 0.4, 0.5)]


@pytest.mark.parametrize(
    "text",
    [
        None,
        "[]",
        '{"height": 47, "width": 64, "timestep": "1/0"}',
        '{"height": 47, "width": 64, "timestep": "1/20", "stride": 1, '
        '"frame_count": 11, "frame_steps": [[0, 1000000000000]]}',
        '{"height": 3, "width": 3, "timestep": "1/20"}',
    ],
)
def test_invalid_metadata_does_not_change_the_times(video, tmp_path, text, labels):
    """Metadata with an impossible number of frames must not be trusted."""
    copy = tmp_path / "copy.mp4"
    copy.write_bytes(video.read_bytes())
    if text is not None:
        copy.with_suffix(".meta.json").write_text(text)
    strip = film_strip(copy, frames=2)
    assert labels == ["0.00 s", "0.50 s"]
    assert strip.shape[1] == 3 * 2 + 2 * WIDTH


@pytest.mark.parametrize(("frames", "columns"), [(8, 8), (9, 5)])
def test_rows_have_equal_lengths_of_at_most_eight_frames(video, frames, columns):
    strip = film_strip(video, frames=frames)
    assert strip.shape[1] == 2 + columns * (WIDTH + 2)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("mp4", {"frames": 12}, "has only 11 frames, not 12"),
        ("h5", {"frames": 12}, "has only 11 frames, not 12"),
        ("mp4", {"frames": 0}, "frames"),
        ("mp4", {"columns": -1}, "columns"),
        ("mp4", {"camera": "track"}, "trajectory"),
        ("mp4", {"frames": 4}, "Request fewer or smaller"),
    ],
)
def test_impossible_strips_are_errors(recorded, monkeypatch, kind, options, message):
    [file] = recorded.glob(f"*.{kind}")
    monkeypatch.setattr(module, "_MOST_PIXELS", 3 * HEIGHT * WIDTH)
    assert film_strip(file, frames=2).size
    with pytest.raises(InvalidArgument, match=message):
        film_strip(file, **options)


def test_unreadable_files_are_errors_with_the_name(video, tmp_path):
    text, cut = tmp_path / "notes.txt", tmp_path / "cut.mp4"
    text.write_text("no video")
    cut.write_bytes(video.read_bytes()[:600])
    with pytest.raises(UnreadableFile, match="neither a video"):
        film_strip(text)
    for path in (tmp_path / "nothing.mp4", cut):
        with pytest.raises(mjrec.Error, match=path.name):
            film_strip(path)


@pytest.mark.parametrize("ending", [".mp4", ".avi", ".mkv"])
def test_exact_frames_of_each_kind_of_video_are_read(tmp_path, ending):
    """At this frame rate, times are not round numbers."""
    path = tmp_path / f"gray{ending}"
    with mjrec.VideoWriter(path, fps=30) as writer:
        for i in range(40):
            writer.write(np.full((16, 16, 3), 6 * i, np.uint8))
    stream = read_stream(path)
    assert (len(stream), stream.seconds) == (40, pytest.approx(4 / 3, abs=0.01))
    # These are too many frames to decode in a single run of ffmpeg.
    indices = [i for i in range(40) if i % 5]
    means = [frame.mean() for frame in frames_at(stream, indices)]
    np.testing.assert_allclose(means, [6 * i for i in indices], atol=2)


def test_strip_is_a_png_with_300_dots_per_inch(video, tmp_path):
    """A failed attempt leaves no file."""
    strip = film_strip(video, frames=2)
    with pytest.raises(InvalidArgument, match=r"strip\.png"):
        write_film_strip(tmp_path / "strip.jpg", strip)
    with pytest.raises(FileNotWritten):
        write_film_strip(tmp_path / "nowhere" / "strip.png", strip)
    assert list(tmp_path.iterdir()) == []
    write_film_strip(tmp_path / "strip.png", strip)
    with Image.open(tmp_path / "strip.png") as image:
        assert image.info["dpi"] == pytest.approx((300, 300), abs=0.1)
        np.testing.assert_array_equal(np.asarray(image), strip)


def test_command_writes_a_strip_and_prints_its_size(video, tmp_path, capsys):
    """An impossible request writes no file."""
    out = tmp_path / "strip.png"
    with pytest.raises(InvalidArgument, match="trajectory"):
        strip(video, size="640x480", out=out)
    assert not out.exists()
    assert strip(video, frames=6, columns=2, out=out) == 0
    with Image.open(out) as image:
        assert image.width == 2 + 2 * (WIDTH + 2)
        assert f"{image.width}x{image.height} pixels" in capsys.readouterr().out
    assert strip(video, frames=1, out=out, as_json=True) == 0
    printed = json.loads(capsys.readouterr().out)
    height = printed["height"]
    assert printed == {"strip": str(out), "width": 4 + WIDTH, "height": height}


def test_missing_pillow_is_an_error(video, monkeypatch):
    check_annotation.cache_clear()
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(mjrec.MissingDependency, match="Pillow"):
        film_strip(video)
