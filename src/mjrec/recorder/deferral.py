# SPDX-License-Identifier: Apache-2.0
"""Whether the videos of a run can be rendered later, from what is recorded."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from ..errors import NoPictures, PicturesDiffer
from .subject import Subject, what_is_missing
from .video_recorder import can_give_pictures

if TYPE_CHECKING:
    from ..simulation.capture import EpisodeStart

logger = logging.getLogger(__name__)


class Deferral:
    """Tells whether what begins can be rendered later, and says why not, once.

    Args:
        subject: what is recorded.
    """

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self._said: set[str] = set()

    def is_possible(self, start: EpisodeStart) -> bool:
        """Tell whether pictures can be made from the states that begin with `start`.

        Raises:
            PicturesDiffer: they cannot, and nothing else was asked for.
            NoPictures: they cannot, nor can they be drawn live.
        """
        if start.refusal is None:
            return True
        subject = self._subject
        if subject.rendering.is_forced:
            raise PicturesDiffer(
                f"The videos of {subject.env_id} were to be rendered later, from "
                f'recorded states, and cannot be: {start.refusal}. Use render="live".'
            )
        if not can_give_pictures(subject.pictures):
            raise NoPictures(
                f"The videos of {subject.env_id} cannot be rendered from its states: "
                f"{start.refusal}. They cannot be drawn live either: "
                f"{what_is_missing(subject.pictures)}."
            )
        if start.refusal not in self._said:
            self._said.add(start.refusal)
            logger.warning(
                "The videos of %s are drawn live: %s.", subject.env_id, start.refusal
            )
        return False
