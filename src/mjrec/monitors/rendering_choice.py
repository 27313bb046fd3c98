# SPDX-License-Identifier: Apache-2.0
"""Whether a run's pictures are drawn later, live, or not at all."""

from __future__ import annotations

import logging

from ..environments.scenes import Scenes
from ..errors import PicturesDiffer
from ..recorder.options import DEFERRED, LIVE, OFF, RenderingChoice

logger = logging.getLogger(__name__)

_NO_SIMULATION = "it has no MuJoCo model and data that can be seen"


def rendering_choice(asked: str | None, scenes: Scenes, env_id: str) -> RenderingChoice:
    """Return when the pictures of an environment are drawn.

    Args:
        asked: `"deferred"`, `"live"`, `"off"`, or None for deferred where it is known
            that the pictures follow from the states, else live.
        scenes: what is known of the environment.
        env_id: its name, for messages.

    Raises:
        PicturesDiffer: deferred was asked for, and the pictures do not follow.
    """
    if asked in (LIVE, OFF):
        return RenderingChoice(mode=str(asked), is_forced=True)
    obstacle = _NO_SIMULATION if scenes.states is None else scenes.obstacle
    if obstacle is None:
        logger.info("The videos of %s are rendered from recorded states.", env_id)
        return RenderingChoice(mode=DEFERRED, is_forced=asked == DEFERRED)
    if asked == DEFERRED:
        raise PicturesDiffer(
            f'render="deferred" was asked for, and what {env_id} shows cannot be made '
            f'from its recorded state: {obstacle}. Use render="live" (or None, which '
            "chooses)."
        )
    logger.info("The videos of %s are drawn live: %s.", env_id, obstacle)
    return RenderingChoice(mode=LIVE, reason=obstacle)
