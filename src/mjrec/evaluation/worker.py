# SPDX-License-Identifier: Apache-2.0
"""The worker process of an evaluation.

Settings: `{"directory": DIR, "plan": <the plan as JSON, without its chunks>}`. If the
policy is an object, `"payload"` is the file with the pickled policy. With
`"chooses_gl": true` the worker chooses an OpenGL backend that works on its machine, if
episodes get videos. `"command"` is the command line that recordings name.

Jobs, by their `kind`; repeating a job is harmless:

`check`  `{"task"}`: creates the environment and the policy, without taking a step.
         Returns `{"step_limit", "velocities"}`, where `velocities` is the number of
         degrees of freedom (0 without MuJoCo). If creation fails, returns `{"error":
         ...}`, packed by `messages.carried`, so that the caller can raise the same
         error and no traceback is logged.
`run`    `{"task", "folder", "chunk"}`: runs the missing episodes of a chunk. Returns
         `{"models": [SHA-256 of each compiled model that it has stored, ...]}`.
"""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..environments.scenes import simulation_below
from ..errors import DirectoryNotWritable, Error, GLError
from ..formats.dataclass_json import from_json
from ..formats.locks import wait_for_lock
from ..gl import use_gl
from ..messages import carried
from ..rendering.recovery import recover
from ..simulation.model_trust import noting_models
from .plan import NO_GL, Chunk, EvaluationPlan
from .running import Evaluator

logger = logging.getLogger(__name__)

_LOCK = ".mjrec.chunk.lock"


class EvaluationWorker:
    """Runs an evaluation's jobs; a handler for `engines.jobs`.

    Args:
        settings: see the module docstring.
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
        # If dm_control finds no other backend it tries GLFW, which warns about the
        # missing display on a headless machine. If that matters, drawing reports it.
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
            Error: the job failed. A check returns its error instead.
        """
        if arguments["kind"] == "check":
            return self._check(arguments["task"])
        return self._run(arguments)

    def leave(self) -> None:
        """Note in the journal that the running episode did not end this process."""
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
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DirectoryNotWritable(folder, error.strerror) from error
        # A worker of an earlier run whose driver was killed may still be at work.
        with wait_for_lock(folder / _LOCK), noting_models() as models:
            recover(folder, bundle=True)
            chunk = from_json(Chunk, arguments["chunk"])
            self._evaluator.complete(arguments["task"], folder, chunk)
        return {"models": list(dict.fromkeys(models))}
