# SPDX-License-Identifier: Apache-2.0
"""The video writer, read back with another decoder (PyAV)."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import select
import signal
import subprocess
import sys
import threading
import tracemalloc
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from interruption import ctrl_c_once_there_is, ctrl_c_soon
from processes import children

from mjrec.errors import (
    ClosedError,
    DirectoryNotWritable,
    EncoderError,
    FrameCountError,
    InvalidArgument,
    InvalidFrame,
    UnknownName,
)
from mjrec.formats.ffmpeg import (
    FfmpegProcess,
    every_frame_arguments,
    ffmpeg_executable,
    run_ffmpeg,
)
from mjrec.formats.video_file import VideoFile
from mjrec.formats.video_writer import VideoWriter
from mjrec.frames import Frame

BITS = 8


def numbered(number: int, *, height: int = 16, width: int = 128) -> Frame:
    """Return a picture that shows its number, as black and white bars."""
    bits = [255 * (number >> bit & 1) for bit in range(BITS)]
    row = np.repeat(np.array(bits, np.uint8), width // BITS)
    return np.broadcast_to(row[None, :, None], (height, len(row), 3)).copy()


def number_of(frame: Frame) -> int:
    middles = frame[frame.shape[0] // 2, frame.shape[1] // BITS // 2 :, 0]
    bars = middles[:: frame.shape[1] // BITS] > 127
    return sum(1 << bit for bit, is_set in enumerate(bars) if is_set)


def scene(number: int, *, height: int = 96, width: int = 128) -> Frame:
    """Return a picture with gradients, an edge and noise, which moves."""
    y, x = np.mgrid[0:height, 0:width]
    planes = [2 * x + 3 * number, 2 * y + number, x + y + 5 * number]
    picture = np.stack(planes, axis=-1) % 256
    picture[10:30, 5 * number % width :] = (200, 30, 60)
    noise = np.random.default_rng(number).integers(0, 40, picture.shape)
    return np.clip(picture + noise - 20, 0, 255).astype(np.uint8)


def smooth(number: int, *, height: int = 96, width: int = 128) -> Frame:
    """Return a picture without hard edges, of which 4:2:0 loses little."""
    y, x = np.mgrid[0:height, 0:width]
    planes = [x + number, y + 40, (x + y) // 2]
    return np.stack(planes, axis=-1).astype(np.uint8)


def record(path: Path, frames: Any, **options: Any) -> VideoFile:
    with VideoWriter(path, **{"fps": 40, **options}) as video:
        for frame in frames:
            video.write(frame)
    assert video.result is not None
    return video.result


def read(path: Path, pixel_format: str = "rgb24") -> list[Frame]:
    with av.open(str(path)) as container:
        frames = container.decode(video=0)
        return [frame.to_ndarray(format=pixel_format) for frame in frames]


@pytest.fixture
def no_process_stays() -> Iterator[None]:
    """Fail if a child process is left, be it as a zombie."""
    before = children()
    yield
    assert children() <= before


def ffmpeg_under(
    monkeypatch: pytest.MonkeyPatch, directory: Path, prelude: str
) -> None:
    """Let mjrec run ffmpeg through a shell script that begins with `prelude`."""
    wrapper = directory / "ffmpeg"
    wrapper.write_text(f'#!/bin/bash\n{prelude}\nexec {ffmpeg_executable()} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(wrapper))


@pytest.mark.parametrize(
    ("fps", "count"),
    [
        *[(fps, 101) for fps in (20, 30, 40, 50, 125, 29.97, 0.5, 2000)],
        *[(fps, 101) for fps in (Fraction(1000000, 33333), Fraction(2003, 999983))],
        # Left alone, ffmpeg takes some rates of few frames for usual ones: 125 for 120.
        *[(fps, n) for fps in (125, 241, Fraction(1000, 7)) for n in (1, 3, 9)],
    ],
)
def test_every_frame_is_there_once_in_order_at_the_exact_rate(
    tmp_path: Path, fps: Any, count: int
) -> None:
    """The numbers drawn into the frames are read back, with the times of each."""
    result = record(tmp_path / "a.mp4", map(numbered, range(count)), fps=fps)
    assert [number_of(frame) for frame in read(result.path)] == list(range(count))
    assert result.frame_count == count
    rate = Fraction(str(fps))
    with av.open(str(result.path)) as container:
        stream = container.streams.video[0]
        packets = [p for p in container.demux(stream) if p.pts is not None]
    shown = sorted((p.pts * p.time_base, p.duration * p.time_base) for p in packets)
    assert shown == [(n / rate, 1 / rate) for n in range(count)]


def test_a_rate_that_ffmpeg_would_round_is_not_given_to_it(tmp_path: Path) -> None:
    """The result's rate is the file's: near for a float, an error for a fraction."""
    result = record(tmp_path / "a.mp4", map(numbered, range(9)), fps=59.940059)
    with av.open(str(result.path)) as container:
        assert container.streams.video[0].average_rate == result.fps
    assert result.fps == pytest.approx(59.940059, rel=1e-6)
    with pytest.raises(InvalidArgument, match="59940059/1000000 cannot be written"):
        VideoWriter(tmp_path / "b.mp4", fps=Fraction(59940059, 1000000))


def test_the_default_plays_everywhere(tmp_path: Path) -> None:
    """H.264 High, yuv420p, bt709, limited range, no sound, index before the data."""
    result = record(tmp_path / "a.mp4", map(scene, range(5)))
    with av.open(str(result.path)) as container:
        assert len(container.streams) == 1
        codec = container.streams.video[0].codec_context
        assert (codec.name, codec.profile) == ("h264", "High")
        assert codec.pix_fmt == "yuv420p"
        bt709, limited = 1, 1
        assert codec.color_primaries == codec.color_trc == codec.colorspace == bt709
        assert codec.color_range == limited
    assert (result.codec, result.pixel_format) == ("libx264", "yuv420p")
    data = result.path.read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


def test_colours_are_converted_as_they_are_tagged(tmp_path: Path) -> None:
    """Red, green, blue and white have the samples that bt709 gives them."""
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]])
    bars = np.repeat(colours.astype(np.uint8), 32, axis=0)
    frame = np.broadcast_to(bars, (64, 128, 3))
    result = record(tmp_path / "a.mp4", [frame] * 3, crf=1)
    planes = read(result.path, "yuv420p")[1]
    luma = planes[32, 16:128:32].astype(float)
    weights = np.array([0.2126, 0.7152, 0.0722])
    # 16 to 235 is the limited range.
    np.testing.assert_allclose(luma, 16 + 219 * colours @ weights / 255, atol=1.5)
    blue = planes[64:80].reshape(-1)[: 32 * 64].reshape(32, 64)[16, 8:64:16]
    difference = (colours[:, 2] - colours @ weights) / 255 / 1.8556
    np.testing.assert_allclose(blue, 128 + 224 * difference, atol=1.5)


def test_pictures_look_like_the_originals(tmp_path: Path) -> None:
    """Decoded with bt709 by another reader, the RMS error is below three levels."""
    originals = [smooth(number) for number in range(20)]
    result = record(tmp_path / "a.mp4", originals)
    with av.open(str(result.path)) as container:
        decoded = [
            frame.to_ndarray(
                format="rgb24", src_colorspace="ITU709", dst_colorspace="ITU709"
            )
            for frame in container.decode(video=0)
        ]
    error = np.array(decoded, float) - np.array(originals, float)
    assert np.sqrt(np.mean(error**2)) < 3
    assert np.all(np.abs(error.mean(axis=(0, 1, 2))) < 1.5)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 2), (63, 97), (97, 64)])
def test_an_odd_size_is_padded_by_one_pixel(
    tmp_path: Path, height: int, width: int
) -> None:
    """Nothing is rescaled: the edge is doubled, the rest stays where it is."""
    frame = smooth(0, height=height, width=width)
    result = record(tmp_path / "a.mp4", [frame] * 2, crf=1)
    (shown, _) = read(result.path)
    assert (result.height, result.width) == (height, width)
    padded = (height + height % 2, width + width % 2)
    assert shown.shape[:2] == padded == (result.padded_height, result.padded_width)
    # PyAV converts with bt601 unless told otherwise: grey is grey in both.
    grey = np.repeat(frame[..., :1], 3, axis=2)
    (shown, _) = read(record(tmp_path / "b.mp4", [grey] * 2, crf=1).path)
    inside = shown[:height, :width].astype(int)
    assert np.abs(inside - grey).max() <= 6


def test_the_result_tells_what_was_written(tmp_path: Path) -> None:
    """Hashes are those of the file and of its decoded planes; the rest is as used."""
    result = record(tmp_path / "a.mp4", map(scene, range(7)), fps=29.97)
    assert result.file_sha256 == hashlib.sha256(result.path.read_bytes()).hexdigest()
    planes = b"".join(frame.tobytes() for frame in read(result.path, "yuv420p"))
    assert result.decoded_sha256 == hashlib.sha256(planes).hexdigest()
    assert result.fps == Fraction(2997, 100)
    assert result.encoder["arguments"][-1] == "a.mp4"
    assert str(tmp_path) not in " ".join(result.encoder["arguments"])
    assert result.encoder["ffmpeg"] == Path(ffmpeg_executable()).name
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.fps = Fraction(1)  # type: ignore[misc]  # that is the test


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the file that the default settings give for twenty scenes."""
    path = tmp_path_factory.mktemp("plain") / "a.mp4"
    return record(path, map(scene, range(20))).path.read_bytes()


@pytest.mark.parametrize(
    "arguments",
    [
        ("-x264-params", "cpu-independent=1:asm=0"),
        ("-x264-params", "cpu-independent=1:asm=sse2"),
        ("-cpuflags", "0"),
        ("-cpuflags", "sse2"),
        ("-cpuflags", "0", "-x264-params", "cpu-independent=1:asm=0"),
        ("-filter_threads", "1"),
    ],
)
def test_the_file_does_not_depend_on_the_cpu(
    tmp_path: Path, plain: bytes, arguments: tuple[str, ...]
) -> None:
    """Without SIMD, in x264 or in ffmpeg's own code, the same bytes come out."""
    result = record(
        tmp_path / "a.mp4", map(scene, range(20)), encoder_arguments=arguments
    )
    assert result.path.read_bytes() == plain


CHILD = """
import os, sys
sys.path.insert(0, {tests!r})
from test_video_writer import *
"""


def run_child(code: str, **options: Any) -> subprocess.CompletedProcess[str]:
    text = CHILD.format(tests=str(Path(__file__).parent)) + code
    return subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, **options
    )


def test_the_file_does_not_depend_on_the_number_of_cores(
    tmp_path: Path, plain: bytes
) -> None:
    """A process that may use one core only writes the same bytes."""
    code = (
        "os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "record(Path('a.mp4'), map(scene, range(20)))"
    )
    run_child(code, check=True, cwd=tmp_path)
    assert (tmp_path / "a.mp4").read_bytes() == plain


def test_the_callers_buffer_may_be_reused(tmp_path: Path) -> None:
    """A frame is copied when it is handed over, views in any order too."""
    buffer = numbered(0)
    with VideoWriter(tmp_path / "a.mp4", fps=40) as video:
        for number in range(64):
            buffer[:] = numbered(number)
            video.write(buffer[:, ::-1])
    shown = [number_of(frame[:, ::-1]) for frame in read(tmp_path / "a.mp4")]
    assert shown == list(range(64))


def test_a_file_has_its_name_at_the_end(tmp_path: Path) -> None:
    """An older one stays until then, or if the new one is given up."""
    path = tmp_path / "a.mp4"
    with VideoWriter(path, fps=40, frame_hashes=True) as video:
        video.write(numbered(0))
        assert not path.exists()
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.framehash", "a.mp4"]
    old = path.read_bytes()
    given_up = VideoWriter(path, fps=40)
    given_up.write(numbered(0))
    given_up.abort()
    assert path.read_bytes() == old
    assert record(path, map(numbered, range(5))).frame_count == len(read(path)) == 5
    # The old video's hashes went with it.
    assert [one.name for one in tmp_path.iterdir()] == ["a.mp4"]


def test_without_frames_there_is_no_file(tmp_path: Path) -> None:
    """Nothing written: no file, no error."""
    with VideoWriter(tmp_path / "a.mp4", fps=40, frame_hashes=True) as video:
        pass
    assert (video.result, video.frame_count) == (None, 0)
    assert list(tmp_path.iterdir()) == []


def test_an_exception_inside_with_keeps_the_frames_so_far(tmp_path: Path) -> None:
    """The caller's exception goes through and the file is playable."""

    def fail(video: VideoWriter) -> None:
        with video:
            for number in range(9):
                video.write(numbered(number))
            raise KeyboardInterrupt

    video = VideoWriter(tmp_path / "a.mp4", fps=40)
    with pytest.raises(KeyboardInterrupt):
        fail(video)
    assert [number_of(frame) for frame in read(video.path)] == list(range(9))
    assert video.result is not None


@pytest.mark.usefixtures("no_process_stays")
def test_abort_leaves_nothing(tmp_path: Path) -> None:
    """Neither file nor process nor result; a later close does nothing."""
    video = VideoWriter(tmp_path / "a.mp4", fps=40, frame_hashes=True)
    for number in range(100):
        video.write(scene(number))
    video.abort()
    video.abort()
    video.close()
    assert video.result is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("no_process_stays")
def test_closing_twice_is_harmless_and_writing_afterwards_an_error(
    tmp_path: Path,
) -> None:
    """The second close changes nothing; write says which video is closed."""
    video = VideoWriter(tmp_path / "a.mp4", fps=40)
    video.write(numbered(1))
    video.close()
    result = video.result
    video.close()
    assert video.result is result
    with pytest.raises(ClosedError, match=r"a\.mp4 is closed after 1 frames"):
        video.write(numbered(2))


@pytest.mark.parametrize(
    "frame",
    [
        None,
        np.zeros((16, 128), np.uint8),
        np.zeros((16, 128, 4), np.uint8),
        np.zeros((16, 128, 3), np.float32),
        np.zeros((18, 128, 3), np.uint8),
    ],
)
def test_a_bad_frame_is_refused_and_the_rest_kept(tmp_path: Path, frame: Any) -> None:
    """The error comes at once, and the writer takes the next good frame."""
    with VideoWriter(tmp_path / "a.mp4", fps=40) as video:
        video.write(numbered(1))
        with pytest.raises(InvalidFrame):
            video.write(frame)
        video.write(numbered(2))
    assert [number_of(shown) for shown in read(video.path)] == [1, 2]


def test_memory_does_not_grow_with_the_video(tmp_path: Path) -> None:
    """Two thousand frames of 48 KiB, made faster than encoded, need a few MiB."""
    frame = scene(0, height=128, width=128)
    with VideoWriter(tmp_path / "a.mp4", fps=40) as video:
        tracemalloc.start()
        try:
            for number in range(2000):
                frame[number % 128] = number % 251
                video.write(frame)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert len(frame.tobytes()) * 2000 > 90 << 20
    assert peak < 10 << 20


@pytest.mark.usefixtures("no_process_stays")
@pytest.mark.parametrize("more", [0, 5000])
def test_a_killed_encoder_is_one_error(tmp_path: Path, more: int) -> None:
    """Of `write`, or of `close` where all was written. Nothing is left."""
    before = children()
    video = VideoWriter(tmp_path / "a.mp4", fps=40, frame_hashes=True)
    video.write(scene(0))
    (encoder,) = children() - before
    os.kill(encoder, signal.SIGKILL)

    def write_on() -> None:
        with video:
            for number in range(more):
                video.write(scene(number % 7))

    with pytest.raises(EncoderError, match="could not be encoded") as caught:
        write_on()
    assert caught.value.returncode == -signal.SIGKILL
    assert "libx264" in caught.value.command
    assert not hasattr(caught.value, "__notes__")
    video.close()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ClosedError):
        video.write(scene(0))


@pytest.mark.usefixtures("no_process_stays")
@pytest.mark.parametrize("prelude", ["ulimit -f 20", "trap '' XFSZ; ulimit -f 20"])
def test_a_full_disk_is_one_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prelude: str
) -> None:
    """An encoder that may write 20 KiB only: an error, and the space is free again."""
    tools, out = tmp_path / "tools", tmp_path / "out"
    tools.mkdir()
    out.mkdir()
    ffmpeg_under(monkeypatch, tools, prelude)
    video = VideoWriter(out / "a.mp4", fps=40, crf=5)

    def fill() -> None:
        with video:
            for number in range(60):
                video.write(scene(number))

    with pytest.raises(EncoderError) as caught:
        fill()
    assert caught.value.returncode != 0
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "left"),
    [
        (("-vf", r"select=not(eq(n\,3)),format=yuv420p"), 99),
        (("-vf", r"select=lt(n\,99),format=yuv420p"), 99),
        (("-vf", r"select=not(eq(mod(n\,10)\,5)),setpts=N,format=yuv420p"), "(89|90)"),
        (("-r", "80", every_frame_arguments()[0], "cfr"), r"(199|200)"),
    ],
    ids=["one lost", "last lost", "some lost, the rest moved up", "doubled"],
)
@pytest.mark.usefixtures("no_process_stays")
def test_a_file_with_other_frames_is_not_kept(
    tmp_path: Path, arguments: tuple[str, ...], left: int | str
) -> None:
    """A frame lost or doubled by the encoder is found in the finished file."""
    video = VideoWriter(tmp_path / "a.mp4", fps=40, encoder_arguments=arguments)
    for number in range(100):
        video.write(numbered(number))
    message = f"to hold 100 frames, and decoding gives {left}"
    with pytest.raises(FrameCountError, match=message):
        video.close()
    assert video.result is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("codec", ["ffv1", "libx264rgb", "utvideo"])
def test_lossless_codecs_keep_every_pixel(tmp_path: Path, codec: str) -> None:
    """An mkv with a lossless codec gives back the very frames, odd sizes too."""
    originals = [scene(number, height=31, width=47) for number in range(6)]
    result = record(tmp_path / "a.mkv", originals, codec=codec)
    shown = [frame[:31, :47] for frame in read(result.path)]
    np.testing.assert_array_equal(shown, originals)
    assert result.codec == codec


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *(("a.mp4", {"codec": "mpeg4"}), ("a.avi", {"codec": "mpeg4"})),
        # Lossless x264 is no profile High.
        *(("a.mov", {}), ("a.mkv", {}), ("a.mp4", {"crf": 0})),
        *((name, {}) for name in ("http:a b.mp4", "-y.mp4", "%03d.mp4", "ü|'\".mp4")),
    ],
)
def test_other_codecs_files_and_names_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, options: dict[str, Any]
) -> None:
    """What ffmpeg can encode; what a name holds means nothing to it."""
    monkeypatch.chdir(tmp_path)
    result = record(Path(name), map(numbered, range(30)), **options)
    assert result.path == tmp_path / name
    assert [number_of(frame) for frame in read(result.path)] == list(range(30))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 0}, "fps"),
        ({"fps": float("nan")}, "fps"),
        ({"fps": True}, "fps"),
        ({"crf": -1}, "crf"),
        ({"crf": 52}, "crf"),
        ({"crf": float("nan")}, "crf"),
        ({"crf": True}, "crf"),
        ({"crf": "18"}, "crf"),
        ({"codec": "mpeg4", "crf": 18}, "knows no crf"),
        ({"codec": 5}, "codec"),
        ({"codec": "gif"}, "gif"),
        ({"encoder_arguments": "-g 1"}, "encoder_arguments"),
    ],
)
def test_arguments_are_checked_first(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    """Each wrong value is an error at construction that names it; no file is made."""
    with pytest.raises(InvalidArgument, match=message):
        VideoWriter(tmp_path / "a.mp4", **{"fps": 40, **options})
    assert list(tmp_path.iterdir()) == []


def test_the_path_is_checked_first(tmp_path: Path) -> None:
    """Unknown endings, directories, missing and locked directories are refused."""
    (tmp_path / "dir.mp4").mkdir()
    for path in (tmp_path / "a.gif", tmp_path / "a", tmp_path / "dir.mp4", 5):
        with pytest.raises(InvalidArgument, match=r"name|directory"):
            VideoWriter(path, fps=40)  # type: ignore[arg-type]  # 5 is the test
    for path in (tmp_path / "missing" / "a.mp4", Path("/proc/a.mp4")):
        with pytest.raises(DirectoryNotWritable, match=str(path.parent)):
            VideoWriter(path, fps=40)


def test_what_ffmpeg_cannot_do_fails_before_any_frame(tmp_path: Path) -> None:
    """A codec that is not there or does not go into the file, a wrong argument."""
    with pytest.raises(UnknownName, match="libx265x") as caught:
        VideoWriter(tmp_path / "a.mp4", fps=40, codec="libx265x")
    assert "libx264" in caught.value.available
    with pytest.raises(EncoderError, match="libx264 into a webm file"):
        VideoWriter(tmp_path / "a.webm", fps=40)
    with pytest.raises(EncoderError, match="nonsense"):
        VideoWriter(tmp_path / "a.mp4", fps=40, encoder_arguments=("-nonsense", "1"))


def test_frame_hashes_are_of_the_frames_as_given(tmp_path: Path) -> None:
    """For an odd size the file equals ffmpeg's framehash of the unpadded frames."""
    originals = [scene(number, height=31, width=47) for number in range(6)]
    result = record(tmp_path / "a.mp4", originals, fps=29.97, frame_hashes=True)
    assert result.frame_hash_path == tmp_path / "a.framehash"
    arguments = (
        "-v error -f rawvideo -pix_fmt rgb24 -s 47x31 -r 2997/100 -i - "
        "-fflags +bitexact -f framehash -"
    )
    raw = b"".join(frame.tobytes() for frame in originals)
    theirs = run_ffmpeg(arguments.split(), standard_input=raw)
    assert result.frame_hash_path.read_bytes() == theirs


# Shell, before the real ffmpeg runs. The encoder is known by its output's name.
ENCODES = '[[ "${@: -1}" == *.part ]]'
DECODES = '[[ "$*" == *" -xerror "* ]]'
HELD = {
    "the thread feeds": f"if {ENCODES}; then read -r < GATE; fi",
    "ffmpeg encodes": f'if {ENCODES}; then REAL "$@"; read -r < GATE; exit; fi',
    "the file is decoded": f"if {DECODES}; then touch HELD; read -r < GATE; fi",
}


@pytest.mark.usefixtures("default_signals")
@pytest.mark.usefixtures("no_process_stays")
@pytest.mark.parametrize("end", ["close", "abort"])
@pytest.mark.parametrize("held", HELD)
def test_an_interrupted_close_can_be_called_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held: str, end: str
) -> None:
    """Ctrl-C while close waits; then it finishes, or abort leaves nothing."""
    out, gate, is_held = tmp_path / "out", tmp_path / "gate", tmp_path / "held"
    out.mkdir()
    os.mkfifo(gate)
    prelude = HELD[held].replace("GATE", str(gate)).replace("HELD", str(is_held))
    ffmpeg_under(monkeypatch, tmp_path, prelude.replace("REAL", ffmpeg_executable()))
    # Open at both ends, so that what is written stays until it is read.
    opened = os.open(gate, os.O_RDWR)
    video = VideoWriter(out / "a.mp4", fps=40, frame_hashes=True)
    try:
        # More than the pipe holds.
        for number in range(60):
            video.write(numbered(number, height=120, width=160))
        is_soon = "decoded" not in held
        ctrl_c = ctrl_c_soon() if is_soon else ctrl_c_once_there_is(is_held)
        with ctrl_c, pytest.raises(KeyboardInterrupt):
            video.close()
        assert not video.closed
        assert not video.path.exists()
        with pytest.raises(ClosedError, match="closed after 60 frames"):
            video.write(numbered(1, height=120, width=160))
        if end == "close":
            os.write(opened, b"go\n" * 9)
        getattr(video, end)()
    finally:
        os.close(opened)
    assert video.closed
    if end == "abort":
        assert list(out.iterdir()) == []
        return
    assert video.result is not None
    assert video.result.frame_count == 60
    assert [number_of(frame) for frame in read(video.path)] == list(range(60))
    assert sorted(one.name for one in out.iterdir()) == ["a.framehash", "a.mp4"]


@pytest.mark.usefixtures("no_process_stays")
def test_what_fails_before_the_first_frame_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the encoder nor the file of hashes outlives a thread that fails."""

    def fail(thread: threading.Thread) -> None:
        raise MemoryError

    video = VideoWriter(tmp_path / "a.mp4", fps=40, frame_hashes=True)
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", fail)
        with pytest.raises(MemoryError):
            video.write(numbered(1))
    assert video.closed
    assert list(tmp_path.iterdir()) == []


def test_a_video_is_written_in_an_exit_hook(tmp_path: Path) -> None:
    """Also on a Python that starts no thread there."""
    code = (
        "import atexit\n"
        "atexit.register(record, Path('a.mp4'), map(numbered, range(20)))\n"
        "def refuse(thread): raise RuntimeError('interpreter shutdown')\n"
        "atexit.register(setattr, threading.Thread, 'start', refuse)\n"
    )
    child = run_child(code, cwd=tmp_path)
    assert (child.returncode, child.stderr) == (0, "")
    shown = [number_of(frame) for frame in read(tmp_path / "a.mp4")]
    assert shown == list(range(20))


@pytest.mark.usefixtures("no_process_stays")
def test_close_on_the_encoders_thread_leaves_the_rest_to_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when a garbage collection there ends the writer's owner."""
    write, closes = FfmpegProcess.write, threading.Event()

    def write_and_close(process: FfmpegProcess, data: Any) -> None:
        write(process, data)
        video.close()
        closes.set()

    video = VideoWriter(tmp_path / "a.mp4", fps=40)
    monkeypatch.setattr(FfmpegProcess, "write", write_and_close)
    video.write(numbered(1))
    assert closes.wait(30)
    assert not video.closed
    video.close()
    assert [number_of(frame) for frame in read(video.path)] == [1]


def wait_for_end(pid: int) -> None:
    """Wait until a process that is no child of ours has ended."""
    try:
        handle = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        assert select.select([handle], [], [], 60)[0], "the encoder runs on"
    finally:
        os.close(handle)


def test_a_killed_parent_leaves_a_playable_temporary_file(tmp_path: Path) -> None:
    """After SIGKILL the encoder finishes what it was given, by itself."""
    code = (
        "before = children()\n"
        "video = VideoWriter('a.mp4', fps=40)\n"
        "for number in range(100):\n"
        "    video.write(scene(number, height=240, width=320))\n"
        "print(*(children() - before), flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    child = run_child(code, cwd=tmp_path)
    assert child.returncode == -signal.SIGKILL, child.stderr
    wait_for_end(int(child.stdout))
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".a.mp4.")
    assert 30 < len(read(left)) <= 100


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_in_the_terminal_does_not_end_the_encoder(tmp_path: Path) -> None:
    """SIGINT to the whole process group: the frames so far become the video."""
    code = (
        "with VideoWriter('a.mp4', fps=40) as video:\n"
        "    for number in range(50):\n"
        "        video.write(numbered(number))\n"
        "    print('written', flush=True)\n"
        "    signal.pause()\n"
    )
    text = CHILD.format(tests=str(Path(__file__).parent)) + code
    with subprocess.Popen(
        [sys.executable, "-c", text],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=tmp_path,
        start_new_session=True,
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"written\n"
        os.killpg(child.pid, signal.SIGINT)
        _, errors = child.communicate(timeout=60)
    assert b"KeyboardInterrupt" in errors
    assert [number_of(frame) for frame in read(tmp_path / "a.mp4")] == list(range(50))


def test_a_forgotten_writer_warns_and_loses_no_frame(tmp_path: Path) -> None:
    """Dropped without close: a ResourceWarning, and the frames are in a file."""
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
        "    wait_for_end(encoder)\n"
    )
    run_child(code, check=True, cwd=tmp_path)
    (left,) = tmp_path.iterdir()
    assert [number_of(frame) for frame in read(left)] == list(range(50))


def test_a_forked_child_cannot_touch_the_parents_video(tmp_path: Path) -> None:
    """The child that leaves the with statement neither finishes nor removes it."""
    code = (
        "with VideoWriter('a.mp4', fps=40) as video:\n"
        # More than queue and pipe hold: the encoder's temporary file is there.
        "    for number in range(120):\n"
        "        video.write(numbered(number, height=240, width=320))\n"
        "    child = os.fork()\n"
        "    if child == 0:\n"
        "        try:\n"
        "            video.write(numbered(7, height=240, width=320))\n"
        "        except ClosedError:\n"
        "            sys.exit(5)\n"
        "    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 5\n"
        "    video.write(numbered(120, height=240, width=320))\n"
    )
    child = run_child(code, cwd=tmp_path)
    assert child.returncode == 0, child.stderr
    shown = [number_of(frame) for frame in read(tmp_path / "a.mp4")]
    assert shown == list(range(121))
