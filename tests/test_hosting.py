# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import logging
import sys
from pathlib import Path
from typing import Any

import pytest

from mjrec.engines.gpu_shares import GpuShare
from mjrec.engines.home_log import HomeLog
from mjrec.engines.hosting import Host, HostedWork, take_home
from mjrec.engines.job_book import JobBook, Task
from mjrec.engines.work import Job, Work
from mjrec.errors import InvalidArgument, UnknownName

pytestmark = pytest.mark.usefixtures("no_process_is_left")


def hosted(make: str = "make", **settings: Any) -> HostedWork:
    work = Work(entry=f"odd_jobs:{make}", settings=settings, payload=b"large")
    return HostedWork.of(work, GpuShare())


def task_in(book: JobBook, key: str = "a", **arguments: Any) -> Task:
    book.add(Job(key=key, arguments=arguments))
    return book.take()


def home(host: Host, *tasks: Task) -> list[dict[str, Any]]:
    for task in tasks:
        host.submit(task.line)
    return [json.loads(line) for line in host.lines() if line is not None]


def test_work_travels_without_its_payload() -> None:
    """All else comes back as it was."""
    share = GpuShare(each=0.25, required=True)
    work = Work(entry="a:b", settings={"x": [1]}, payload=b"1", environ={"Y": "z"})
    sent = HostedWork.of(work, share).to_json()
    back = HostedWork.from_json(sent)
    assert back.work == Work(entry="a:b", settings={"x": [1]}, environ={"Y": "z"})
    assert back.share == share
    assert back.directory == str(Path.cwd())
    assert b"\n" not in sent


def test_settings_are_json() -> None:
    """What is none is told before anything travels."""
    with pytest.raises(InvalidArgument, match="settings of the work"):
        hosted(env=object()).to_json()


def test_a_job_comes_home() -> None:
    """Handler, settings and payload are as with the local engine."""
    book = JobBook()
    with Host(hosted(seeds=[1]), b"large") as host:
        [echo] = home(host, task_in(book, "a", do="echo"))
        [payload] = home(host, task_in(book, "b", do="payload"))
        assert host.unfinished == 0
    assert echo["value"]["settings"] == {"seeds": [1]}
    assert payload["value"]["size"] == 5


def test_workers_are_where_the_driver_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a machine that has the driver's directory; elsewhere where the host is."""
    monkeypatch.chdir(tmp_path)
    work = hosted()
    monkeypatch.chdir("/")
    task = task_in(JobBook(), do="where")
    with Host(work, None) as host:
        [said] = home(host, task)
    assert said["value"]["directory"] == str(tmp_path)
    tmp_path.rename(tmp_path.with_name("elsewhere"))
    with Host(work, None) as host:
        [said] = home(host, task)
    assert said["value"]["directory"] == "/"


def test_workers_find_the_modules_of_the_driver(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After those of their own machine; directories that are not there are left out."""
    (tmp_path / "mine.py").write_text("from odd_jobs import make\n")
    with monkeypatch.context() as driver:
        driver.syspath_prepend(str(tmp_path))
        driver.syspath_prepend(str(tmp_path / "missing"))
        work = HostedWork.of(Work(entry="mine:make"), GpuShare())
    monkeypatch.setattr(sys, "path", list(sys.path))
    with Host(work, None) as host:
        [said] = home(host, task_in(JobBook(), do="echo"))
        assert sys.path[-1] == str(tmp_path)
    assert "value" in said


def test_warnings_come_home_and_are_logged_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A job's warnings are in its line; the same text of another is not repeated."""
    book, log = JobBook(), HomeLog()
    with Host(hosted(), None) as host, caplog.at_level(logging.WARNING):
        for key in ("a", "b"):
            task = task_in(book, key, do="talk")
            [said] = home(host, task)
            assert said["log"]
            caplog.clear()
            take_home(json.dumps(said).encode(), task, book, log)
            assert bool(caplog.messages) == (key == "a")


def test_a_worker_that_dies_there_is_replaced_there() -> None:
    """Nobody else hears of it but by the tries, and the failure in the end."""
    book = JobBook()
    task = task_in(book, do="die", how="SIGKILL")
    with Host(hosted(), None) as host:
        [said] = home(host, task)
        [after] = home(host, task_in(book, "b", do="echo"))
    assert said["tries"] == 3
    assert "was killed by SIGKILL" in said["failure"]
    assert "value" in after
    take_home(json.dumps(said).encode(), task, book, HomeLog())
    outcome = book.next_outcome()
    assert outcome is not None
    assert outcome.tries == 3


def test_a_handler_that_cannot_be_made_is_the_error_of_the_run() -> None:
    """Where nothing has been done yet, no other machine will do better."""
    book = JobBook()
    task = task_in(book, do="echo")
    with Host(hosted("make_no_name"), None) as host:
        [said] = home(host, task)
    with pytest.raises(UnknownName, match="egocentric"):
        take_home(json.dumps(said).encode(), task, book, HomeLog())


def test_a_machine_on_which_nothing_can_begin_is_not_the_end() -> None:
    """Where others can, its job is begun again by them."""
    book, log = JobBook(), HomeLog()
    done, task = task_in(book, "done"), task_in(book, "a")
    take_home(b'{"key": "done", "value": {}}', done, book, log)
    error = b'{"error": {"type": "GLError", "message": "No EGL."}, "log": []}'
    take_home(error, task, book, log)
    assert book.take() is task
    assert task.deaths == 1


def test_closing_is_for_all_workers(tmp_path: Path) -> None:
    """They close their handlers; a second time does nothing."""
    closed = tmp_path / "closed"
    host = Host(hosted(closed=str(closed)), None, workers=2)
    assert (
        len(home(host, *[task_in(JobBook(), str(n), do="echo") for n in (1, 2)])) == 2
    )
    host.close()
    host.close()
    assert len(closed.read_text().splitlines()) in (1, 2)
