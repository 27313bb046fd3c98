# SPDX-License-Identifier: Apache-2.0
"""What MuJoCo warns of, in the log instead of a file in the working directory."""

from __future__ import annotations

import functools
import logging

import mujoco

_LOG = logging.getLogger(__name__)


def log_mujoco_warnings() -> None:
    """Log each warning of MuJoCo once, for the rest of this process.

    MuJoCo itself would write `MUJOCO_LOG.TXT`; a full scene, for one, warns at each
    picture. For processes of our own only: there is one handler in a process.
    """
    mujoco.set_mju_user_warning(_warn_once)


@functools.lru_cache(maxsize=100)
def _warn_once(text: str) -> None:
    _LOG.warning("MuJoCo: %s", text)
