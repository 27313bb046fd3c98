# SPDX-License-Identifier: Apache-2.0
"""Finding and running ffmpeg."""

import hashlib
import os
import time
from pathlib import Path

import pytest

from mjrec.errors import EncoderError, InvalidArgument, MissingDependency
from mjrec.formats import ffmpeg
from mjrec.formats.ffmpeg import (
    FfmpegProcess,
    every_frame_arguments,
    ffmpeg_executable,
    ffmpeg_sha256,
    ffmpeg_version,
    remembered,
    run_ffmpeg,
    video_encoders,
)


def script(path, text):
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def test_the_binary_is_named_and_hashed():
    """Version line and sha256 are those of the program that is run."""
    path = ffmpeg_executable()
    assert os.access(path, os.X_OK)
    assert ffmpeg_version().startswith("ffmpeg version ")
    assert ffmpeg_sha256() == hashlib.sha256(Path(path).read_bytes()).hexdigest()
    assert {"libx264", "ffv1"} <= set(video_encoders())


@pytest.mark.parametrize(
    ("libavutil", "option"), [("56. 70.100", "-vsync"), ("61.  1.102", "-fps_mode")]
)
def test_an_old_ffmpeg_is_asked_in_its_own_words(
    libavutil, option, tmp_path, monkeypatch
):
    """5.1 renamed the option that lets each frame pass, and 9 took the old one away."""
    text = f"printf 'ffmpeg version x\\nlibavutil      {libavutil} / {libavutil}\\n'"
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(script(tmp_path / "other", text)))
    assert every_frame_arguments() == (option, "passthrough")


@pytest.mark.parametrize("is_named", [True, False])
def test_a_program_that_cannot_be_started_is_told_from_one_that_failed(
    tmp_path, monkeypatch, is_named
):
    """A file that is executable and no program: the reason, and how to get another."""
    broken = script(tmp_path / "broken", "")
    broken.write_bytes(b"\0\0\0\0")
    error = MissingDependency
    reason = r"ffmpeg, but .*broken cannot be started: Exec format error\. Run: pip"
    if is_named:
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(broken))
        error = InvalidArgument
        reason = r"IMAGEIO_FFMPEG_EXE is '.*broken', .* Exec format error\. Unset it"
    else:
        monkeypatch.delenv("IMAGEIO_FFMPEG_EXE", raising=False)
        monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: str(broken))
    with pytest.raises(error, match=reason):
        run_ffmpeg(["-version"])


@pytest.fixture
def impatient(monkeypatch):
    """Let what makes no progress hang after a moment."""
    monkeypatch.setenv("MJREC_TIMEOUT", "0.3")


def hang_at(tmp_path, monkeypatch, text):
    # Not replaced by what it starts: a wrapper script, that has to go with it.
    program = script(tmp_path / "wrapper", f"echo begun >&2; {text}; exit 0")
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("way", ["write", "read", "wait"])
def test_a_process_that_hangs_is_ended(way, tmp_path, monkeypatch):
    """Whether it takes nothing, gives nothing or does not end."""
    hang_at(tmp_path, monkeypatch, "sleep 33.75")
    process = FfmpegProcess(["-"], what="No.", reads=way == "write", writes=True)
    try:
        with pytest.raises(EncoderError, match=r"No\. It made no progress for 0.3"):
            {
                "write": lambda: process.write(bytes(3 << 20)),
                "read": lambda: process.read(1),
                "wait": process.wait,
            }[way]()
    finally:
        process.kill()
        process.release()
    assert not still_runs("sleep", "33.75")


@pytest.mark.usefixtures("impatient")
def test_a_slow_process_does_not_hang(tmp_path, monkeypatch):
    """As long as something moves: what it takes, gives, or writes into its file."""
    out = tmp_path / "out"
    hang_at(
        tmp_path,
        monkeypatch,
        "for k in 1 2 3 4 5; do head -c 65536 >/dev/null; echo $k; sleep 0.1; done; "
        f"exec >&-; for k in 1 2 3 4 5; do echo $k >>{out}; sleep 0.1; done",
    )
    process = FfmpegProcess([f"file:{out}"], what="No.", reads=True, writes=True)
    process.write(bytes(1 << 20 | 3 << 16))
    assert b"".join(iter(lambda: process.read(9), b"")) == b"1\n2\n3\n4\n5\n"
    process.wait()
    process.release()


def still_runs(*command):
    """Return whether it does so for another ten seconds, on a busy machine."""
    wanted = "\0".join([*command, ""]).encode()
    end = time.monotonic() + 10
    while time.monotonic() < end:
        lines = map(read_or_nothing, Path("/proc").glob("[0-9]*/cmdline"))
        if wanted not in lines:
            return False
        time.sleep(0.05)
    return True


def read_or_nothing(path):
    try:
        return path.read_bytes()
    except OSError:
        return b""


# What is remembered of a program, and of which


@pytest.fixture
def program(tmp_path):
    path = tmp_path / "program"
    path.write_text("one")
    return path


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "mjrec" / "programs.json"


def ask(program, asked, answer="yes"):
    """Ask as a new process does, and note where the program had to be asked."""
    ffmpeg._answers.clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ffmpeg, "ffmpeg_executable", lambda: str(program))
        return remembered("does it work?", lambda: asked.append("") or answer)


def test_a_program_is_asked_once(program, cache):
    """Another process need not ask, until the file is another one."""
    asked = []
    assert [ask(program, asked), ask(program, asked)] == ["yes", "yes"]
    assert len(asked) == 1
    # Of the same size and time of change.
    before = program.stat()
    program.write_text("two")
    os.utime(program, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert ask(program, asked, "no") == "no"
    assert len(asked) == 2


@pytest.mark.parametrize("what", ["garbage", "no place"])
def test_what_cannot_be_read_is_asked_anew(what, program, cache):
    """Whatever stands in its place."""
    asked = []
    if what == "no place":
        cache.parents[1].write_text("a file")
    else:
        ask(program, asked)
        cache.write_text("[1]")
    assert ask(program, asked, "no") == "no"
