# SPDX-License-Identifier: Apache-2.0
"""Running the missing episodes of a chunk.

The environment and the policy are reused for all chunks of a task. They are recreated
in three cases:

- after a failed episode, because the environment may be in any state;
- for each seed, if the environment draws its model from the seed when it is created
  (dm_control's `lqr`);
- for each episode that is drawn live, because its frames would depend on earlier
  episodes.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import pickle
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from ..engines.jobs import TRIES
from ..engines.worker import time_limit
from ..environments.episode_seeds import (
    EpisodeSeeds,
    episode_seeds,
    seed_global_generators,
)
from ..environments.from_name import environment_from_name
from ..environments.named_environment import EnvironmentOptions, NamedEnvironment
from ..environments.names import working_directory_importable
from ..environments.policies import Policy, load_policy, policy_file, policy_from
from ..environments.scenes import new_warnings, simulation_below
from ..errors import Error, InvalidArgument, PolicyError
from ..formats.monitor_directory import journal_name
from ..json_text import dumps
from ..monitors import Monitor
from ..monitors.base import rendering_choice
from ..recorder.keep_rules import keep_rule
from ..recorder.options import LIVE
from ..schedules import record_all
from .chunk_results import read_chunk
from .plan import SUITE, Chunk, EvaluationPlan, Unit

if TYPE_CHECKING:
    from ..monitors.dm_env_monitor import DmEnvMonitor
    from ..monitors.gymnasium_monitor import GymnasiumMonitor

    _Monitor: TypeAlias = GymnasiumMonitor | DmEnvMonitor

logger = logging.getLogger(__name__)

_OF_EPISODES = (PolicyError, InvalidArgument)
_LONGEST_FAILURE = 2000
_LONGEST_UID = 100
_OUTSIDE_UID = re.compile(r"[^A-Za-z0-9_.-]")

_Begin: TypeAlias = Callable[[NamedEnvironment, Any, EpisodeSeeds], Any]


@dataclass(frozen=True)
class Acting:
    """An environment and its policy.

    Attributes:
        task: the environment's name.
        seed: the seed that the environment was created with.
        named: the environment.
        policy: the policy.
        is_drawn_live: whether frames are drawn while the environment is stepped.
    """

    task: str
    seed: int
    named: NamedEnvironment
    policy: Policy
    is_drawn_live: bool


class Evaluator:
    """Runs chunks, one after another.

    Args:
        plan: the plan of the evaluation.
        policy: the pickled policy if the policy is an object, otherwise None.

    Attributes:
        journal: path of the open monitor's journal; None if no monitor is open.
    """

    def __init__(self, plan: EvaluationPlan, policy: bytes | None) -> None:
        self._plan = plan
        self._policy = policy
        self._acting: Acting | None = None
        self.journal: Path | None = None

    @property
    def draws(self) -> bool:
        """Whether any episode may get a video."""
        return not keep_rule(self._plan.keep).keeps_none

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
            known.seed == seed and self._plan.protocol != SUITE
        )
        return continues or (is_of_seed and not known.is_drawn_live)

    def acting(self, task: str, seed: int, *, continues: bool = False) -> Acting:
        """Return an environment and its policy for an episode.

        The current environment and policy are reused if `fits` allows that.

        Raises:
            Error: see `environment_from_name`, `load_policy` and `policy_from`.
        """
        if not self.fits(task, seed, continues=continues):
            self.close()
            self._acting = self._make(task, seed)
        assert self._acting is not None
        return self._acting

    def leave(self) -> None:
        """Record that the running episode is not the reason why this process ends."""
        if self.journal is not None:
            with self.journal.open("ab") as file:
                file.write(b'{"begun": null}\n')

    def close(self) -> None:
        """Close the environment. Idempotent."""
        acting, self._acting = self._acting, None
        if acting is not None:
            acting.named.environment.close()

    def complete(self, task: str, folder: Path, chunk: Chunk) -> None:
        """Run the episodes of a chunk that have no result yet.

        Args:
            task: the environment's name.
            folder: the chunk's monitor directory. No other process may write to it, and
                the recordings of killed processes must have been recovered.
            chunk: the chunk.

        Raises:
            Error: the environment or the policy cannot be created, or an episode cannot
                be recorded. The journal contains the episodes that were finished.
        """
        try:
            _ChunkRun(self, self._plan, task, folder, chunk).run()
        except BaseException:
            # The environment may be in the middle of a step.
            self.close()
            raise
        finally:
            self.journal = None

    def _make(self, task: str, seed: int) -> Acting:
        plan = self._plan
        options = EnvironmentOptions(
            camera=plan.camera,
            height=plan.height,
            width=plan.width,
            max_steps=plan.max_steps,
            frames=self.draws,
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
        can_be_drawn = self.draws and named.not_drawn is None
        if self.draws and not can_be_drawn:
            logger.warning("%s will have no videos. %s", task, named.not_drawn)
        return Acting(task, seed, named, policy, can_be_drawn and choice.mode == LIVE)

    def _make_policy(self, environment: Any) -> Policy:
        name = self._plan.policy
        if self._policy is None:
            return load_policy(name, environment, self._plan.policy_kwargs)
        try:
            with working_directory_importable():
                # The pickle is safe, because the parent sent it through our own pipe.
                chosen = pickle.loads(self._policy)
        except Exception as error:
            raise PolicyError(
                f"The policy {name} could not be recreated in a worker process: "
                f"{_in_one_line(error)}. Pass its name instead (policy='module:name')."
            ) from error
        return policy_from(chosen, name, environment, self._plan.policy_kwargs)


class _ChunkRun:
    """A run of one chunk, with the monitor that wraps the environment."""

    def __init__(
        self,
        evaluator: Evaluator,
        plan: EvaluationPlan,
        task: str,
        folder: Path,
        chunk: Chunk,
    ) -> None:
        self._evaluator = evaluator
        self._plan = plan
        self._task = task
        self._folder = folder
        self._chunk = chunk
        self._known = read_chunk(folder, task)
        self._monitor: _Monitor | None = None
        self._open = contextlib.ExitStack()

    def run(self) -> None:
        results, deaths = self._known.results, self._known.deaths
        missing = [unit for unit in self._chunk if unit not in results]
        with self._open:
            for unit in missing:
                if deaths[unit] >= TRIES:
                    why = f"{TRIES} processes died in it"
                    self._monitored(unit).recorder.run.note(
                        "failed", _failed(unit, why)
                    )
            missing = [unit for unit in missing if deaths[unit] < TRIES]
            if self._plan.protocol == SUITE:
                for seed in dict.fromkeys(seed for seed, _ in missing):
                    self._run_stream(seed, {n for s, n in missing if s == seed})
            else:
                for unit in missing:
                    self._run(unit, _begin_episode)

    def _run_stream(self, seed: int, missing: set[int]) -> None:
        """Run the missing episodes of a seed that share a random stream.

        The stream continues from one episode to the next. Finished episodes that come
        before a missing one therefore run again, but without being recorded. After a
        failed episode a new stream begins.
        """
        stream: int | None = seed
        for number in range(self._chunk.first, max(missing) + 1):
            unit, continues = (seed, number), number > self._chunk.first
            begin = functools.partial(_begin_in_stream, stream)
            known = self._known.results.get(unit)
            if number in missing:
                is_complete = self._run(unit, begin, continues=continues)
            elif is_complete := known is not None and known.failure is None:
                self._renew_unless_it_fits(seed, continues=continues)
                acting = self._evaluator.acting(self._task, seed, continues=continues)
                _play(acting, acting.named.environment, episode_seeds(*unit), begin)
            else:
                self._renew()
            following = episode_seeds(seed, number + 1)
            stream = None if is_complete else following.environment

    def _run(self, unit: Unit, begin: _Begin, *, continues: bool = False) -> bool:
        """Run an episode and return whether it was completed.

        Raises:
            Error: the episode could not be recorded.
        """
        monitor = self._monitored(unit, continues=continues)
        # Frames must not depend on earlier episodes, which differ from chunk to chunk.
        monitor.forget_frames()
        episode_id, start = monitor.episode_id, time.time()
        seed, number = unit
        monitor.recorder.run.note("begun", {"seed": seed, "episode": number})
        journal = self._evaluator.journal
        assert journal is not None

        def failed(why: str) -> dict[str, Any]:
            facts = _failed(unit, why, start_time=start, seconds=time.time() - start)
            if monitor.episode_id > episode_id:
                # Otherwise the monitor does not know the episode.
                length = monitor.stats_recorder.steps or 0
                facts.update(episode_id=episode_id, length=length)
            return facts

        limit = self._plan.episode_timeout
        too_long = _failed(unit, f"it took longer than {limit or 0:g} seconds")
        acting = self._evaluator.acting(self._task, seed, continues=True)
        try:
            with time_limit(limit, journal, f"{dumps({'failed': too_long})}\n"):
                self._play_recorded(acting, monitor, unit, begin)
        # A policy or an environment's library may call sys.exit().
        except (Exception, SystemExit) as error:
            # Our own errors are about the recording, such as a full disk, unless they
            # are about an invalid action or reward.
            if isinstance(error, Error) and not isinstance(error, _OF_EPISODES):
                raise
            logger.warning("An episode failed with this error:", exc_info=True)
            monitor.recorder.note_error(error)
            monitor.recorder.run.note("failed", failed(_in_one_line(error)))
            self._renew()
            return False
        return True

    def _play_recorded(
        self, acting: Acting, monitor: _Monitor, unit: Unit, begin: _Begin
    ) -> None:
        before: dict[str, int] = {}

        def begin_counting(
            named: NamedEnvironment, env: Any, seeds: EpisodeSeeds
        ) -> Any:
            first = begin(named, env, seeds)
            # Not every reset clears the warning counts.
            before.update(_warnings(named.environment))
            return first

        def facts() -> Mapping[str, Any]:
            warnings = new_warnings(before, _warnings(acting.named.environment))
            return {"seed": unit[0], "episode": unit[1], "warnings": warnings}

        monitor.recorder.evaluation_facts = facts
        _play(acting, monitor, episode_seeds(*unit), begin_counting)

    def _monitored(self, unit: Unit, *, continues: bool = False) -> _Monitor:
        """Return a monitor for an episode, which may be the current monitor."""
        self._renew_unless_it_fits(unit[0], continues=continues)
        if self._monitor is None:
            acting = self._evaluator.acting(self._task, unit[0], continues=continues)
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
            self._evaluator.journal = self._folder / journal_name(self._monitor.infix)
        return self._monitor

    def _renew_unless_it_fits(self, seed: int, *, continues: bool) -> None:
        if not self._evaluator.fits(self._task, seed, continues=continues):
            self._renew()

    def _renew(self) -> None:
        """Close the monitor and the environment, so that both are created anew."""
        self._monitor = self._evaluator.journal = None
        self._open.close()
        self._evaluator.close()


def _begin_episode(named: NamedEnvironment, env: Any, seeds: EpisodeSeeds) -> Any:
    return named.begin_episode(env, seeds)


def _begin_in_stream(
    stream: int | None, named: NamedEnvironment, env: Any, seeds: EpisodeSeeds
) -> Any:
    """Begin an episode in a new random stream, or in the current one.

    `stream` is the seed of the new stream. If it is None, the current stream continues.
    """
    return named.begin(env, seeds, stream)


def _play(acting: Acting, env: Any, seeds: EpisodeSeeds, begin: _Begin) -> None:
    """Run an episode in an environment or in the monitor that wraps it."""
    named, policy = acting.named, acting.policy
    with working_directory_importable():
        seed_global_generators(seeds.policy)
        policy.reset(seeds)
        observation, done = begin(named, env, seeds), False
        while not done:
            observation, _, *ends = named.step(env, policy(observation))
            done = any(ends)


def _warnings(environment: Any) -> dict[str, int]:
    simulation = simulation_below(environment)
    if simulation is None:
        return {}
    # Imported here because it loads MuJoCo, which some tasks do not need.
    from ..simulation.warnings import warning_counts

    return warning_counts(simulation)


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
