# SPDX-License-Identifier: Apache-2.0
"""Running a batch of episodes: one environment, policy and monitor for all of them.

Where an episode fails, all three are closed and made anew for the rest: nobody knows
what state an environment is in that has raised.
"""

from __future__ import annotations

import contextlib
import dataclasses
import pickle
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from ..environments.episode_seeds import (
    EpisodeSeeds,
    episode_seeds,
    seed_global_generators,
)
from ..environments.from_name import environment_from_name
from ..environments.named_environment import EnvironmentOptions, NamedEnvironment
from ..environments.names import working_directory_importable
from ..environments.policies import Policy, load_policy, policy_file, policy_from
from ..errors import Error, InvalidArgument, PolicyError
from ..monitors import Monitor
from ..monitors.base import rendering_choice
from ..recorder.keep_rules import UNDECIDED
from ..recorder.opening import JOIN
from ..recorder.options import DEFERRED, RenderingChoice
from ..recorder.tracking import FinishedEpisode, Run, Tracker
from ..schedules import schedule_from_text
from ..signals import Terminated
from ..simulation.find_simulation import simulation_in
from .episode_results import EpisodeResult
from .kept_episodes import keep_rule
from .ledger import Ledger, ledger_name, read_ledgers
from .plan import SUITE, Batch, EvaluationPlan

if TYPE_CHECKING:
    from ..monitors.dm_env_monitor import DmEnvMonitor
    from ..monitors.gymnasium_monitor import GymnasiumMonitor

_OF_EPISODES = (PolicyError, InvalidArgument)

_Begin: TypeAlias = Callable[[Any, EpisodeSeeds], Any]


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What a worker knows of the evaluation that it works for.

    Attributes:
        directory: of the evaluation.
        plan: what is evaluated.
        policy: the pickled policy, where it is an object; else None.
    """

    directory: Path
    plan: EvaluationPlan
    policy: bytes | None = None

    @property
    def draws(self) -> bool:
        """Whether any episode may get a video."""
        return not keep_rule(self.plan.keep).keeps_none


@dataclass(frozen=True)
class Acting:
    """An environment and who acts in it."""

    named: NamedEnvironment
    policy: Policy


def make_acting(evaluation: Evaluation, task: str, seed: int) -> Acting:
    """Return an environment and who acts in it; the environment is to be closed.

    Args:
        evaluation: what is evaluated.
        task: the environment's name.
        seed: of the run.

    Raises:
        Error: of `environment_from_name`, `load_policy` or `policy_from`.
    """
    plan = evaluation.plan
    named = environment_from_name(
        task,
        EnvironmentOptions(
            camera=plan.camera,
            height=plan.height,
            width=plan.width,
            max_steps=plan.max_steps,
            pictures=evaluation.draws,
            seed=seed,
            kwargs=plan.env_kwargs,
        ),
    )
    if "mujoco" in sys.modules:
        # Not at the top, because it loads MuJoCo, which not every task has.
        from ..simulation.warnings import log_mujoco_warnings

        log_mujoco_warnings()
    with _closing_on_error(named.environment):
        return Acting(named, _policy(evaluation, named.environment))


def rendering_of(named: NamedEnvironment) -> RenderingChoice:
    """Return when a monitor will draw the pictures of an environment, and why."""
    return rendering_choice(None, named.scenes(), named.env_id)


def run_batch(evaluation: Evaluation, batch: Batch, *, again: bool) -> int:
    """Run the episodes of a batch, and return how many they were.

    Args:
        evaluation: what is evaluated.
        batch: of which none is in any ledger, unless it is begun again.
        again: whether somebody has begun it before: then those that are in a ledger
            are left out. Looking for that takes the longer the more have recorded.

    Raises:
        Error: something could not be recorded; what was done is in the ledger.
    """
    whole = evaluation.plan.protocol == SUITE
    done = read_ledgers(evaluation.directory / batch.folder) if again else {}
    left = [n for n in batch.episodes if (batch.seed, n) not in done]
    if left:
        left_of_it = dataclasses.replace(batch, episodes=tuple(left))
        _BatchRun(evaluation, left_of_it, whole=whole).run()
    return len(left)


class _LastEpisode(Tracker):
    """Keeps what a monitor says of its last complete episode."""

    finished: FinishedEpisode

    def episode(self, run: Run, episode: FinishedEpisode) -> None:
        """Keep it."""
        self.finished = episode


class _Running:
    """An episode that has begun, as far as its result is known.

    Args:
        known: what is.
    """

    def __init__(self, known: EpisodeResult) -> None:
        self.known = known
        self._start = time.monotonic()

    def seconds(self) -> float:
        """Return for how long it has been running."""
        return time.monotonic() - self._start

    def failed(
        self, monitor: GymnasiumMonitor | DmEnvMonitor, error: BaseException
    ) -> EpisodeResult:
        """Return its result where it failed, in whatever: the reset, too."""
        failed = dataclasses.replace(
            self.known, failure=_in_one_line(error), seconds=self.seconds()
        )
        if monitor.episode_id == self.known.episode_id:
            # The monitor was never told of it.
            return dataclasses.replace(failed, monitor=None, episode_id=None)
        return dataclasses.replace(failed, length=monitor.stats_recorder.steps or 0)


@dataclass(frozen=True)
class _Recorded:
    """What runs episodes, and what records them.

    Attributes:
        acting: the environment and who acts in it.
        monitor: around the environment.
        last: what the monitor says of its last complete episode.
        is_left_open: whether videos are chosen later, among candidates.
    """

    acting: Acting
    monitor: GymnasiumMonitor | DmEnvMonitor
    last: _LastEpisode
    is_left_open: bool


class _BatchRun:
    """A batch that is run."""

    def __init__(self, evaluation: Evaluation, batch: Batch, *, whole: bool) -> None:
        self._evaluation = evaluation
        self._batch = batch
        self._whole = whole
        self._folder = evaluation.directory / batch.folder
        self._ledger: Ledger | None = None
        # The number of the episode that is run, also before it has begun.
        self._episode = 0
        self._running: _Running | None = None

    def run(self) -> None:
        """Run its episodes, however each of them ends."""
        left = list(self._batch.episodes)
        is_first = True
        try:
            while left:
                try:
                    acting = make_acting(
                        self._evaluation, self._batch.task, self._batch.seed
                    )
                except Error as error:
                    self._fail(left, error)
                    return
                with _closing_on_error(acting.named.environment):
                    recorded = self._recorded(acting)
                self._run_with(recorded, left, is_first=is_first)
                is_first = False
        finally:
            if self._ledger is not None:
                self._ledger.close()

    def _recorded(self, acting: Acting) -> _Recorded:
        plan, named = self._evaluation.plan, acting.named
        last, chosen = _LastEpisode(), self._videos(named)
        recorded = Monitor(
            named.environment,
            self._folder,
            resume=JOIN,
            mode="evaluation",
            max_fps=plan.max_fps,
            quality=plan.quality,
            workers=0,
            trackers=last,
            env_id=named.env_id,
            policy_file=None if plan.is_object else policy_file(plan.policy),
            **chosen,
            **named.view,
        )
        # A name is that of one environment, never of a vector environment.
        monitor = cast("GymnasiumMonitor | DmEnvMonitor", recorded)
        return _Recorded(acting, monitor, last, is_left_open="keep" in chosen)

    def _videos(self, named: NamedEnvironment) -> dict[str, Any]:
        """Return what the monitor is told of videos."""
        evaluation = self._evaluation
        if not evaluation.draws:
            return {"video_callable": False}
        if rendering_of(named).mode == DEFERRED:
            return {"keep": UNDECIDED}
        if keep_rule(evaluation.plan.keep).needs_returns:
            raise InvalidArgument(
                f"keep={evaluation.plan.keep!r} chooses when all episodes are over, "
                f"and the pictures of {named.env_id} cannot be drawn later: "
                f"{rendering_of(named).reason}. Use keep='all', 'cubic' or 'none'."
            )
        return {"video_callable": self._is_scheduled}

    def _is_scheduled(self, _: int) -> bool:
        """Tell whether the running episode gets a video that is drawn live."""
        plan = self._evaluation.plan
        number = plan.seeds.index(self._batch.seed) * plan.episodes + self._episode
        return bool(schedule_from_text(plan.keep)(number))

    def _run_with(
        self, recorded: _Recorded, left: list[int], *, is_first: bool
    ) -> None:
        """Run episodes until one fails; those that are over are left no more."""
        monitor = recorded.monitor
        begins = self._begins(recorded.acting.named, is_first=is_first)
        try:
            with monitor:
                while left:
                    self._episode = left.pop(0)
                    ledger = self._open_ledger(monitor.infix)
                    ledger.end(self._run_episode(recorded, next(begins)))
                    self._running = None
        except Terminated:
            raise
        # A policy may call sys.exit(), or an environment's library.
        except (Exception, SystemExit) as error:
            if self._running is None or not _is_of_episode(error):
                raise
            failed = self._running.failed(monitor, error)
            self._open_ledger(monitor.infix).end(failed)
            self._running = None
            if not recorded.is_left_open:
                # Who leaves a monitor by an exception leaves logs.
                _finish_logs(self._folder, monitor.infix)

    def _begins(self, named: NamedEnvironment, *, is_first: bool) -> Iterator[_Begin]:
        """Yield for one episode after the other what begins it."""
        if self._whole:
            # After an episode that failed nobody knows how far the stream had come.
            yield lambda env, seeds: named.begin_stream(
                env, self._batch.seed if is_first else seeds.environment, seeds
            )
            while True:
                yield named.next_episode
        while True:
            yield named.begin_episode

    def _run_episode(self, recorded: _Recorded, begin: _Begin) -> EpisodeResult:
        monitor = recorded.monitor
        # Whatever came before it in this batch: other batches have other episodes.
        monitor.forget_pictures()
        running = _Running(
            EpisodeResult(
                task=self._batch.task,
                seed=self._batch.seed,
                episode=self._episode,
                total_reward=None,
                length=0,
                terminated=None,
                truncated=None,
                monitor=monitor.infix,
                episode_id=monitor.episode_id,
                start_time=time.time(),
            )
        )
        known = running.known
        self._open_ledger(monitor.infix).begin(
            known.unit, monitor=monitor.infix, episode_id=monitor.episode_id
        )
        self._running = running
        warnings = _run_episode(
            recorded.acting, monitor, episode_seeds(*known.unit), begin
        )
        finished = recorded.last.finished
        return dataclasses.replace(
            known,
            total_reward=finished.reward,
            length=finished.length,
            terminated=finished.terminated,
            truncated=finished.truncated,
            success=finished.success,
            warnings=warnings,
            seconds=running.seconds(),
        )

    def _fail(self, episodes: Sequence[int], error: Error) -> None:
        """Note of episodes that nothing could be made to run them with."""
        ledger = self._open_ledger(f"unmade-{uuid.uuid4().hex}")
        for episode in episodes:
            ledger.end(
                EpisodeResult(
                    task=self._batch.task,
                    seed=self._batch.seed,
                    episode=episode,
                    total_reward=None,
                    length=0,
                    terminated=None,
                    truncated=None,
                    failure=_in_one_line(error),
                )
            )

    def _open_ledger(self, name: str) -> Ledger:
        if self._ledger is None:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._ledger = Ledger(
                self._folder / ledger_name(name), self._batch, whole=self._whole
            )
        return self._ledger


def _run_episode(
    acting: Acting, monitor: Any, seeds: EpisodeSeeds, begin: _Begin
) -> dict[str, int]:
    """Run an episode, and return how often MuJoCo warned in it."""
    named, policy = acting.named, acting.policy
    with working_directory_importable():
        seed_global_generators(seeds.policy)
        policy.reset(seeds)
        observation = begin(monitor, seeds)
        before = _warnings(named.environment)
        done = False
        while not done:
            observation, _, *ends = named.step(monitor, policy(observation))
            done = any(ends)
    after = _warnings(named.environment)
    # Not every reset sets them to zero; and an unstable simulation may be set back.
    counts = {name: n - before.get(name, 0) for name, n in after.items()}
    return {name: n if n >= 0 else after[name] for name, n in counts.items() if n}


def _warnings(environment: Any) -> dict[str, int]:
    simulation = simulation_in(environment)
    if simulation is None:
        return {}
    # Not at the top, because it loads MuJoCo, which not every task has.
    from ..simulation.warnings import warning_counts

    return warning_counts(simulation)


def _finish_logs(folder: Path, monitor: str) -> None:
    # Not at the top: it loads HDF5, which stepping has no use for.
    from .settling import finish_logs

    finish_logs(folder, monitor)


def _policy(evaluation: Evaluation, environment: Any) -> Policy:
    name = evaluation.plan.policy
    if evaluation.policy is None:
        return load_policy(name, environment)
    try:
        with working_directory_importable():
            # Through our own pipe, from the process that evaluates.
            chosen = pickle.loads(evaluation.policy)
    except Exception as error:
        raise PolicyError(
            f"The policy {name} could not be made again in a worker process: "
            f"{_in_one_line(error)}. Give its name instead, policy='module:name'."
        ) from error
    return policy_from(chosen, name, environment)


@contextlib.contextmanager
def _closing_on_error(environment: Any) -> Iterator[None]:
    try:
        yield
    except BaseException:
        environment.close()
        raise


def _is_of_episode(error: BaseException) -> bool:
    """Tell whether what was raised is the policy's fault, or the environment's.

    Errors of ours are of the recording, such as a full disk, unless they speak of an
    action, or a reward, that is none.
    """
    return not isinstance(error, Error) or isinstance(error, _OF_EPISODES)


def _in_one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    # Ours say what happened; of others the name of the class says half.
    if isinstance(error, Error):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
