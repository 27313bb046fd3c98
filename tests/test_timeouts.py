# SPDX-License-Identifier: Apache-2.0
"""Test timeouts without progress."""

import time

import pytest

from mjrec import InvalidArgument
from mjrec.timeouts import Timeout, timeout_s


def test_environment_variable_sets_the_timeout(monkeypatch):
    """The default is two minutes; an invalid value is an error that names it."""
    monkeypatch.delenv("MJREC_TIMEOUT", raising=False)
    assert timeout_s() == 120
    monkeypatch.setenv("MJREC_TIMEOUT", "2.5")
    assert Timeout().seconds == 2.5
    for text in ("soon", "0", "inf", "nan"):
        monkeypatch.setenv("MJREC_TIMEOUT", text)
        with pytest.raises(InvalidArgument, match="MJREC_TIMEOUT"):
            timeout_s()


def test_time_asleep_does_not_count(monkeypatch):
    """An hour of sleep counts as a single wait; progress restarts the timeout."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    timeout = Timeout(120)

    def wait(slept, *, news=False):
        def until(seconds):
            now[0] += slept
            return news

        return timeout.wait(until)

    assert not wait(3600)
    assert not timeout.is_over
    assert not any(wait(1) for _ in range(119))
    assert timeout.is_over
    assert wait(1, news=True)
    assert not timeout.is_over
