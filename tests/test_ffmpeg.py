# SPDX-License-Identifier: Apache-2.0
"""Test finding and running ffmpeg."""

import hashlib
import os
import shutil
from pathlib import Path

import pytest
from waiting import wait_until

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


def test_binary_has_path_version_hash_and_encoders():
    path = ffmpeg_executable()
    assert os.access(path, os.X_OK)
    assert ffmpeg_version().startswith("ffmpeg version ")
    assert ffmpeg_sha256() == hashlib.sha256(Path(path).read_bytes()).hexdigest()
    assert {"libx264", "ffv1"} <= set(video_encoders())


@pytest.mark.parametrize(
    ("libavutil", "option"), [("56. 70.100", "-vsync"), ("61.  1.102", "-fps_mode")]
)
def test_frame_option_depends_on_the_version(libavutil, option, tmp_path, monkeypatch):
    """The option was renamed in ffmpeg 5.1, and ffmpeg 9 removed the old name."""
    text = f"printf 'ffmpeg version x\\nlibavutil      {libavutil} / {libavutil}\\n'"
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(script(tmp_path / "other", text)))
    assert every_frame_arguments() == (option, "passthrough")


@pytest.mark.parametrize("is_named", [True, False])
def test_unstartable_program_is_an_error_with_the_fix(tmp_path, monkeypatch, is_named):
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
def hang_at(tmp_path, monkeypatch):
    """Replace ffmpeg with a shell script, and shorten the timeout to 0.3 s."""
    monkeypatch.setenv("MJREC_TIMEOUT", "0.3")

    def run(text):
        # The final `exit` keeps the shell as a parent process, like a wrapper script.
        program = script(tmp_path / "wrapper", f"echo begun >&2; {text}; exit 0")
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))

    return run


@pytest.mark.parametrize(
    "wait",
    [lambda p: p.write(bytes(3 << 20)), lambda p: p.read(1), FfmpegProcess.wait],
    ids=["write", "read", "wait"],
)
def test_hanging_process_is_killed_with_its_children(wait, hang_at):
    hang_at("sleep 33.75")
    process = FfmpegProcess(["-"], what="No.", reads=True, writes=True)
    try:
        with pytest.raises(EncoderError, match=r"No\. It made no progress for 0.3"):
            wait(process)
    finally:
        process.kill()
        process.release()
    wait_until(lambda: b"sleep\00033.75\0" not in map(cmdline, Path("/proc").iterdir()))


def cmdline(process):
    try:
        return (process / "cmdline").read_bytes()
    except OSError:
        return b""


def test_slow_process_is_not_killed(tmp_path, hang_at):
    """Reading input, printing and writing to the file all count as progress."""
    out = tmp_path / "out"
    hang_at(
        "for k in 1 2 3 4 5; do head -c 65536 >/dev/null; echo $k; sleep 0.1; done; "
        f"exec >&-; for k in 1 2 3 4 5; do echo $k >>{out}; sleep 0.1; done"
    )
    process = FfmpegProcess([f"file:{out}"], what="No.", reads=True, writes=True)
    process.write(bytes(1 << 20 | 3 << 16))
    assert b"".join(iter(lambda: process.read(9), b"")) == b"1\n2\n3\n4\n5\n"
    process.wait()
    process.release()


def test_answers_are_remembered_until_the_program_changes(tmp_path, monkeypatch):
    program, cache = tmp_path / "program", tmp_path / "cache"
    program.write_text("one")
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setattr(ffmpeg, "ffmpeg_executable", lambda: str(program))

    def ask(answer):
        """Ask with an empty cache, like a new process."""
        ffmpeg._answers.clear()
        return remembered("does it work?", lambda: answer)

    assert [ask("yes"), ask("no")] == ["yes", "yes"]
    # The new program has the same size and modification time.
    before = program.stat()
    program.write_text("two")
    os.utime(program, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert [ask("no"), ask("yes")] == ["no", "no"]
    [answers] = (cache / "mjrec").iterdir()
    answers.write_text("[1]")
    assert ask("yes") == "yes"
    shutil.rmtree(cache)
    cache.write_text("no directory")
    assert ask("no") == "no"
