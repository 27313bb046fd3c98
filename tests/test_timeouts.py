# SPDX-License-Identifier: Apache-2.0
"""How long something may make no progress."""

import functools
import time

import pytest

from mjrec import InvalidArgument
from mjrec.timeouts import Timeout, timeout_s


def test_the_environment_variable_counts(monkeypatch):
    """Two minutes without it."""
    monkeypatch.delenv("MJREC_TIMEOUT", raising=False)
    assert timeout_s() == 120
    monkeypatch.setenv("MJREC_TIMEOUT", "2.5")
    assert timeout_s() == 2.5
    assert Timeout().seconds == 2.5


@pytest.mark.parametrize("text", ["soon", "0", "-1", "inf", "nan"])
def test_what_is_no_time_is_an_error(text, monkeypatch):
    """It names the variable."""
    monkeypatch.setenv("MJREC_TIMEOUT", text)
    with pytest.raises(InvalidArgument, match="MJREC_TIMEOUT"):
        timeout_s()


def test_who_was_stopped_counts_no_more_than_he_was_to_wait(monkeypatch):
    """Sleeping for an hour makes nothing hang; progress gives the time anew."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    timeout = Timeout(120)

    def sleep(seconds, *, really=0, news=False):
        now[0] += really or seconds
        return news

    assert not timeout.wait(functools.partial(sleep, really=3600))
    assert not timeout.is_over
    for _ in range(119):
        assert not timeout.wait(sleep)
    assert timeout.is_over
    assert timeout.wait(functools.partial(sleep, news=True))
    assert not timeout.is_over
