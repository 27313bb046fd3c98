# SPDX-License-Identifier: Apache-2.0
"""What a worker process of an evaluation does.

Settings: `{"directory": DIR, "plan": <the plan as JSON>}`, and `"chooses_gl": true`
where the worker is to choose an OpenGL backend that works on its machine, if episodes
get videos, and `"models"` as in `rendering.engine_jobs`; payload: the pickled policy,
where it is an object. Jobs, by their `kind`, each of which may be done again:

`check`    `{"task"}`: makes the environment and the policy, and takes no step. Returns
           `{"env_id", "step_limit", "deferrable", "reason", "velocities"}`, the last
           one the number of degrees of freedom (0 without MuJoCo), or `{"error": ...}`
           where they cannot be: as `child_python.carried` packs it, so that it comes
           home as what it is, and leaves no traceback in the log.
`run`      `{"task", "folder", "seed", "episodes"}`: runs the episodes of a batch; where
           somebody has begun it before, those that no ledger has. Returns
           `{"episodes": how many it ran, "models": [sha256 of compiled ones, ...]}`,
           the models that it has stored.
`recover`  `{"folder"}`: puts in order what killed workers left. Returns
           `{"monitors": infixes of those that are left to settle}`.
`settle`   `{"folder", "monitor", "chosen": [[number, facts], ...]}`, see `settling`.
           Returns `{}`.
`draw`     `{"folder", "recording", "models"}`: finishes a recording, see
           `rendering.engine_jobs`, with models that other workers may have stored.
"""

from __future__ import annotations

import contextlib
import logging
import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..engines.worker import AGAIN
from ..errors import Error, GLError
from ..gl import use_gl
from ..messages import carried
from ..recorder.options import DEFERRED
from ..simulation.find_simulation import simulation_in
from ..simulation.model_trust import note_models, noting_models
from .dataclass_json import from_json
from .plan import Batch, EvaluationPlan
from .running import Evaluation, make_acting, rendering_of, run_batch

if TYPE_CHECKING:
    from ..rendering.engine_jobs import VideoWorker

logger = logging.getLogger(__name__)

_GL = "MUJOCO_GL"


class EvaluationWorker:
    """Does the jobs of an evaluation; a handler of `engines.jobs`.

    Args:
        settings: see the module.
        payload: likewise.
    """

    def __init__(self, settings: Mapping[str, Any], payload: bytes | None) -> None:
        self._evaluation = Evaluation(
            directory=Path(settings["directory"]),
            plan=from_json(EvaluationPlan, settings["plan"]),
            policy=payload,
        )
        self._by_kind: Mapping[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
            "check": self._check,
            "run": self._run,
            "recover": self._recover,
            "settle": self._settle,
            "draw": self._draw,
        }
        self._videos: VideoWorker | None = None
        note_models(settings.get("models", ()))
        # dm_control tries GLFW where no other backend was found, and complains of the
        # display that a machine without a screen has not got. Where that matters,
        # drawing says so.
        warnings.filterwarnings("ignore", message=r"\(65550\) b'X11")
        if settings.get("chooses_gl") and self._evaluation.draws:
            _choose_gl()

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do a job.

        Raises:
            Error: of what the job is about, unless it is a check.
        """
        return self._by_kind[arguments["kind"]](arguments)

    def close(self) -> None:
        """End what draws."""
        if self._videos is not None:
            self._videos.close()

    def _check(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        try:
            return self._checked(arguments)
        except Error as error:
            return {"error": carried(error)}

    def _checked(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        seed = self._evaluation.plan.seeds[0]
        named = make_acting(self._evaluation, arguments["task"], seed).named
        with contextlib.closing(named.environment):
            choice = rendering_of(named) if self._evaluation.draws else None
        return {
            "env_id": named.env_id,
            "step_limit": named.step_limit,
            "deferrable": choice is None or choice.mode == DEFERRED,
            "reason": None if choice is None else choice.reason,
            "velocities": _velocities(named.environment),
        }

    def _run(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        batch = Batch(
            task=arguments["task"],
            folder=arguments["folder"],
            seed=arguments["seed"],
            episodes=tuple(arguments["episodes"]),
        )
        again = bool(arguments.get(AGAIN, False))
        with noting_models() as models:
            episodes = run_batch(self._evaluation, batch, again=again)
        return {"episodes": episodes, "models": list(dict.fromkeys(models))}

    # What is imported below loads HDF5, which stepping has no use for.

    def _recover(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        from ..rendering.recovery import recover
        from .settling import unsettled_monitors

        folder = self._folder(arguments)
        if not folder.is_dir():
            return {"monitors": []}
        recovery = recover(folder)
        if recovery.failures:
            logger.warning("%s", recovery)
        return {"monitors": unsettled_monitors(folder)}

    def _settle(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        from .settling import settle_monitor

        settle_monitor(
            self._folder(arguments),
            arguments["monitor"],
            dict(arguments["chosen"]),
            rule=self._evaluation.plan.keep,
        )
        return {}

    def _draw(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        from ..rendering.engine_jobs import VideoWorker
        from ..rendering.jobs import VideoJob

        note_models(arguments["models"])
        if self._videos is None:
            self._videos = VideoWorker()
        folder, recording = self._folder(arguments), arguments["recording"]
        job = VideoJob(directory=folder, recording=recording)
        return dict(self._videos(job.as_json()))

    def _folder(self, arguments: Mapping[str, Any]) -> Path:
        return self._evaluation.directory / str(arguments["folder"])


def _choose_gl() -> None:
    if _GL not in os.environ:
        # What cannot be drawn says so when its turn comes.
        with contextlib.suppress(GLError):
            use_gl()


def _velocities(environment: Any) -> int:
    simulation = simulation_in(environment)
    return 0 if simulation is None else int(simulation.model.nv)
