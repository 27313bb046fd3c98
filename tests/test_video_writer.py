# SPDX-License-Identifier: Apache-2.0
"""Written videos, decoded with PyAV, which mjrec does not use."""

import contextlib
import hashlib
import os
import re
import signal
import tracemalloc
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from full_disk import file_size_limit
from other_python import run_python
from processes import children

import mjrec
from mjrec.errors import (
    ClosedError,
    DirectoryNotWritable,
    EncoderError,
    FrameCountError,
    InvalidArgument,
    InvalidFrame,
    UnknownName,
)
from mjrec.formats.ffmpeg import every_frame_arguments, ffmpeg_executable, run_ffmpeg
from mjrec.formats.video_writer import VideoWriter

BITS = 8


def numbered(number, *, height=16, width=128):
    """Return a frame that shows its number as black and white bars."""
    bits = [255 * (number >> bit & 1) for bit in range(BITS)]
    row = np.repeat(np.array(bits, np.uint8), width // BITS)
    return np.broadcast_to(row[None, :, None], (height, len(row), 3)).copy()


def number_of(frame):
    middles = frame[frame.shape[0] // 2, frame.shape[1] // BITS // 2 :, 0]
    bars = middles[:: frame.shape[1] // BITS] > 127
    return sum(1 << bit for bit, is_set in enumerate(bars) if is_set)


def check_numbers(path, count):
    """Check that a video shows each number once, in order."""
    assert [number_of(frame) for frame in read(path)] == list(range(count))


def scene(number, *, height=96, width=128):
    """Return a frame of moving gradients, an edge and noise."""
    y, x = np.mgrid[0:height, 0:width]
    planes = [2 * x + 3 * number, 2 * y + number, x + y + 5 * number]
    frame = np.stack(planes, axis=-1) % 256
    frame[10:30, 5 * number % width :] = (200, 30, 60)
    noise = np.random.default_rng(number).integers(0, 40, frame.shape)
    return np.clip(frame + noise - 20, 0, 255).astype(np.uint8)


def record(path, frames, **options):
    with VideoWriter(path, **{"fps": 40, **options}) as video:
        for frame in frames:
            video.write(frame)
    return video.result


def read(path, pixel_format="rgb24"):
    with av.open(str(path)) as container:
        frames = container.decode(video=0)
        return [frame.to_ndarray(format=pixel_format) for frame in frames]


def run_child(code, **options):
    """Run code with the names of this module."""
    head = f"import sys\nsys.path.insert(0, {str(Path(__file__).parent)!r})\n"
    return run_python(f"{head}from test_video_writer import *\n{code}", **options)


@pytest.mark.parametrize(
    ("fps", "count"),
    # With few frames, ffmpeg mistakes some rates for common ones, as 125 for 120.
    [(29.97, 101), (0.5, 9), (Fraction(1000000, 33333), 101), (125, 3), (241, 1)],
)
def test_the_file_has_every_frame_once_in_order_at_the_exact_rate(tmp_path, fps, count):
    result = record(tmp_path / "a.mp4", map(numbered, range(count)), fps=fps)
    check_numbers(result.path, count)
    assert result.frame_count == count
    rate = Fraction(str(fps))
    with av.open(str(result.path)) as container:
        stream = container.streams.video[0]
        packets = [p for p in container.demux(stream) if p.pts is not None]
    shown = sorted((p.pts * p.time_base, p.duration * p.time_base) for p in packets)
    assert shown == [(n / rate, 1 / rate) for n in range(count)]


def test_a_rate_that_no_file_can_store_is_rounded_or_an_error(tmp_path):
    """The result has the file's rate: near the given float, while a fraction fails."""
    result = record(tmp_path / "a.mp4", map(numbered, range(9)), fps=59.940059)
    with av.open(str(result.path)) as container:
        assert container.streams.video[0].average_rate == result.fps
    assert result.fps == pytest.approx(59.940059, rel=1e-6)
    with pytest.raises(InvalidArgument, match="59940059/1000000 cannot be stored"):
        VideoWriter(tmp_path / "b.mp4", fps=Fraction(59940059, 1000000))


def test_the_default_plays_everywhere_in_true_colors(tmp_path):
    """It is H.264 High with its index first, and samples and tags of bt709."""
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]])
    bars = np.repeat(colors.astype(np.uint8), 32, axis=0)
    result = record(tmp_path / "a.mp4", [np.broadcast_to(bars, (64, 128, 3))] * 3)
    with av.open(str(result.path)) as container:
        assert len(container.streams) == 1
        codec = container.streams.video[0].codec_context
        assert (codec.name, codec.profile) == ("h264", "High")
        assert codec.pix_fmt == result.pixel_format == "yuv420p"
        bt709, limited = 1, 1
        assert codec.color_primaries == codec.color_trc == codec.colorspace == bt709
        assert codec.color_range == limited
    data = result.path.read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")
    planes = read(result.path, "yuv420p")[1]
    weights = np.array([0.2126, 0.7152, 0.0722])
    # The limited range is 16 to 235.
    luma = 16 + 219 * colors @ weights / 255
    np.testing.assert_allclose(planes[32, 16:128:32], luma, atol=3)
    blue = planes[64:80].reshape(-1)[: 32 * 64].reshape(32, 64)[16, 8:64:16]
    difference = (colors[:, 2] - colors @ weights) / 255 / 1.8556
    np.testing.assert_allclose(blue, 128 + 224 * difference, atol=3)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (63, 97)])
def test_an_odd_size_is_padded_by_one_pixel(tmp_path, height, width):
    """The padding repeats the edge; nothing moves."""
    gray = np.repeat(scene(0)[:height, :width, :1], 3, axis=2)
    result = record(tmp_path / "a.mp4", [gray] * 2, crf=1)
    (shown, _) = read(result.path)
    assert (result.height, result.width) == (height, width)
    padded = (height + 1, width + 1)
    assert shown.shape[:2] == padded == (result.padded_height, result.padded_width)
    expected = np.pad(gray, ((0, 1), (0, 1), (0, 0)), mode="edge")
    assert np.abs(shown.astype(int) - expected).max() <= 8


@pytest.mark.parametrize(
    ("name", "options", "is_lossless"),
    [
        ("a.mkv", {"codec": "ffv1"}, True),
        ("b.mkv", {"codec": "libx264rgb"}, True),
        ("c.avi", {"codec": "utvideo"}, True),
        ("a.mp4", {"codec": "mpeg4"}, False),
        ("a.mov", {}, False),
        # Lossless x264 has another profile than High.
        ("a.mp4", {"crf": 0}, False),
        ("http:a %03d ü|'\".mp4", {}, False),
    ],
)
def test_other_codecs_formats_and_names_work(
    tmp_path, monkeypatch, name, options, is_lossless
):
    """Lossless codecs keep every pixel; ffmpeg never interprets a name."""
    monkeypatch.chdir(tmp_path)
    frames = [numbered(n, height=31, width=128)[:, :127] for n in range(9)]
    result = record(Path(name), frames, **options)
    assert result.path == tmp_path / name
    shown = read(result.path)
    assert [number_of(frame) for frame in shown] == list(range(9))
    if is_lossless:
        np.testing.assert_array_equal([each[:31, :127] for each in shown], frames)


def test_the_result_describes_the_file(tmp_path):
    """The hashes of frames of odd sizes are those of the unpadded frames."""
    originals = [scene(number)[:31, 46::-1] for number in range(6)]
    path = tmp_path / "a.mp4"
    result = record(path, originals, fps=29.97, frame_hashes=True)
    assert result.file_sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    planes = b"".join(frame.tobytes() for frame in read(path, "yuv420p"))
    assert result.decoded_sha256 == hashlib.sha256(planes).hexdigest()
    assert result.fps == Fraction(2997, 100)
    assert result.encoder["arguments"][-1] == "a.mp4"
    assert str(tmp_path) not in " ".join(result.encoder["arguments"])
    arguments = (
        "-v error -f rawvideo -pix_fmt rgb24 -s 47x31 -r 2997/100 -i - "
        "-fflags +bitexact -f framehash -"
    )
    raw = b"".join(frame.tobytes() for frame in originals)
    hashes = run_ffmpeg(arguments.split(), standard_input=raw)
    assert result.frame_hash_path == tmp_path / "a.framehash"
    assert result.frame_hash_path.read_bytes() == hashes


def test_the_file_does_not_depend_on_the_cpu(tmp_path):
    """Without SIMD and on one core, the bytes are the same."""
    usual = record(tmp_path / "a.mp4", map(scene, range(20))).path.read_bytes()
    slow = ("-cpuflags", "0", "-x264-params", "cpu-independent=1:asm=0")
    other = record(tmp_path / "b.mp4", map(scene, range(20)), encoder_arguments=slow)
    assert other.path.read_bytes() == usual
    code = (
        "os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "record(Path('c.mp4'), map(scene, range(20)))"
    )
    run_child(code, cwd=tmp_path)
    assert (tmp_path / "c.mp4").read_bytes() == usual


def test_close_gives_the_file_its_name(tmp_path, names):
    """It replaces an older file and its hashes; without frames, there is no file."""
    path = tmp_path / "a.mp4"
    with VideoWriter(path, fps=40, frame_hashes=True) as video:
        pass
    assert (video.result, names(tmp_path)) == (None, [])
    buffer = numbered(0)
    with VideoWriter(path, fps=40, frame_hashes=True) as video:
        for number in range(64):
            # `write` must copy the frame.
            buffer[:] = numbered(number)
            video.write(buffer)
        assert not path.exists()
        with pytest.raises(InvalidFrame, match="the same size"):
            video.write(numbered(1)[:8])
    assert names(tmp_path) == ["a.framehash", "a.mp4"]
    check_numbers(path, 64)
    video.close()
    with pytest.raises(ClosedError, match=r"a\.mp4 was closed after 64 frames"):
        video.write(numbered(2))
    record(path, map(numbered, range(5)))
    assert names(tmp_path) == ["a.mp4"]


@pytest.mark.usefixtures("no_process_is_left")
def test_abort_leaves_nothing_and_a_later_close_does_nothing(tmp_path):
    old = record(tmp_path / "a.mp4", [numbered(0)])
    video = VideoWriter(tmp_path / "a.mp4", fps=40, frame_hashes=True)
    for number in range(100):
        video.write(scene(number))
    video.abort()
    video.abort()
    video.close()
    assert video.result is None
    assert list(tmp_path.iterdir()) == [old.path]
    assert hashlib.sha256(old.path.read_bytes()).hexdigest() == old.file_sha256


@pytest.mark.usefixtures("no_process_is_left")
@pytest.mark.parametrize("more", [0, 5000])
def test_write_or_close_reports_a_killed_encoder(tmp_path, more):
    """No file is left."""
    before = children()
    video = VideoWriter(tmp_path / "a.mp4", fps=40, frame_hashes=True)
    video.write(scene(0))
    (encoder,) = children() - before
    os.kill(encoder, signal.SIGKILL)
    with pytest.raises(EncoderError, match="could not be encoded") as caught, video:  # noqa: PT012
        for number in range(more):
            video.write(scene(number % 7))
    # `write` noticed it soon.
    assert video.frame_count < max(more, 2)
    assert caught.value.returncode == -signal.SIGKILL
    assert "libx264" in caught.value.command
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("no_process_is_left")
@pytest.mark.parametrize("name", ["a.mp4", "a.framehash"])
def test_a_full_disk_is_an_error_that_names_the_file(tmp_path, monkeypatch, name):
    """No file is left."""
    out = tmp_path / "out"
    out.mkdir()
    limit = file_size_limit(2000)
    if name == "a.mp4":
        # Limit the encoder only.
        limit = contextlib.nullcontext()
        wrapper = tmp_path / "ffmpeg"
        begin = "#!/bin/bash\ntrap '' XFSZ; ulimit -f 20\n"
        wrapper.write_text(f'{begin}exec {ffmpeg_executable()} "$@"\n')
        wrapper.chmod(0o755)
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(wrapper))
    options = {"crf": 5, "frame_hashes": True}
    with pytest.raises(mjrec.Error, match=re.escape(name)), limit:
        record(out / "a.mp4", map(scene, range(60)), **options)
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "left"),
    [
        (("-vf", r"select=lt(n\,99),format=yuv420p"), 99),
        (("-r", "80", every_frame_arguments()[0], "cfr"), r"(199|200)"),
    ],
    ids=["last lost", "doubled"],
)
@pytest.mark.usefixtures("no_process_is_left")
def test_a_file_with_lost_or_doubled_frames_is_not_kept(tmp_path, arguments, left):
    frames = map(numbered, range(100))
    message = f"should contain 100 frames, but decoding it gives {left}"
    with pytest.raises(FrameCountError, match=message):
        record(tmp_path / "a.mp4", frames, encoder_arguments=arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "options", "error", "message"),
    [
        ("a.mp4", {"fps": 0}, InvalidArgument, "fps"),
        ("a.mp4", {"crf": 52}, InvalidArgument, "crf"),
        ("a.mp4", {"codec": "mpeg4", "crf": 18}, InvalidArgument, "not support crf"),
        ("a.mp4", {"codec": "gif"}, InvalidArgument, "gif"),
        ("a.mp4", {"codec": "libx265x"}, UnknownName, "libx264"),
        ("a.mp4", {"encoder_arguments": "-g 1"}, InvalidArgument, "encoder_arguments"),
        ("a.mp4", {"encoder_arguments": ("-nonsense", "1")}, EncoderError, "nonsense"),
        ("a.webm", {}, EncoderError, "libx264 into a webm file"),
        ("a.gif", {}, InvalidArgument, "name must end"),
        ("dir.mp4", {}, InvalidArgument, "directory"),
        ("missing/a.mp4", {}, DirectoryNotWritable, "missing"),
        ("/proc/a.mp4", {}, DirectoryNotWritable, "/proc"),
    ],
)
def test_the_constructor_refuses_wrong_arguments(
    tmp_path, names, name, options, error, message
):
    """The error names the argument, and no file is made."""
    (tmp_path / "dir.mp4").mkdir()
    with pytest.raises(error, match=message):
        VideoWriter(tmp_path / name, **{"fps": 40, **options})
    assert names(tmp_path) == ["dir.mp4"]


def test_memory_does_not_grow_with_the_video(tmp_path):
    """Two thousand frames of 48 KiB, written faster than encoded, need a few MiB."""
    frame = scene(0, height=128, width=128)
    tracemalloc.start()
    try:
        record(tmp_path / "a.mp4", (frame for _ in range(2000)))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 10 << 20


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_in_the_terminal_keeps_the_frames_so_far(tmp_path):
    """SIGINT reaches the whole process group, but not the encoder."""
    code = (
        "with VideoWriter('a.mp4', fps=40) as video:\n"
        "    for number in range(50):\n"
        "        video.write(numbered(number))\n"
        "    os.killpg(0, signal.SIGINT)\n"
        "    signal.pause()\n"
    )
    child = run_child(code, cwd=tmp_path, start_new_session=True, status=None)
    assert "KeyboardInterrupt" in child.stderr
    check_numbers(tmp_path / "a.mp4", 50)


def test_a_writer_that_is_never_closed_warns_and_loses_no_frame(tmp_path):
    code = (
        "import warnings\n"
        "before = children()\n"
        "video = VideoWriter('a.mp4', fps=40)\n"
        "for number in range(50):\n"
        "    video.write(numbered(number))\n"
        "encoder, = children() - before\n"
        "with warnings.catch_warnings(record=True) as caught:\n"
        "    warnings.simplefilter('always')\n"
        "    del video\n"
        "    assert 'never closed' in str(caught[0].message)\n"
        "    with contextlib.suppress(ChildProcessError):\n"
        "        os.waitpid(encoder, 0)\n"
    )
    run_child(code, cwd=tmp_path)
    (left,) = tmp_path.iterdir()
    check_numbers(left, 50)


def test_a_forked_child_cannot_touch_the_parents_video(tmp_path):
    """The child cannot finish or remove it, or keep the encoder's input open."""
    code = (
        "video = VideoWriter('a.mp4', fps=40)\n"
        # As this is more than queue and pipe hold, the encoder has created its file.
        "for number in range(120):\n"
        "    video.write(numbered(number, height=240, width=320))\n"
        "reading, writing = os.pipe()\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    try:\n"
        "        with video:\n"
        "            video.write(numbered(7, height=240, width=320))\n"
        "    except ClosedError:\n"
        "        os.write(writing, b'closed')\n"
        "    signal.pause()\n"
        "assert os.read(reading, 9) == b'closed'\n"
        "video.write(numbered(120, height=240, width=320))\n"
        "video.close()\n"
        "os.kill(child, signal.SIGKILL)\n"
    )
    run_child(code, cwd=tmp_path, timeout=60)
    check_numbers(tmp_path / "a.mp4", 121)
