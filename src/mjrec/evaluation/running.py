# SPDX-License-Identifier: Apache-2.0
"""Running the missing episodes of a chunk.

Environment and policy stay from chunk to chunk of a task. They are made anew after an
episode that failed, whose environment may be in any state; for each seed where the
environment draws its model from the seed when it is made (`lqr` of dm_control); and for
each episode that is drawn live, because its frames depend on those before.
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
from ..formats.monitor_directory import Infix, journal_name
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
    """An environment and what acts in it.

    Attributes:
        task: the environment's name.
        seed: that it was made with.
        named: the environment.
        policy: acts.
        is_drawn_live: its frames are drawn while it is stepped.
    """

    task: str
    seed: int
    named: NamedEnvironment
    policy: Policy
    is_drawn_live: bool


class Evaluator:
    """Runs chunks, one after the other.

    Args:
        plan: what is evaluated.
        policy: the pickled policy, where it is an object; else None.
    """

    def __init__(self, plan: EvaluationPlan, policy: bytes | None) -> None:
        self._plan = plan
        self._policy = policy
        self._acting: Acting | None = None
        # That of the running episode.
        self.journal: Path | None = None

    @property
    def draws(self) -> bool:
        """Whether any episode may get a video."""
        return not keep_rule(self._plan.keep).keeps_none

    def fits(self, task: str, seed: int, *, continues: bool) -> bool:
        """Return whether environment and policy of before are those of an episode.

        Args:
            task: its environment's name.
            seed: of its run.
            continues: it goes on with the random stream of the episode before.
        """
        known = self._acting
        if known is None or known.task != task:
            return False
        is_of_seed = not known.named.draws_when_made or (
            known.seed == seed and self._plan.protocol != SUITE
        )
        return continues or (is_of_seed and not known.is_drawn_live)

    def acting(self, task: str, seed: int, *, continues: bool = False) -> Acting:
        """Return an environment and what acts in it, those of before where they fit.

        Raises:
            Error: of `environment_from_name`, `load_policy` or `policy_from`.
        """
        if not self.fits(task, seed, continues=continues):
            self.close()
            self._acting = self._make(task, seed)
        assert self._acting is not None
        return self._acting

    def leave(self) -> None:
        """Note that the running episode is not to blame for the end of this process."""
        if self.journal is not None:
            with self.journal.open("ab") as file:
                file.write(b'{"begun": null}\n')

    def close(self) -> None:
        """Close the environment. Idempotent."""
        acting, self._acting = self._acting, None
        if acting is not None:
            acting.named.environment.close()

    def complete(self, task: str, folder: Path, chunk: Chunk) -> None:
        """Run those episodes of a chunk that have not ended.

        Args:
            task: the environment's name.
            folder: the chunk's monitor directory, which no other process writes into,
                and in which what killed ones left is in order.
            chunk: which episodes.

        Raises:
            Error: something cannot be made or recorded. What was done is in the
                journal.
        """
        try:
            _ChunkRun(self, self._plan, task, folder, chunk).run()
        except BaseException:
            # It may be in the midst of a step.
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
            logger.warning("%s: no videos, only results. %s", task, named.not_drawn)
        return Acting(task, seed, named, policy, can_be_drawn and choice.mode == LIVE)

    def _make_policy(self, environment: Any) -> Policy:
        name = self._plan.policy
        if self._policy is None:
            return load_policy(name, environment, self._plan.policy_kwargs)
        try:
            with working_directory_importable():
                # Through our own pipe, from the process that evaluates.
                chosen = pickle.loads(self._policy)
        except Exception as error:
            raise PolicyError(
                f"The policy {name} could not be made again in a worker process: "
                f"{_in_one_line(error)}. Give its name instead, policy='module:name'."
            ) from error
        return policy_from(chosen, name, environment, self._plan.policy_kwargs)


class _ChunkRun:
    """A chunk that is run, and the monitor around its environment."""

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
                    self._monitored(unit).recorder.note_event(
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
        """Run the missing episodes of a seed's random stream.

        Those before them that are done are run again without being recorded: each
        begins where the one before it has ended. After one that failed, another
        stream begins.
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
        """Run an episode, and return whether it was completed.

        Raises:
            Error: it could not be recorded.
        """
        monitor = self._monitored(unit, continues=continues)
        # What was shown before it does not count: other chunks have other episodes.
        monitor.forget_frames()
        episode_id, start = monitor.episode_id, time.time()
        seed, number = unit
        monitor.recorder.note_event("begun", {"seed": seed, "episode": number})
        journal = self._evaluator.journal
        assert journal is not None

        def failed(why: str) -> dict[str, Any]:
            facts = _failed(unit, why, start_time=start, seconds=time.time() - start)
            if monitor.episode_id > episode_id:
                # Else the monitor was never told of it.
                length = monitor.stats_recorder.steps or 0
                facts.update(episode_id=episode_id, length=length)
            return facts

        limit = self._plan.episode_timeout
        too_long = _failed(unit, f"it took longer than {limit or 0:g} seconds")
        acting = self._evaluator.acting(self._task, seed, continues=True)
        try:
            with time_limit(limit, journal, f"{dumps({'failed': too_long})}\n"):
                self._play_recorded(acting, monitor, unit, begin)
        # A policy may call sys.exit(), or an environment's library.
        except (Exception, SystemExit) as error:
            # Errors of ours are of the recording, such as a full disk, unless they
            # speak of an action, or a reward, that is none.
            if isinstance(error, Error) and not isinstance(error, _OF_EPISODES):
                raise
            logger.warning("An episode failed. What was raised:", exc_info=True)
            monitor.recorder.note_error(error)
            monitor.recorder.note_event("failed", failed(_in_one_line(error)))
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
            # Not every reset sets them to zero.
            before.update(_warnings(named.environment))
            return first

        def facts() -> Mapping[str, Any]:
            warnings = new_warnings(before, _warnings(acting.named.environment))
            return {"seed": unit[0], "episode": unit[1], "warnings": warnings}

        monitor.recorder.evaluation_facts = facts
        _play(acting, monitor, episode_seeds(*unit), begin_counting)

    def _monitored(self, unit: Unit, *, continues: bool = False) -> _Monitor:
        """Return the monitor for an episode, that of before where it fits."""
        self._renew_unless_it_fits(unit[0], continues=continues)
        if self._monitor is None:
            acting = self._evaluator.acting(self._task, unit[0], continues=continues)
            plan, named = self._plan, acting.named
            monitor = Monitor(
                named.environment,
                self._folder,
                # Those that cannot be drawn later are all drawn, and the others' videos
                # removed when the choice is made.
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
            # A name is that of one environment, never of a vector environment.
            self._monitor = cast("_Monitor", monitor)
            self._monitor.recorder.bundle_trajectories()
            self._monitor.leave_environment_open()
            self._open.enter_context(self._monitor)
            infix = Infix.parse(self._monitor.infix)
            assert infix is not None
            self._evaluator.journal = self._folder / journal_name(infix)
        return self._monitor

    def _renew_unless_it_fits(self, seed: int, *, continues: bool) -> None:
        if not self._evaluator.fits(self._task, seed, continues=continues):
            self._renew()

    def _renew(self) -> None:
        """Close monitor and environment: the next episode gets others."""
        self._monitor = self._evaluator.journal = None
        self._open.close()
        self._evaluator.close()


def _begin_episode(named: NamedEnvironment, env: Any, seeds: EpisodeSeeds) -> Any:
    return named.begin_episode(env, seeds)


def _begin_in_stream(
    stream: int | None, named: NamedEnvironment, env: Any, seeds: EpisodeSeeds
) -> Any:
    """Begin an episode; `stream` seeds a new stream, None goes on with the last one."""
    return named.begin(env, seeds, stream)


def _play(acting: Acting, env: Any, seeds: EpisodeSeeds, begin: _Begin) -> None:
    """Run an episode in an environment, or in the monitor around it."""
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
    # Not at the top, because it loads MuJoCo, which not every task has.
    from ..simulation.warnings import warning_counts

    return warning_counts(simulation)


def _uid(folder: Path) -> str:
    """Return what a chunk's files have in their names, which no other chunk's have.

    So those of a whole evaluation fit into one directory.
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
    # Ours say what happened; of others the name of the class says half.
    if isinstance(error, Error):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
