# SPDX-License-Identifier: Apache-2.0
"""Read hostile files in forked processes.

`Inspector` starts one process, which forks for each file with a gigabyte of memory.
It also reports forks that crash, hang or run out of memory.
"""

import io
import json
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from pathlib import Path
from types import SimpleNamespace

from mjrec import ArchiveError, Error, UnreadableFile, load_trajectory, write_archive
from mjrec.formats.journal import read_journal
from mjrec.formats.json_fields import read_object, unreadable
from mjrec.formats.manifest import read_manifest, read_stats_file
from mjrec.formats.trajectory_file import finish_trajectory
from mjrec.formats.video_metadata import is_broken
from mjrec.rendering.recorded_facts import open_for_rendering
from mjrec.simulation.mjcf import load_mjcf
from mjrec.simulation.model_store import load_model

MEMORY = 1 << 30
SECONDS = 120  # long enough for a busy machine


class Inspector:
    """A process that reads files on request, each in a fork."""

    def __enter__(self):
        environ = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        command = [sys.executable, __file__]
        self._process = subprocess.Popen(command, env=environ, **pipes)
        return self

    def __exit__(self, *_):
        self._process.communicate()

    def read(self, reader, path):
        """Return the outcome of reading `path` with one of `READERS`.

        `kind` is `value`, `refused` (an error of mjrec), `failed` (another error) or
        `died`. Other attributes are the error, the path that it names, and the seconds.
        """
        self._process.stdin.write(f"{json.dumps([reader, str(path)])}\n")
        self._process.stdin.flush()
        outcome = SimpleNamespace(**json.loads(self._process.stdout.readline()))
        if outcome.kind in ("value", "refused"):
            assert outcome.seconds < SECONDS / 2, outcome
        return outcome

    def reads(self, reader, path):
        """Check that `path` can be read quickly."""
        outcome = self.read(reader, path)
        assert outcome.kind == "value", outcome

    def refuses(self, reader, path):
        """Check that reading `path` quickly raises one short error, and return it."""
        outcome = self.read(reader, path)
        assert outcome.kind == "refused", outcome
        assert outcome.path == str(path), outcome
        assert len(outcome.error) < 2000 + len(str(path)), outcome.error[:4000]
        return outcome.error


def _trajectory(path):
    trajectory = load_trajectory(path)
    for values in (*vars(trajectory).values(), trajectory.snapshots):
        str(values)
    with open_for_rendering(path) as reader:
        for _ in reader.iter_model_changes():
            pass


def _finish(path):
    try:
        finish_trajectory(path.with_name("openaigym.trajectory.0.7.episode000000.h5"))
    except UnreadableFile as error:
        raise UnreadableFile(path, error) from error


def _journal(path):
    for _ in read_journal(path):
        pass


def _metadata(path):
    is_broken(path)
    with unreadable(path):
        read_object(path)


def _model(path):
    load_model(path.parent, json.loads((path.parent / "facts.json").read_text()))


def _archive(path):
    try:
        write_archive([(path, path.with_suffix(".meta.json"))], io.BytesIO())
    except ArchiveError as error:
        raise UnreadableFile(path, error) from error


READERS = {
    "manifest": read_manifest,
    "stats": read_stats_file,
    "journal": _journal,
    "metadata": _metadata,
    "trajectory": _trajectory,
    "finish": _finish,
    "model": _model,
    "mjcf": load_mjcf,
    "archive": _archive,
}


def _outcome(reader, path):
    try:
        READERS[reader](path)
    except Error as error:
        named = getattr(error, "path", None)
        return {"kind": "refused", "error": str(error), "path": named and str(named)}
    except BaseException:
        return {"kind": "failed", "error": traceback.format_exc()[-3000:], "path": None}
    return {"kind": "value", "error": "", "path": None}


def _forked(reader, path):
    beginning = time.monotonic()
    incoming, outgoing = os.pipe()
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_RDWR), 1)
        signal.alarm(SECONDS)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        _, most = resource.getrlimit(resource.RLIMIT_AS)
        room = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (room, most))
        os.write(outgoing, json.dumps(_outcome(reader, path)).encode())
        os._exit(0)
    os.close(outgoing)
    with os.fdopen(incoming, "rb") as pipe:
        text = pipe.read()
    _, status = os.waitpid(child, 0)
    died = {"kind": "died", "error": f"status {status}", "path": None}
    outcome = json.loads(text) if text else died
    return {**outcome, "seconds": time.monotonic() - beginning}


if __name__ == "__main__":
    for line in sys.stdin:
        reader, path = json.loads(line)
        sys.stdout.write(f"{json.dumps(_forked(reader, Path(path)))}\n")
        sys.stdout.flush()
