# SPDX-License-Identifier: Apache-2.0
"""A worker whose checks tell what is wrong, instead of failing."""

from __future__ import annotations

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
    """

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
