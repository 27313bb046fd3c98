# SPDX-License-Identifier: Apache-2.0
"""A worker of an evaluation that leaves logs to what is worth reading."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from ..carried_errors import carried
from ..errors import Error
from .worker import EvaluationWorker

__all__ = ["CheckingWorker"]


class CheckingWorker(EvaluationWorker):
    """Does the jobs of an evaluation, and gives `{"error": ...}` for a bad task.

    So the error comes home as what it is, with its facts. A job that fails is logged
    with its traceback, which a name that nobody knows does not deserve.

    Args:
        settings: see `worker`.
        payload: likewise.
    """

    def __init__(self, settings: Mapping[str, Any], payload: bytes | None) -> None:
        super().__init__(settings, payload)
        # dm_control tries GLFW when it is imported, which in each worker complains of
        # the display that a machine without a screen has not got. Where that matters,
        # drawing says so.
        warnings.filterwarnings("ignore", message=r"\(65550\) b'X11")

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do a job.

        Raises:
            Error: of another job than a check.
        """
        try:
            return super().__call__(arguments)
        except Error as error:
            if arguments["kind"] != "check":
                raise
            return {"error": carried(error)}
