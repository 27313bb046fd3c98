# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import logging

import pytest

from mjrec.engines.job_book import TRIES, JobBook
from mjrec.engines.work import Job
from mjrec.errors import InvalidArgument


def book_of(*keys: str) -> JobBook:
    book = JobBook()
    for key in keys:
        book.add(Job(key=key, arguments={"number": 1}))
    return book


def taken(book: JobBook) -> list[str]:
    return [book.take().key for _ in range(book.waiting)]


def test_jobs_are_taken_in_their_order() -> None:
    """What has waited longest comes first, as a line of JSON."""
    book = book_of("a", "b")
    task = book.take()
    assert json.loads(task.line) == {"key": "a", "arguments": {"number": 1}}
    assert taken(book) == ["b"]
    assert book.unfinished == 2


def test_a_key_is_there_once() -> None:
    """Also when the job is over: its outcome could not be told from the other's."""
    book = book_of("a")
    book.finish(book.take(), value={})
    book.next_outcome()
    with pytest.raises(InvalidArgument, match="a job 'a' in this run already"):
        book.add(Job(key="a", arguments={}))


def test_what_is_no_json_is_told_at_once() -> None:
    """Nothing is noted of it."""
    book = JobBook()
    with pytest.raises(InvalidArgument, match="'a' cannot be written as JSON"):
        book.add(Job(key="a", arguments={"env": object()}))
    assert (book.unfinished, book.waiting) == (0, 0)


def test_outcomes_are_given_out_once() -> None:
    """A job is unfinished until its outcome is given out."""
    book = book_of("a")
    assert book.next_outcome() is None
    book.finish(book.take(), value={"n": 1}, tries=2)
    assert (book.unfinished, book.has_outcome) == (1, True)
    outcome = book.next_outcome()
    assert outcome is not None
    assert (outcome.key, outcome.value, outcome.tries) == ("a", {"n": 1}, 2)
    assert (book.unfinished, book.next_outcome()) == (0, None)


def test_a_job_that_kills_goes_to_the_end_of_the_queue(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The others are done before it is tried again; the log says so."""
    book = book_of("a", "b")
    with caplog.at_level(logging.WARNING):
        book.begin_again(book.take(), "was killed by SIGKILL")
    first, second = book.take(), book.take()
    assert json.loads(first.line) == {"key": "b", "arguments": {"number": 1}}
    assert json.loads(second.line)["arguments"] == {"number": 1, "again": True}
    assert second.key == "a"
    assert caplog.messages == [
        "A worker died at the job a, which is begun again. It was killed by SIGKILL"
    ]


def test_a_job_that_kills_three_times_has_failed() -> None:
    """Its failure says what the last worker died of, and it is tried no more."""
    book = book_of("a")
    for _ in range(TRIES):
        book.begin_again(book.take(), "was killed by SIGSEGV")
    outcome = book.next_outcome()
    assert outcome is not None
    assert outcome.tries == TRIES
    assert outcome.failure == (
        "Its worker died, which was try 3 of 3: it was killed by SIGSEGV"
    )
    assert book.waiting == 0
    assert not book.any_is_done


def test_tries_count_deaths() -> None:
    """A job that was done after a worker's death was begun twice."""
    book = book_of("a")
    book.begin_again(book.take(), "ended")
    book.finish(book.take(), value={})
    outcome = book.next_outcome()
    assert outcome is not None
    assert outcome.tries == 2
    assert book.any_is_done


def test_what_is_put_back_is_first_and_not_to_blame() -> None:
    """A machine that is taken away says nothing about the job."""
    book = book_of("a", "b")
    for _ in range(2 * TRIES):
        task = book.take()
        assert task.key == "a"
        book.put_back(task)
    assert task.deaths == 0
    assert json.loads(task.line)["arguments"] == {"number": 1, "again": True}
    assert taken(book) == ["a", "b"]
