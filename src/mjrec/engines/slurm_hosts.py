# SPDX-License-Identifier: Apache-2.0
"""The hosts of a run in Slurm jobs, and having as many of them as there is work for."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ..errors import Error
from .job_folder import HostState, JobFolder, Pace
from .local_worker import SECONDS_TO_CLOSE
from .slurm_jobs import ClusterJobs, JobState, NotSubmitted

logger = logging.getLogger(__name__)

_SHORTEST_POLL = 0.005
_POLLS_GROW = 1.5
# Twice may be chance: a bad node, which the next one is given too.
_ENDS_AT_ONCE = 3
_SECONDS_BETWEEN_TRIES = 30.0
_TRIES_TO_SUBMIT = 10
_SECONDS_BEFORE_SAYING_WHY = 60.0
_SECONDS_TO_LEAVE = 15.0
_END_OF_LOG = 2000


@dataclass(frozen=True, kw_only=True)
class HostEnd:
    """How a host has ended that has not said so itself.

    Attributes:
        how: as a part of a sentence.
        is_to_blame: whether what it did may be the cause.
    """

    how: str
    is_to_blame: bool


@dataclass(eq=False)
class _SlurmJob:
    """One that was submitted, and is not over."""

    number: str
    submitted: float
    has_begun: bool = False
    takes_more: bool = True
    has_done_something: bool = False
    # Of a job that Slurm begins again: the hosts that were in it before.
    earlier_hosts: int = 0


class SlurmHosts:
    """The Slurm jobs of a run, and the hosts in them.

    Args:
        folder: of the run.
        jobs: on the cluster.
        pace: how often they are looked at.
    """

    def __init__(self, folder: JobFolder, jobs: ClusterJobs, pace: Pace) -> None:
        self._folder = folder
        self._jobs = jobs
        self._pace = pace
        self._all: dict[str, _SlurmJob] = {}
        self._dead: dict[str, HostEnd] = {}
        self._ends_at_once = 0
        self._last_end = ""
        self._any_was_taken = False
        self._refused = 0
        self._not_before = -math.inf
        self._why_said = -math.inf
        self.logs_to_keep = False

    def want(self, count: int) -> None:
        """Have so many hosts that take jobs, once the cluster grants them.

        Raises:
            NotSubmitted: the cluster takes no jobs.
        """
        missing = count - sum(job.takes_more for job in self._all.values())
        now = time.monotonic()
        if missing <= 0 or now < self._not_before or self._ends_too_often:
            return
        try:
            numbers = self._jobs.submit(missing)
        except NotSubmitted as error:
            self._refused += 1
            if not self._any_was_taken or self._refused >= _TRIES_TO_SUBMIT:
                raise
            logger.warning("%s. It is tried again.", error)
            self._not_before = now + _SECONDS_BETWEEN_TRIES
            return
        self._any_was_taken = True
        self._refused = 0
        logger.info("Submitted: %s.", ", ".join(numbers))
        self._all.update((n, _SlurmJob(number=n, submitted=now)) for n in numbers)

    def has_done_something(self, host: str) -> None:
        """Note that a host has done a job."""
        job = self._all.get(_job_of(host))
        if job is not None and not job.has_done_something:
            job.has_done_something = True
            self._ends_at_once = 0

    def look(self) -> dict[str, HostEnd]:
        """See what became of all; return hosts that have died so far, and how.

        Again and again, because what they had taken may not be seen at once.
        """
        states = self._jobs.states(self._all)
        hosts = self._folder.hosts()
        for number, state in states.items():
            ours = sorted((h for h in hosts if _job_of(h) == number), key=_begun)
            self._note(self._all[number], state, [hosts[host] for host in ours])
            last = ours if state.is_over or state.is_waiting else ours[:-1]
            end = self._end_of(number, state)
            for host in last:
                if hosts[host] is not HostState.ENDED:
                    self._dead.setdefault(host, end)
            if state.is_over:
                self._see_off(number, end, said=[hosts[host] for host in ours])
        self._say_why_none_begins(states)
        return self._dead

    def check(self) -> None:
        """Raise where hosts end again and again without having done anything.

        Raises:
            Error: they do, and there are no others at work.
        """
        others = any(job.has_begun and job.takes_more for job in self._all.values())
        if self._ends_too_often and not others:
            raise Error(
                f"No Slurm job can do anything. Their logs are in {self._folder.logs}. "
                f"The last one {self._last_end}"
            )

    def end_all(self) -> None:
        """Let all hosts end by themselves, and see to it that they have."""
        self._folder.stop()
        waiting = [n for n, s in self._jobs.states(self._all).items() if s.is_waiting]
        self._jobs.end(waiting)
        self._wait_for_end(SECONDS_TO_CLOSE + _SECONDS_TO_LEAVE)
        if self._all:
            logger.warning(
                "%d Slurm jobs have not ended by themselves, and are cancelled.",
                len(self._all),
            )
            self._jobs.end(self._all)

    @property
    def _ends_too_often(self) -> bool:
        return self._ends_at_once >= _ENDS_AT_ONCE

    def _note(
        self, job: _SlurmJob, state: JobState, hosts: Sequence[HostState]
    ) -> None:
        if state.is_waiting:
            job.earlier_hosts = len(hosts)
        now = hosts[job.earlier_hosts :]
        job.has_begun = bool(now)
        job.takes_more = not now or now[-1] is HostState.WORKING

    def _end_of(self, number: str, state: JobState) -> HostEnd:
        how = f"was in the Slurm job {number}, which is {state.name}."
        if state.is_to_blame:
            how = f"{how} The end of its log: {self._end_of_log(number)}"
        return HostEnd(how=how, is_to_blame=state.is_to_blame)

    def _see_off(self, number: str, end: HostEnd, *, said: list[HostState]) -> None:
        """Note that a Slurm job is over."""
        job = self._all.pop(number)
        if (said and said[-1] is HostState.ENDED) or not end.is_to_blame:
            return
        self.logs_to_keep = True
        self._last_end = end.how
        if not job.has_done_something:
            self._ends_at_once += 1
        logger.warning("A Slurm job has died: it %s", end.how)

    def _end_of_log(self, number: str) -> str:
        with contextlib.suppress(OSError):
            said = self._jobs.log_of(number).read_bytes()
            return said[-_END_OF_LOG:].decode(errors="replace").strip() or "(nothing)"
        return f"(there is none, {self._jobs.log_of(number)})"

    def _say_why_none_begins(self, states: Mapping[str, JobState]) -> None:
        now = time.monotonic()
        waiting = [job for job in self._all.values() if not job.has_begun]
        if (
            len(waiting) < len(self._all)
            or not waiting
            or now - waiting[0].submitted < _SECONDS_BEFORE_SAYING_WHY
            or now - self._why_said < 10 * _SECONDS_BEFORE_SAYING_WHY
        ):
            return
        self._why_said = now
        first = waiting[0].number
        state = states.get(first, JobState(name="UNKNOWN"))
        logger.warning(
            "%d Slurm jobs wait for their turn. What Slurm says of %s: %s (%s).",
            len(waiting),
            first,
            state.name,
            state.reason or "no reason",
        )

    def _wait_for_end(self, seconds: float) -> None:
        began = looked = time.monotonic()
        pause = _SHORTEST_POLL
        while self._all and (now := time.monotonic()) - began < seconds:
            # The cluster is not asked more often than it has to be.
            if self._all_say_so() or now - looked >= self._pace.look_s:
                looked = now
                states = self._jobs.states(self._all)
                for number in [n for n, state in states.items() if state.is_over]:
                    del self._all[number]
            time.sleep(pause)
            pause = min(pause * _POLLS_GROW, self._pace.poll_s)

    def _all_say_so(self) -> bool:
        """Whether all that have begun, and may live, say that they have ended."""
        return all(
            state is HostState.ENDED
            for host, state in self._folder.hosts().items()
            if _job_of(host) in self._all
        )


def _job_of(host: str) -> str:
    return host.rpartition("-")[0]


def _begun(host: str) -> int:
    return int(host.rpartition("-")[2])
