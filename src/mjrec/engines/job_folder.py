# SPDX-License-Identifier: Apache-2.0
"""Jobs and their outcomes as files, between machines that share nothing else.

A folder holds one run. Its driver puts jobs there; hosts on any machine take them, do
them, and lay down what came of them::

    work.json                   what is done, as `HostedWork` has it
    payload                     of it, where there is one
    driver.json                 the driver's sign of life, renewed every few seconds
    stop                        once this is there, hosts end
    jobs/<number>.json          a job that waits
    taken/<number>.<host>.json  one that a host does
    done/<number>.<host>.json   what a host has to say of it
    hosts/<host>.<state>        a host; `working`, `leaving` or `ended`
    submitted/<job>             a job of the cluster that has a host
    logs/                       what hosts print

It is made for NFS. A file appears whole or not at all, by a rename; a job is taken by
a rename, which succeeds for one only; nothing is locked and nothing is watched. What a
machine has cached of a folder's entries may be up to a minute old, so whoever looks
asks for the folder's attributes first, in a way that no cache answers. Times of
different machines are never compared.
"""

from __future__ import annotations

import contextlib
import enum
import random
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from ..atomic_files import replacing
from .hosting import HostedWork

_SUFFIX = ".json"
# Whoever writes here lets hosts run code, and the work may hold a key.
_PRIVATE = 0o700


@dataclass(frozen=True, kw_only=True)
class Pace:
    """How often files are looked at, and how long their owners may be silent.

    Attributes:
        poll_s: whoever waits for a file looks for it so often, or more often while
            there is something.
        look_s: the cluster is asked for the state of its jobs so often.
        beat_s: the driver gives a sign of life so often.
        silent_s: a driver that has given none for so long is dead.
        idle_s: a host that finds nothing to do for so long ends.
    """

    poll_s: float = 1.0
    look_s: float = 10.0
    beat_s: float = 10.0
    silent_s: float = 150.0
    idle_s: float = 120.0


class HostState(enum.Enum):
    """What a host says of itself."""

    WORKING = "working"
    LEAVING = "leaving"
    ENDED = "ended"


@dataclass(frozen=True, kw_only=True)
class TakenJob:
    """A job that a host does.

    Attributes:
        number: of the job in its folder.
        host: that does it.
        line: the job, as `job_book.Task` has it.
    """

    number: int
    host: str
    line: bytes = b""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a host has to say of a job.

    Attributes:
        number: of the job in its folder.
        host: that has done it.
        line: JSON.
    """

    number: int
    host: str
    line: bytes


class JobFolder:
    """The folder of a run.

    Args:
        path: where it is.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.logs = path / "logs"
        self._jobs = path / "jobs"
        self._taken = path / "taken"
        self._done = path / "done"
        self._hosts = path / "hosts"
        self._submitted = path / "submitted"
        self._work = path / "work.json"
        self._payload = path / "payload"
        self._sign = path / "driver.json"
        self._stop = path / "stop"

    @classmethod
    def make(cls, path: Path, hosted: HostedWork, payload: bytes | None) -> Self:
        """Return a new folder.

        Raises:
            InvalidArgument: the settings of the work are no JSON.
            OSError: it cannot be made.
        """
        line = hosted.to_json()
        folder = cls(path)
        path.mkdir(mode=_PRIVATE, parents=True)
        for part in ("jobs", "taken", "done", "hosts", "submitted"):
            (path / part).mkdir()
        if payload is not None:
            _write(folder._payload, payload)
        _write(folder._work, line)
        return folder

    # The driver's side

    def put(self, number: int, line: bytes) -> None:
        """Lay down a job."""
        _write(self._jobs / f"{number:06}{_SUFFIX}", line)

    def answers(self) -> Iterator[Answer]:
        """Yield what hosts have to say, and remove it."""
        for path in _entries(self._done):
            with contextlib.suppress(FileNotFoundError):
                answer = Answer(
                    number=_number(path), host=_host(path), line=path.read_bytes()
                )
                path.unlink()
                yield answer

    def taken(self) -> list[TakenJob]:
        """Return the jobs that hosts have taken and said nothing of, without lines."""
        return [
            TakenJob(number=_number(path), host=_host(path))
            for path in _entries(self._taken)
        ]

    def forget(self, job: TakenJob) -> None:
        """Forget that a host has taken a job."""
        self._path_of(job).unlink(missing_ok=True)

    def hosts(self) -> dict[str, HostState]:
        """Return all hosts that there have been, and what they say of themselves."""
        return {
            path.stem: HostState(path.suffix.removeprefix("."))
            for path in _entries(self._hosts)
        }

    def note_submitted(self, jobs: Iterable[str]) -> None:
        """Note which jobs of the cluster are this run's."""
        for job in jobs:
            (self._submitted / job).touch()

    def submitted(self) -> list[str]:
        """Return the jobs of the cluster that are this run's."""
        return [path.name for path in _entries(self._submitted)]

    def give_sign(self, sign: str) -> None:
        """Show that the driver is alive: by a text that is not that of the last time.

        Raises:
            OSError: it cannot be written now.
        """
        _write(self._sign, sign.encode())

    def stop(self) -> None:
        """Tell all hosts to end."""
        with contextlib.suppress(FileNotFoundError):
            self._stop.touch()

    # A host's side

    def work(self) -> HostedWork:
        """Return what is done, without its payload."""
        return HostedWork.from_json(self._work.read_bytes())

    def payload(self) -> bytes | None:
        """Return the payload of the work; None where it has none."""
        try:
            return self._payload.read_bytes()
        except FileNotFoundError:
            return None

    def take(self, host: str) -> TakenJob | None:
        """Take a job, which is nobody else's then; None where none waits.

        Any of them, so that hosts do not all try for the same.
        """
        waiting = _entries(self._jobs)
        random.shuffle(waiting)
        for path in waiting:
            job = TakenJob(number=_number(path), host=host)
            ours = self._path_of(job)
            try:
                path.rename(ours)
            except FileNotFoundError:
                # Another was faster. Or the server's answer was lost, and what was
                # asked once more found nothing to do.
                if not ours.exists():
                    continue
            return TakenJob(number=job.number, host=host, line=ours.read_bytes())
        return None

    def answer(self, job: TakenJob, line: bytes) -> None:
        """Say what came of a job."""
        _write(self._done / self._path_of(job).name, line)
        self.forget(job)

    def note_host(self, host: str, state: HostState) -> None:
        """Say how it is with a host."""
        path = self._hosts / f"{host}.{state.value}"
        for earlier in HostState:
            if earlier is not state:
                with contextlib.suppress(FileNotFoundError):
                    path.with_suffix(f".{earlier.value}").rename(path)
                    return
        path.touch()

    def sign(self) -> bytes:
        """Return the driver's last sign of life."""
        with contextlib.suppress(OSError):
            return self._sign.read_bytes()
        return b""

    @property
    def is_stopped(self) -> bool:
        """Whether hosts are to end; also where the folder is gone."""
        try:
            _look_again(self.path)
        except FileNotFoundError:
            return True
        return self._stop.exists()

    def _path_of(self, job: TakenJob) -> Path:
        return self._taken / f"{job.number:06}.{job.host}{_SUFFIX}"


def _entries(folder: Path) -> list[Path]:
    """Return the files of a folder that are whole, sorted; none if it is gone."""
    try:
        _look_again(folder)
        return sorted(p for p in folder.iterdir() if not p.name.startswith("."))
    except FileNotFoundError:
        return []


def _look_again(folder: Path) -> None:
    """Let this machine look at a folder's entries, and not at what it has cached.

    Over NFS the answer to a change of attributes, be it to what they are, brings those
    of the server: where the folder has changed, cached entries are dropped, and cached
    absences too.
    """
    with contextlib.suppress(PermissionError):
        folder.chmod(folder.stat().st_mode & 0o7777)


def _write(path: Path, data: bytes) -> None:
    # Closed before it is renamed: by then the server has it.
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def _number(path: Path) -> int:
    return int(path.name.partition(".")[0])


def _host(path: Path) -> str:
    return path.name.removesuffix(_SUFFIX).partition(".")[2]
