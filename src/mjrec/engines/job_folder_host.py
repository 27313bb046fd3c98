# SPDX-License-Identifier: Apache-2.0
"""Doing the jobs of a folder on this machine, until it is told to end."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import signal
import time
from collections.abc import Callable, Collection, Iterator
from types import FrameType

from ..errors import Error
from ..gl.devices import visible_gpus
from .hosting import Host
from .job_folder import HostState, JobFolder, Pace, TakenJob
from .local_worker import SECONDS_TO_CLOSE

logger = logging.getLogger(__name__)

# In an answer, instead of an outcome: why the job is not done, through no fault of its
# own; and whether it had at least half of the time that this host had.
GIVEN_BACK = "given_back"
HAD_MUCH_TIME = "had_much_time"

# What is left of the time after the workers have closed their files.
_SECONDS_LEFT = 5.0
_SHORTEST_POLL = 0.01
_POLLS_GROW = 1.5


@dataclasses.dataclass
class Notice:
    """What this process has been told by signals.

    Attributes:
        ends: it has to end at once.
        ends_soon: its time will be over.
    """

    ends: bool = False
    ends_soon: bool = False


@contextlib.contextmanager
def heard_signals(
    *, end: Collection[int], end_soon: int
) -> Iterator[Callable[[], Notice]]:
    """Yield a function that returns what signals have said; they do nothing else.

    Flags and no exceptions: between any two instructions, of submitit's too, nothing is
    torn apart.

    Args:
        end: those that ask for an end.
        end_soon: the one that says that the time will be over.
    """
    notice = Notice()

    def take_end(signum: int, frame: FrameType | None) -> None:
        notice.ends = True

    def take_end_soon(signum: int, frame: FrameType | None) -> None:
        notice.ends_soon = True

    def look() -> Notice:
        # Blocked, it waits here, unless a thread of some library's has taken it.
        notice.ends_soon = notice.ends_soon or end_soon in signal.sigpending()
        return notice

    before = {
        **{signum: signal.signal(signum, take_end) for signum in end},
        end_soon: signal.signal(end_soon, take_end_soon),
    }
    # Slurm sends it to all processes of the job, whom it would end. Workers inherit
    # that it is blocked.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [end_soon])
    # The driver may have blocked them while this process was started.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, end)
    try:
        yield look
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for signum, handler in before.items():
            signal.signal(signum, handler)


def serve(
    folder: JobFolder,
    *,
    host: str,
    workers: int,
    notice: Callable[[], Notice],
    limit_s: float,
    pace: Pace,
) -> None:
    """Do jobs of a folder until the run is over, or this process has to end.

    It ends by itself when the folder says so, when the driver is dead, when no worker
    can begin here, and where there is nothing to do. What it has then taken and not
    done it gives back.

    Args:
        folder: of the run.
        host: a name of this host that no other has had.
        workers: how many jobs are done at once.
        notice: returns what signals have said.
        limit_s: how long from now on this process is let live.
        pace: how often it looks.

    Raises:
        Error: no worker can begin on this machine.
    """
    time_s = max(0.0, limit_s - SECONDS_TO_CLOSE - _SECONDS_LEFT)
    if folder.is_stopped:
        return
    folder.note_host(host, HostState.WORKING)
    work = folder.work()
    with Host(
        work, folder.payload(), workers=workers, gpus=visible_gpus()
    ) as local_host:
        serving = _Serving(
            folder,
            local_host,
            name=host,
            workers=workers,
            notice=notice,
            time_s=time_s,
            pace=pace,
        )
        why = serving.until_the_end()
    # Closed by now: whoever does these jobs next finds no file open.
    serving.give_back(why)
    if serving.cannot_begin:
        # Another host on this machine would fare no better: this end is a bad one.
        raise Error("No worker can begin on this machine.")
    folder.note_host(host, HostState.ENDED)


class _Serving:
    """Takes jobs of a folder to the workers of a host, and outcomes back."""

    def __init__(
        self,
        folder: JobFolder,
        host: Host,
        *,
        name: str,
        workers: int,
        notice: Callable[[], Notice],
        time_s: float,
        pace: Pace,
    ) -> None:
        self._folder = folder
        self._host = host
        self._name = name
        self._workers = workers
        self._notice = notice
        self._began = time.monotonic()
        self._time_s = time_s
        self._pace = pace
        self._driver = _Driver(folder, silent_s=pace.silent_s)
        self._taken: dict[str, TakenJob] = {}
        # When each job was begun, by its key.
        self._begun: dict[str, float] = {}
        self._takes_more = True
        self.cannot_begin = False
        self._is_at_limit = False

    def until_the_end(self) -> str:
        """Do jobs; return why no more are done."""
        poll = _SHORTEST_POLL
        looked = idle_since = time.monotonic()
        while not (why := self._why_it_ends(idle_since)):
            took = self._takes_more and self._take()
            heard = self._hear(poll)
            now = time.monotonic()
            if took or heard:
                poll = _SHORTEST_POLL
            else:
                poll = min(poll * _POLLS_GROW, self._pace.poll_s)
            if self._taken:
                idle_since = now
            if now - looked >= self._pace.poll_s:
                looked = now
                self._driver.look()
            self._see_whether_to_leave()
        return why

    def give_back(self, why: str) -> None:
        """Let others do what was taken and is not done."""
        for key, job in self._taken.items():
            said = {
                GIVEN_BACK: why,
                HAD_MUCH_TIME: self._is_at_limit and self._had_much_time(key),
            }
            self._folder.answer(job, json.dumps(said).encode())
        self._taken.clear()

    def _why_it_ends(self, idle_since: float) -> str:
        """Return why no more is done; nothing as long as something is."""
        if self._notice().ends:
            return "its Slurm job had to end"
        if self._driver.has_said_stop:
            return "the run is over"
        if self.cannot_begin:
            return "no worker could begin"
        if time.monotonic() - self._began > self._time_s:
            self._is_at_limit = True
            return "its Slurm job came to its time limit"
        if self._taken:
            return ""
        if not self._takes_more:
            return "its Slurm job takes no more"
        if time.monotonic() - idle_since > self._pace.idle_s:
            return "there was nothing to do"
        return ""

    def _see_whether_to_leave(self) -> None:
        """Take no more jobs once it is known that there is no time for them."""
        leaves = self._notice().ends_soon or self._driver.is_dead
        if leaves and self._takes_more:
            self._takes_more = False
            self._folder.note_host(self._name, HostState.LEAVING)

    def _take(self) -> bool:
        """Take jobs for workers that have none; return whether there were any."""
        took = False
        while len(self._taken) < self._workers:
            job = self._folder.take(self._name)
            if job is None:
                break
            took = True
            self._begin(job)
        return took

    def _begin(self, job: TakenJob) -> None:
        said = json.loads(job.line)
        if said["key"] in self._begun:
            # It was done here, and what came of it got lost on its way.
            said["key"] += f", once more as {job.number}"
        key = said["key"]
        self._begun[key] = time.monotonic()
        self._host.submit(json.dumps(said).encode())
        self._taken[key] = job

    def _had_much_time(self, key: str) -> bool:
        return self._begun[key] - self._began < self._time_s / 2

    def _hear(self, seconds: float) -> bool:
        """Lay down what the workers have done, waiting so long for it at most."""
        if not self._host.unfinished:
            time.sleep(seconds)
            return False
        if len(self._taken) >= self._workers or not self._takes_more:
            # Nothing else is to be looked for meanwhile.
            seconds = self._pace.poll_s
        line = next(self._host.lines(patience_s=seconds), None)
        if line is None:
            return False
        said = json.loads(line)
        if "error" in said:
            self.cannot_begin = True
            for job in self._taken.values():
                self._folder.answer(job, line)
            self._taken.clear()
            return False
        self._folder.answer(self._taken.pop(said["key"]), line)
        return True


class _Driver:
    """The driver, as far as its folder shows it."""

    def __init__(self, folder: JobFolder, *, silent_s: float) -> None:
        self._folder = folder
        self._silent_s = silent_s
        self._sign = folder.sign()
        # By the clock of this machine.
        self._changed = time.monotonic()
        self.has_said_stop = False

    def look(self) -> None:
        """See what is new."""
        self.has_said_stop = self.has_said_stop or self._folder.is_stopped
        sign = self._folder.sign()
        if sign and sign != self._sign:
            self._sign = sign
            self._changed = time.monotonic()

    @property
    def is_dead(self) -> bool:
        """Whether it has given no sign of life for too long."""
        return time.monotonic() - self._changed > self._silent_s
