# SPDX-License-Identifier: Apache-2.0
"""Where frames cannot be rendered later, they are drawn live, or refused."""

from __future__ import annotations

from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import pytest

from mjrec import NoPictures, PicturesDiffer
from mjrec.recorder.options import DEFERRED, RenderingChoice
from mjrec.recorder.subject import Subject, check_refusal


def refuse(*, mode: str | None = "rgb_array", is_forced: bool = False) -> None:
    pictures: Any = SimpleNamespace(render_mode=mode)
    subject = Subject(
        env_id="Some-v0",
        pictures=pictures,
        clock=lambda: None,
        declared=lambda: Fraction(30),
        rendering=RenderingChoice(mode=DEFERRED, is_forced=is_forced),
    )
    check_refusal(subject, "a plugin draws")


def test_an_environment_that_can_be_drawn_live_is() -> None:
    """Without an error."""
    refuse()


def test_what_was_forced_is_an_error() -> None:
    """It names the reason, and what would help."""
    with pytest.raises(PicturesDiffer, match=r'a plugin draws\. Use render="live"'):
        refuse(is_forced=True)


def test_an_environment_without_pictures_is_an_error() -> None:
    """It can be recorded neither way."""
    with pytest.raises(NoPictures, match=r"a plugin draws\. .* render_mode is None"):
        refuse(mode=None)
