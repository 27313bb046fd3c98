# SPDX-License-Identifier: Apache-2.0
"""What a worker process of an evaluation does.

Settings: `{"directory": DIR, "plan": <the plan as JSON, without its chunks>}`;
`"payload"`, the file with the pickled policy, where that is an object; and
`"chooses_gl": true` where the worker is to choose an OpenGL backend that works on its
machine, if episodes get videos. Jobs, by their `kind`; doing one again is harmless:

`check`  `{"task"}`: makes the environment and the policy, and takes no step. Returns
         `{"step_limit", "velocities"}`, the last one the number of degrees of freedom
         (0 without MuJoCo), or `{"error": ...}` where they cannot be made: as
         `messages.carried` packs it, so that it comes home as what it is, and leaves no
         traceback in the log.
`run`    `{"task", "folder", "chunk"}`: runs the missing episodes of a chunk. Returns
         `{"models": [sha256 of compiled ones that it has stored, ...]}`.
"""

from __future__ import annotations

import logging
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
    """Does the jobs of an evaluation; a handler of `engines.jobs`.

    Args:
        settings: see the module.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._directory = Path(settings["directory"])
        self._plan = from_json(EvaluationPlan, settings["plan"])
        policy = settings.get("payload")
        self._evaluator = Evaluator(
            self._plan, None if policy is None else Path(policy).read_bytes()
        )
        # dm_control tries GLFW where no other backend was found, and complains of the
        # display that a machine without a screen has not got. Where that matters,
        # drawing says so.
        warnings.filterwarnings("ignore", message=r"\(65550\) b'X11")
        if settings.get("chooses_gl") and self._evaluator.draws:
            try:
                use_gl()
            except GLError as error:
                logger.warning(NO_GL, error)
        # Not at the top, because it loads MuJoCo, which takes its backend then.
        from ..simulation.warnings import log_mujoco_warnings

        log_mujoco_warnings()

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do a job.

        Raises:
            Error: of what the job is about, unless it is a check.
        """
        if arguments["kind"] == "check":
            return self._check(arguments["task"])
        return self._run(arguments)

    def leave(self) -> None:
        """Note in the journal that nothing here is to blame for the end."""
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
        # That of a run whose driver was killed may be at it still.
        with wait_for_lock(folder / _LOCK), noting_models() as models:
            recover(folder, bundle=True)
            chunk = from_json(Chunk, arguments["chunk"])
            self._evaluator.complete(arguments["task"], folder, chunk)
        return {"models": list(dict.fromkeys(models))}
