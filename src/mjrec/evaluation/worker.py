# SPDX-License-Identifier: Apache-2.0
"""An evaluation's worker process, which runs the missing episodes in chunks.

The settings are `{"directory": DIR, "plan": <the plan as JSON, without its chunks>}`.
If the policy is an object, `"payload"` is the path of the file with the pickled policy.
If `"chooses_gl"` is true and episodes get videos, the worker chooses an OpenGL backend
that works on its machine. `"command"` is the command line to store in recordings.

There are two kinds of jobs, and repeating a job is safe.

`check`  Creates the environment and the policy without taking a step. The arguments are
         `{"task"}`. Returns `{"step_limit", "velocities", "sources"}`, where
         `velocities` is the number of degrees of freedom (0 without MuJoCo), and
         `sources` is as in the plan. If creation fails, returns `{"error": ...}`
         instead, packed by `messages.carried`. The caller can then raise the same
         error, and no traceback is logged.
`run`    Runs the missing episodes of a chunk. The arguments are `{"task", "folder",
         "chunk"}`. Returns `{"models": [...]}` with the SHA-256 of each compiled model
         that the worker has stored.

The environment and the policy are reused for all chunks of a task. They are recreated
in three cases:

- after a failed episode, because the environment's state is unknown;
- for each seed, if the environment draws its model from the seed when it is created
  (dm_control's `lqr`);
- for each episode that is drawn live, because its frames would depend on earlier
  episodes.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import pickle
import re
import sys
import sysconfig
import time
import warnings
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from .. import provenance
from ..atomic_files import file_sha256, make_directory
from ..engines.jobs import TRIES
from ..engines.worker import time_limit
from ..environments.episode_seeds import episode_seeds, seed_global_generators
from ..environments.from_name import environment_from_name
from ..environments.named_environment import EnvironmentOptions, NamedEnvironment
from ..environments.names import parse_environment_name, working_directory_importable
from ..environments.policies import Policy, load_policy, policy_file, policy_from
from ..environments.scenes import mujoco_warnings, new_warnings, simulation_below
from ..errors import Error, GLError, InvalidArgument, PolicyError
from ..formats.json_fields import from_json
from ..formats.locks import wait_for_lock
from ..formats.monitor_directory import journal_name
from ..gl.choice import use_gl
from ..json_text import dumps
from ..messages import carried
from ..monitors import Monitor
from ..monitors.base import rendering_choice
from ..recorder.keep_rules import keep_rule
from ..recorder.options import LIVE
from ..rendering.recovery import recover
from ..schedules import record_all
from ..simulation.model_trust import noting_models
from .episode_results import read_chunk
from .plan import NO_GL, SUITE, Chunk, EvaluationPlan, Unit

if TYPE_CHECKING:
    from ..monitors.dm_env_monitor import DmEnvMonitor
    from ..monitors.gymnasium_monitor import GymnasiumMonitor

    _Monitor: TypeAlias = GymnasiumMonitor | DmEnvMonitor

logger = logging.getLogger(__name__)

_LOCK = ".mjrec.chunk.lock"
_OF_EPISODES = (PolicyError, InvalidArgument)
_LONGEST_FAILURE = 2000
_LONGEST_UID = 100
_MJREC = __name__.partition(".")[0]
_INSTALLED = {sysconfig.get_path("stdlib"), "site-packages", "dist-packages"}
_OUTSIDE_UID = re.compile(r"[^A-Za-z0-9_.-]")


@dataclass(frozen=True)
class Acting:
    """An environment and its policy.

    Attributes:
        task: the environment's name.
        seed: the seed used to create the environment.
        named: the environment.
        policy: the policy.
        is_drawn_live: whether frames are drawn while the environment is stepped.
    """

    task: str
    seed: int
    named: NamedEnvironment
    policy: Policy
    is_drawn_live: bool


class EvaluationWorker:
    """A handler for `engines.jobs` that runs an evaluation's jobs.

    Args:
        settings: the settings, as described in the module docstring.

    Attributes:
        plan: the plan of the evaluation, without its chunks.
        journal: path of the open monitor's journal; None if no monitor is open.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._own_modules = {*sys.modules}
        self._directory = Path(settings["directory"])
        self.plan = from_json(EvaluationPlan, settings["plan"])
        # A reader of the recordings needs the command that started the evaluation.
        provenance.command = settings.get("command", provenance.command)
        policy = settings.get("payload")
        self._policy = None if policy is None else Path(policy).read_bytes()
        self._draws = not keep_rule(self.plan.keep).keeps_none
        self._acting: Acting | None = None
        self.journal: Path | None = None
        # If dm_control finds no other backend, it tries GLFW, which warns about a
        # missing display on a headless machine. If that matters, drawing will fail.
        warnings.filterwarnings("ignore", message=r"\(65550\) b'X11")
        if settings.get("chooses_gl") and self._draws:
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
            Error: the job failed. A check returns the error instead of raising it. The
                journal contains the episodes that were finished.
        """
        task = arguments["task"]
        if arguments["kind"] == "check":
            return self._check(task)
        folder = self._directory / arguments["folder"]
        make_directory(folder)
        # If an earlier evaluation was killed, its workers may still be running.
        with wait_for_lock(folder / _LOCK), noting_models() as models:
            recover(folder, bundle=True)
            try:
                _ChunkRun(
                    self, task, folder, from_json(Chunk, arguments["chunk"])
                ).run()
            except BaseException:
                # The environment may be in the middle of a step.
                self.close()
                raise
            finally:
                self.journal = None
        return {"models": list(dict.fromkeys(models))}

    def leave(self) -> None:
        """Record that the running episode did not cause this process to end."""
        if self.journal is not None:
            with self.journal.open("ab") as file:
                file.write(b'{"begun": null}\n')

    def close(self) -> None:
        """Close the environment. Idempotent."""
        acting, self._acting = self._acting, None
        if acting is not None:
            acting.named.environment.close()

    def fits(self, task: str, seed: int, *, continues: bool) -> bool:
        """Return whether the current environment and policy can run an episode.

        Args:
            task: the episode's environment name.
            seed: the seed of the episode's run.
            continues: whether the episode continues the previous episode's random
                stream.
        """
        known = self._acting
        if known is None or known.task != task:
            return False
        is_of_seed = not known.named.draws_when_made or (
            known.seed == seed and self.plan.protocol != SUITE
        )
        return continues or (is_of_seed and not known.is_drawn_live)

    def acting(self, task: str, seed: int) -> Acting:
        """Return the environment and the policy, creating them if necessary.

        Raises:
            Error: see `environment_from_name`, `load_policy` and `policy_from`.
        """
        if self._acting is None:
            self._acting = self._make(task, seed)
        return self._acting

    def _check(self, task: str) -> dict[str, Any]:
        try:
            if not self.fits(task, self.plan.seeds[0], continues=False):
                self.close()
            named = self.acting(task, self.plan.seeds[0]).named
        except Error as error:
            return {"error": carried(error)}
        simulation = simulation_below(named.environment)
        sources = _imported(self._own_modules)
        if parse_environment_name(task).framework == "mjcf":
            # Imported here because it loads MuJoCo.
            from ..simulation.model_store import saved_model

            model = hashlib.sha256(saved_model(simulation.model).data).hexdigest()
            sources[f"model of {task}"] = model
        return {
            "step_limit": named.step_limit,
            "velocities": 0 if simulation is None else int(simulation.model.nv),
            "sources": sources,
        }

    def _make(self, task: str, seed: int) -> Acting:
        plan = self.plan
        options = EnvironmentOptions(
            camera=plan.camera,
            height=plan.height,
            width=plan.width,
            max_steps=plan.max_steps,
            frames=self._draws,
            seed=seed,
            kwargs=plan.env_kwargs,
        )
        named = environment_from_name(task, options)
        try:
            policy = self._make_policy(named.environment)
            choice = rendering_choice(None, named.scenes(), named.env_id)
        except BaseException:
            named.environment.close()
            raise
        can_be_drawn = self._draws and named.not_drawn is None
        if self._draws and not can_be_drawn:
            logger.warning("%s will have no videos. %s", task, named.not_drawn)
        return Acting(task, seed, named, policy, can_be_drawn and choice.mode == LIVE)

    def _make_policy(self, environment: Any) -> Policy:
        name = self.plan.policy
        if self._policy is None:
            return load_policy(name, environment, self.plan.policy_kwargs)
        try:
            with working_directory_importable():
                # The pickle is safe, because the parent sent it through our own pipe.
                chosen = pickle.loads(self._policy)
        except Exception as error:
            raise PolicyError(
                f"The policy {name} could not be recreated in a worker process: "
                f"{_in_one_line(error)}. Pass its name instead (policy='module:name')."
            ) from error
        return policy_from(chosen, name, environment, self.plan.policy_kwargs)


class _ChunkRun:
    """A run of one chunk, with the monitor that wraps the environment."""

    def __init__(
        self, worker: EvaluationWorker, task: str, folder: Path, chunk: Chunk
    ) -> None:
        self._worker = worker
        self._plan = worker.plan
        self._task = task
        self._folder = folder
        self._chunk = chunk
        self._known = read_chunk(folder, task)
        self._monitor: _Monitor | None = None
        self._open = contextlib.ExitStack()

    def run(self) -> None:
        """Run the episodes that have no results yet.

        No other process may write to the folder, and the recordings of killed processes
        must have been recovered.
        """
        results, deaths = self._known.results, self._known.deaths
        missing = [unit for unit in self._chunk if unit not in results]
        with self._open:
            for unit in missing:
                if deaths[unit] >= TRIES:
                    why = f"{TRIES} processes died while running it"
                    self._monitored(unit).recorder.run.note(
                        "failed", _failed(unit, why)
                    )
            missing = [unit for unit in missing if deaths[unit] < TRIES]
            if self._plan.protocol == SUITE:
                for seed in dict.fromkeys(seed for seed, _ in missing):
                    self._run_stream(seed, {n for s, n in missing if s == seed})
            else:
                for unit in missing:
                    self._run(unit, episode_seeds(*unit).environment)

    def _run_stream(self, seed: int, missing: set[int]) -> None:
        """Run the missing episodes of a seed that share a random stream.

        The stream continues from one episode to the next. Finished episodes that
        precede a missing one are therefore rerun, but not recorded. After a failed
        episode, a new stream begins.
        """
        stream: int | None = seed
        for number in range(self._chunk.first, max(missing) + 1):
            unit, continues = (seed, number), number > self._chunk.first
            known = self._known.results.get(unit)
            if number in missing:
                is_complete = self._run(unit, stream, continues=continues)
            elif is_complete := known is not None and known.failure is None:
                acting = self._acting(unit, continues=continues)
                _play(acting, acting.named.environment, unit, stream)
            else:
                self._renew()
            following = episode_seeds(seed, number + 1)
            stream = None if is_complete else following.environment

    def _run(self, unit: Unit, stream: int | None, *, continues: bool = False) -> bool:
        """Run an episode and return whether it was completed.

        Args:
            unit: the episode.
            stream: the seed of a new random stream; None to continue the current one.
            continues: see `EvaluationWorker.fits`.

        Raises:
            Error: the episode could not be recorded.
        """
        monitor = self._monitored(unit, continues=continues)
        # Frames must not depend on earlier episodes, which differ from chunk to chunk.
        monitor.forget_frames()
        episode_id, start = monitor.episode_id, time.time()
        own = {"seed": unit[0], "episode": unit[1]}
        monitor.recorder.run.note("begun", own)
        acting, journal = self._worker.acting(self._task, unit[0]), self._worker.journal
        assert journal is not None
        before: dict[str, int] = {}

        def count_warnings() -> None:
            # Some resets do not clear the warning counts.
            before.update(mujoco_warnings(acting.named.environment))

        def facts() -> Mapping[str, Any]:
            new = new_warnings(before, acting.named.environment)
            return {**own, "warnings": new}

        monitor.recorder.evaluation_facts = facts
        limit = self._plan.episode_timeout
        too_long = _failed(unit, f"it took longer than {limit or 0:g} seconds")
        try:
            with time_limit(limit, journal, f"{dumps({'failed': too_long})}\n"):
                _play(acting, monitor, unit, stream, on_begin=count_warnings)
        # A policy or an environment's library may call sys.exit().
        except (Exception, SystemExit) as error:
            # Our own errors concern the recording, such as a full disk, unless they
            # concern an invalid action or reward.
            if isinstance(error, Error) and not isinstance(error, _OF_EPISODES):
                raise
            logger.warning("An episode failed with this error:", exc_info=True)
            monitor.recorder.note_error(error)
            times = {"start_time": start, "seconds": time.time() - start}
            failed = _failed(unit, _in_one_line(error), **times)
            if monitor.episode_id > episode_id:
                # Otherwise the episode is unknown to the monitor.
                length = monitor.stats_recorder.steps or 0
                failed.update(episode_id=episode_id, length=length)
            monitor.recorder.run.note("failed", failed)
            self._renew()
            return False
        return True

    def _acting(self, unit: Unit, *, continues: bool = False) -> Acting:
        """Return an episode's environment and policy, creating them if necessary."""
        if not self._worker.fits(self._task, unit[0], continues=continues):
            self._renew()
        return self._worker.acting(self._task, unit[0])

    def _monitored(self, unit: Unit, *, continues: bool = False) -> _Monitor:
        """Return a monitor for an episode, which may be the current monitor."""
        acting = self._acting(unit, continues=continues)
        if self._monitor is None:
            plan, named = self._plan, acting.named
            monitor = Monitor(
                named.environment,
                self._folder,
                # If episodes cannot be drawn later, all of them are drawn live, and the
                # videos that are not chosen are deleted afterwards.
                record_all if acting.is_drawn_live else False,
                resume=True,
                uid=_uid(self._folder),
                mode="evaluation",
                max_fps=plan.max_fps,
                quality=plan.quality,
                workers=0,
                env_id=named.env_id,
                policy_file=None if plan.is_object else policy_file(plan.policy),
                **named.view,
            )
            # A name always means a single environment, never a vector environment.
            self._monitor = cast("_Monitor", monitor)
            self._monitor.recorder.bundle_trajectories()
            self._monitor.leave_environment_open()
            self._open.enter_context(self._monitor)
            self._worker.journal = self._folder / journal_name(self._monitor.infix)
        return self._monitor

    def _renew(self) -> None:
        """Close the monitor and the environment, so that both will be recreated."""
        self._monitor = self._worker.journal = None
        self._open.close()
        self._worker.close()


def _play(
    acting: Acting,
    env: Any,
    unit: Unit,
    stream: int | None,
    *,
    on_begin: Callable[[], None] = lambda: None,
) -> None:
    """Run an episode in an environment or in the monitor that wraps it."""
    named, policy, seeds = acting.named, acting.policy, episode_seeds(*unit)
    with working_directory_importable():
        seed_global_generators(seeds.policy)
        policy.reset(seeds)
        observation, done = named.begin(env, seeds, stream), False
        on_begin()
        while not done:
            observation, _, *ends = named.step(env, policy(observation))
            done = any(ends)


def _imported(ignored: AbstractSet[str]) -> dict[str, str]:
    """Return the SHA-256 of each imported module, without installed packages."""
    found = {}
    for name, module in [*sys.modules.items()]:
        # Read in this way because a lazy module would run code.
        file = vars(module).get("__file__") if isinstance(module, ModuleType) else None
        if (
            isinstance(file, str)
            and name not in ignored
            and not name.startswith(f"{_MJREC}.")
            and not _INSTALLED & {*map(str, Path(file).parents), *Path(file).parts}
        ):
            with contextlib.suppress(OSError):
                found[f"module {name}"] = file_sha256(Path(file))
    return found


def _uid(folder: Path) -> str:
    """Return a string that identifies a chunk in file names.

    It is unique, so the files of a whole evaluation can be moved to one directory.
    """
    room = _LONGEST_UID - len(folder.name) - 1
    task = _OUTSIDE_UID.sub("_", folder.parent.name)[:room].lstrip(".")
    return f"{task}-{folder.name}"


def _failed(unit: Unit, why: str, **facts: Any) -> dict[str, Any]:
    return {
        "seed": unit[0],
        "episode": unit[1],
        "episode_id": None,
        "failure": why[:_LONGEST_FAILURE],
        "length": 0,
        "start_time": None,
        "seconds": None,
        **facts,
    }


def _in_one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    # Our own messages are complete. Other messages are unclear without the class name.
    if isinstance(error, Error):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
