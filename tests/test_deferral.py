# SPDX-License-Identifier: Apache-2.0
"""Where pictures cannot be rendered later, it is said, and drawn live or refused."""

from __future__ import annotations

import dataclasses
from fractions import Fraction
from typing import Any

import pytest

from mjrec import NoPictures, PicturesDiffer
from mjrec.formats.trajectory import RowLayout
from mjrec.recorder.deferral import Deferral
from mjrec.recorder.options import DEFERRED, RenderingChoice
from mjrec.recorder.subject import Subject
from mjrec.simulation.capture import EpisodeStart

POSSIBLE = EpisodeStart(state=(), snapshot=RowLayout(), model={}, scene=None)
REFUSED = dataclasses.replace(POSSIBLE, refusal="a plugin draws")


class Pictures:
    """Those of an environment."""

    def __init__(self, mode: str | None) -> None:
        self.render_mode = mode


def deferral(*, mode: str | None = "rgb_array", is_forced: bool = False) -> Deferral:
    pictures: Any = Pictures(mode)
    return Deferral(
        Subject(
            env_id="Some-v0",
            pictures=pictures,
            clock=lambda: None,
            declared=lambda: Fraction(30),
            rendering=RenderingChoice(mode=DEFERRED, is_forced=is_forced),
        )
    )


@pytest.mark.parametrize("is_forced", [False, True])
def test_what_is_not_refused_can_be_rendered_later(
    is_forced: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Without a word."""
    assert deferral(mode=None, is_forced=is_forced).is_possible(POSSIBLE)
    assert not caplog.records


def test_a_reason_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    """Not at every episode; another reason is another word."""
    told = deferral()
    other = dataclasses.replace(REFUSED, refusal="a depth picture")
    assert not any(told.is_possible(start) for start in (REFUSED, REFUSED, other))
    assert [record.getMessage() for record in caplog.records] == [
        "The videos of Some-v0 are drawn live: a plugin draws.",
        "The videos of Some-v0 are drawn live: a depth picture.",
    ]


def test_what_was_forced_is_an_error() -> None:
    """It names the reason, and what would help."""
    with pytest.raises(PicturesDiffer, match=r'a plugin draws\. Use render="live"'):
        deferral(is_forced=True).is_possible(REFUSED)


def test_an_environment_without_pictures_is_an_error() -> None:
    """It can be recorded neither way."""
    with pytest.raises(NoPictures, match=r"a plugin draws\. .* render_mode is None"):
        deferral(mode=None).is_possible(REFUSED)
