# SPDX-License-Identifier: Apache-2.0
"""The worker process of an evaluation.

The settings are `{"directory": DIR, "plan": <the plan as JSON, without its chunks>}`.
If the policy is an object, `"payload"` is the path of the file with the pickled policy.
If `"chooses_gl"` is true and episodes get videos, the worker chooses an OpenGL backend
that works on its machine. `"command"` is the command line that recordings name.

There are two kinds of jobs. It is safe to repeat a job.

`check`  Creates the environment and the policy without taking a step. The arguments are
         `{"task"}`. Returns `{"step_limit", "velocities"}`, where `velocities` is the
         number of degrees of freedom (0 without MuJoCo). If creation fails, returns
         `{"error": ...}` instead, packed by `messages.carried`. The caller can then
         raise the same error, and no traceback is logged.
`run`    Runs the missing episodes of a chunk. The arguments are `{"task", "folder",
         "chunk"}`. Returns `{"models": [...]}` with the SHA-256 of each compiled model
         that the worker has stored.
"""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..atomic_files import make_directory
from ..environments.scenes import simulation_below
from ..errors import Error, GLError
from ..formats.json_fields import from_json
from ..formats.locks import wait_for_lock
from ..gl.choice import use_gl
from ..messages import carried
from ..rendering.recovery import recover
from ..simulation.model_trust import noting_models
from .plan import NO_GL, Chunk, EvaluationPlan
from .running import Evaluator

logger = logging.getLogger(__name__)

_LOCK = ".mjrec.chunk.lock"


class EvaluationWorker:
    """A handler for `engines.jobs` that runs an evaluation's jobs.

    Args:
        settings: the settings, which the module docstring describes.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._directory = Path(settings["directory"])
        self._plan = from_json(EvaluationPlan, settings["plan"])
        # A reader of the recordings needs the command that started the evaluation.
        sys.orig_argv[:] = settings.get("command", sys.orig_argv)
        policy = settings.get("payload")
        self._evaluator = Evaluator(
            self._plan, None if policy is None else Path(policy).read_bytes()
        )
        # If dm_control finds no other backend, it tries GLFW, which warns on a headless
        # machine that there is no display. If that matters, drawing will report it.
        warnings.filterwarnings("ignore", message=r"\(65550\) b'X11")
        if settings.get("chooses_gl") and self._evaluator.draws:
            try:
                use_gl()
            except GLError as error:
                logger.warning(NO_GL, error)
        # Imported here because it loads MuJoCo, which then picks its GL backend.
        from ..simulation.warnings import log_mujoco_warnings

        log_mujoco_warnings()

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run a job.

        Raises:
            Error: the job failed. A check returns the error instead of raising it.
        """
        if arguments["kind"] == "check":
            return self._check(arguments["task"])
        return self._run(arguments)

    def leave(self) -> None:
        """Record that the running episode is not the reason why this process ends."""
        self._evaluator.leave()

    def close(self) -> None:
        """Close the environment."""
        self._evaluator.close()

    def _check(self, task: str) -> dict[str, Any]:
        try:
            named = self._evaluator.acting(task, self._plan.seeds[0]).named
        except Error as error:
            return {"error": carried(error)}
        simulation = simulation_below(named.environment)
        return {
            "step_limit": named.step_limit,
            "velocities": 0 if simulation is None else int(simulation.model.nv),
        }

    def _run(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        folder = self._directory / arguments["folder"]
        make_directory(folder)
        # If an earlier evaluation was killed, its workers may still be running.
        with wait_for_lock(folder / _LOCK), noting_models() as models:
            recover(folder, bundle=True)
            chunk = from_json(Chunk, arguments["chunk"])
            self._evaluator.complete(arguments["task"], folder, chunk)
        return {"models": list(dict.fromkeys(models))}
