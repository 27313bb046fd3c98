# SPDX-License-Identifier: Apache-2.0
"""What a worker process of an evaluation does.

Settings: `{"directory": DIR, "plan": <the plan as JSON, without its chunks>}`;
`"policy"`, the file with the pickled policy, where that is an object; `"chooses_gl":
true` where the worker is to choose an OpenGL backend that works on its machine, if
episodes get videos; and `"models"` as in `rendering.engine_jobs`. Jobs, by their
`kind`; doing one again is harmless:

`check`  `{"task"}`: makes the environment and the policy, and takes no step. Returns
         `{"env_id", "step_limit", "velocities"}`, the last one the number of degrees
         of freedom (0 without MuJoCo), or `{"error": ...}` where they cannot be made:
         as `child_python.carried` packs it, so that it comes home as what it is, and
         leaves no traceback in the log.
`run`    `{"task", "folder", "chunk"}`: runs the missing episodes of a chunk. Returns
         `{"models": [sha256 of compiled ones that it has stored, ...]}`.
`draw`   `{"folder", "recording", "models"}`: finishes a recording, see
         `rendering.engine_jobs`, with models that other workers may have stored.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import DirectoryNotWritable, Error, GLError
from ..formats.locks import wait_for_lock
from ..gl import use_gl
from ..messages import carried
from ..rendering.recovery import recover
from ..simulation.find_simulation import simulation_in
from ..simulation.model_trust import note_models, noting_models
from .dataclass_json import from_json
from .plan import Chunk, EvaluationPlan
from .running import Evaluator

if TYPE_CHECKING:
    from ..rendering.engine_jobs import VideoWorker

_GL = "MUJOCO_GL"
_LOCK = ".mjrec.chunk.lock"


class EvaluationWorker:
    """Does the jobs of an evaluation; a handler of `engines.jobs`.

    Args:
        settings: see the module.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._directory = Path(settings["directory"])
        self._plan = from_json(EvaluationPlan, settings["plan"])
        policy = settings.get("policy")
        self._evaluator = Evaluator(
            self._plan, None if policy is None else Path(policy).read_bytes()
        )
        self._videos: VideoWorker | None = None
        note_models(settings.get("models", ()))
        # dm_control tries GLFW where no other backend was found, and complains of the
        # display that a machine without a screen has not got. Where that matters,
        # drawing says so.
        warnings.filterwarnings("ignore", message=r"\(65550\) b'X11")
        chooses_gl = settings.get("chooses_gl") and _GL not in os.environ
        if chooses_gl and self._evaluator.draws:
            # What cannot be drawn says so when its turn comes.
            with contextlib.suppress(GLError):
                use_gl()

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do a job.

        Raises:
            Error: of what the job is about, unless it is a check.
        """
        match arguments["kind"]:
            case "check":
                return self._check(arguments["task"])
            case "run":
                return self._run(arguments)
            case _:
                return self._draw(arguments)

    def close(self) -> None:
        """End what runs and draws."""
        self._evaluator.close()
        if self._videos is not None:
            self._videos.close()

    def _check(self, task: str) -> dict[str, Any]:
        try:
            named = self._evaluator.acting(task, self._plan.seeds[0]).named
        except Error as error:
            return {"error": carried(error)}
        simulation = simulation_in(named.environment)
        return {
            "env_id": named.env_id,
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
            recover(folder)
            chunk = from_json(Chunk, arguments["chunk"])
            self._evaluator.complete(arguments["task"], folder, chunk)
        return {"models": list(dict.fromkeys(models))}

    def _draw(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        # It loads HDF5 and more, for which stepping has no use.
        from ..rendering.engine_jobs import VideoWorker
        from ..rendering.jobs import VideoJob

        note_models(arguments["models"])
        if self._videos is None:
            self._videos = VideoWorker()
        job = VideoJob(
            directory=self._directory / arguments["folder"],
            recording=arguments["recording"],
        )
        return dict(self._videos(job.as_json()))
