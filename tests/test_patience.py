# SPDX-License-Identifier: Apache-2.0
"""How long something may make no progress."""

import functools
import time

import pytest

from mjrec import InvalidArgument
from mjrec.patience import Patience, patience_s


def test_the_environment_variable_counts(monkeypatch):
    """Two minutes without it."""
    monkeypatch.delenv("MJREC_PATIENCE", raising=False)
    assert patience_s() == 120
    monkeypatch.setenv("MJREC_PATIENCE", "2.5")
    assert patience_s() == 2.5
    assert Patience().seconds == 2.5


@pytest.mark.parametrize("text", ["soon", "0", "-1", "inf", "nan"])
def test_what_is_no_time_is_an_error(text, monkeypatch):
    """It names the variable."""
    monkeypatch.setenv("MJREC_PATIENCE", text)
    with pytest.raises(InvalidArgument, match="MJREC_PATIENCE"):
        patience_s()


def test_who_was_stopped_counts_no_more_than_he_was_to_wait(monkeypatch):
    """Sleeping for an hour makes nothing hang; progress gives the time anew."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    patience = Patience(120)

    def sleep(seconds, *, really=0, news=False):
        now[0] += really or seconds
        return news

    assert not patience.wait(functools.partial(sleep, really=3600))
    assert not patience.is_over
    for _ in range(119):
        assert not patience.wait(sleep)
    assert patience.is_over
    assert patience.wait(functools.partial(sleep, news=True))
    assert not patience.is_over
