# SPDX-License-Identifier: Apache-2.0
"""The physics of one recorded episode: its model, its steps, its environment."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from ...environments.made_again import (
    UNKNOWN,
    EnvironmentAgain,
    EpisodeStart,
    NotMadeAgain,
    made_with,
    recorded_environment,
)
from ...errors import InvalidArgument, UnreadableFile
from ...formats.trajectory import TrajectoryReader
from ...provenance import versions
from ...simulation.fields import changed_model, differing_from, keeps_paths
from ...simulation.model_store import model_digest
from ..verification import Check, Level, Verdict
from .differences import Differences, judged
from .environment_replay import Replay, action_kinds, replay_episode
from .recorded_models import (
    ModelComparison,
    RecordedModels,
    compare_models,
    first_changes,
    is_of_pictures,
)
from .snapshot_checks import FollowedSnapshots, begun_snapshot, follow_snapshots
from .step_checks import follow_steps
from .tolerances import Fit, derived_fit, framework_doubt, state_fit

_MODEL = "the model is the one that the environment has"
_SOURCES = "the model is made from the sources in the archive"
_STEPS = "each recorded state follows from the one before and the recorded controls"
_PICTURES = "what the pictures are drawn from follows from the recorded states"
_REPLAY = "the environment itself gives the recorded states, rewards and ends"
_START = "the environment begins in the recorded state"
_STATES = "the recorded actions lead the environment through the recorded states"
_REWARDS = "the environment gives the recorded rewards"
_ENDS = "the environment ends the episode where the recording ends"
_OBSERVATIONS = "the environment gives the recorded observations"

_SHOWN = 5


class EpisodePhysics:
    """Asks everything of one episode.

    Args:
        reader: of its trajectory, which stays open meanwhile.
        subject: what a check calls it.
        models: of the directory.
    """

    def __init__(
        self, reader: TrajectoryReader, subject: str, models: RecordedModels
    ) -> None:
        self._reader = reader
        self._subject = subject
        self._models = models
        self._facts = reader.facts
        self._fit = state_fit(self._facts)
        self._derived = derived_fit(self._facts)
        self._changes = first_changes(reader)
        # Why the environment did not begin as the episode did, but anyhow.
        self._unrepeated = ""

    def checks(
        self, made: Callable[[Mapping[str, Any]], EnvironmentAgain]
    ) -> Iterator[Check]:
        """Yield the checks.

        Args:
            made: makes the environment of what the facts say, or raises NotMadeAgain.

        Raises:
            UnreadableFile: the file is damaged.
        """
        if not self._reader.columns or not self._reader.row_count:
            reason = "no states were recorded: no MuJoCo simulation was to be seen"
            yield self._check(_STEPS, Verdict.NOT_CHECKABLE, reason)
            yield self._check(_REPLAY, Verdict.NOT_CHECKABLE, reason)
            return
        environment: EnvironmentAgain | None = None
        observation, refusal = None, ""
        try:
            environment = made(self._facts)
            observation = self._begun(environment)
        except NotMadeAgain as error:
            refusal = str(error)
        present = (
            None if environment is None or refusal else environment.simulation()[0]
        )
        # Before the environment is stepped, which may change its model.
        of_model, model = self._model(present)
        if model is not None:
            self._fit = self._fit.of_model(model)
            self._derived = self._derived.of_model(model)
        begun = None if present is None else self._begun_snapshot(environment)
        replay: Replay | str = refusal
        if environment is not None and not refusal:
            replay = self._replayed(environment, observation)
        yield self._with_changes(of_model, replay)
        of_steps = self._steps(model, replay)
        yield of_steps
        if self._reader.frame_count:
            yield self._pictures(model, of_steps, begun)
        if isinstance(replay, str) or environment is None:
            reason = "; ".join(filter(None, (str(replay), self._made_with())))
            yield self._check(_REPLAY, Verdict.NOT_CHECKABLE, reason)
        else:
            yield from self._replay_checks(replay, environment)

    def _begun(self, environment: EnvironmentAgain) -> Any:
        """Begin the episode as it was begun; or anyhow, where its states tell the rest.

        Raises:
            NotMadeAgain: its beginning is not known, and may have been of a kind that
                no state tells.
        """
        self._unrepeated = ""
        try:
            return environment.begin(self._start())
        except NotMadeAgain as error:
            if not environment.is_all_in_state:
                raise
            observation = environment.begin_anyhow()
            if not self._has_begun_model(environment.simulation()[0]):
                raise
            self._unrepeated = str(error)
            return observation

    def _has_begun_model(self, present: Any) -> bool:
        """Tell whether the model is the episode's, whatever its reset has drawn.

        The suite's resets may draw targets that stand in the model, and only there.
        """
        if _mapping(self._facts.get("environment")).get("framework") != "dm_control":
            return True
        return not self._changes and model_digest(present) == self._sha256()

    def _made_with(self) -> str:
        try:
            return made_with(recorded_environment(self._facts))
        except NotMadeAgain:
            return ""

    def _start(self) -> EpisodeStart:
        facts = self._facts
        return EpisodeStart(
            seed=facts.get("seed"),
            random_state=facts.get("random_state"),
            options=facts.get("options"),
        )

    # The model --------------------------------------------------------------------

    def _model(self, present: Any) -> tuple[Check, Any]:
        """Return what there is to say of the model, and one to make steps with."""
        try:
            sources = self._models.from_sources(self._facts)
            missing = ""
        except UnreadableFile as error:
            sources, missing = None, error.reason.rstrip(".")
        is_mjcf = present is not None and self._is_mjcf()
        if present is not None and not is_mjcf:
            model = changed_model(present, {})
            if sources is not None:
                return self._of_registry(sources, present), model
            return self._of_registry_alone(present, missing), model
        if sources is None:
            reason = (
                "there is only a compiled model, which is not loaded from a stranger: "
                f"{missing}"
            )
            return self._check(_SOURCES, Verdict.NOT_CHECKABLE, reason), None
        try:
            model = changed_model(sources, self._changes)
        except InvalidArgument as error:
            return self._check(_SOURCES, Verdict.FAIL, _text(error)), None
        return self._of_sources(sources), model

    def _of_registry(self, sources: Any, present: Any) -> Check:
        comparison = compare_models(sources, self._changes, present)
        near = () if self._fit.is_exact else self._nearly_as_recorded(present)
        if comparison.trouble or set(comparison.differing) - set(near):
            reason = (
                "the archive holds another model than the installed environment has at "
                f"the beginning of this episode: {comparison}"
            )
            return self._check(_MODEL, Verdict.FAIL, reason)
        if self._has_recorded_hash(sources, present):
            return self._check(_MODEL, Verdict.PASS, "bit for bit")
        why = self._fit.why or (
            "its sha256 is of a model that holds where its files were"
            if keeps_paths(sources)
            else ""
        )
        if why:
            return self._check(_MODEL, Verdict.PASS, f"field by field; {why}")
        reason = "the archive's sources compile to another model than its sha256 says"
        return self._check(_MODEL, Verdict.FAIL, reason)

    def _has_recorded_hash(self, sources: Any, present: Any) -> bool:
        if not self._is_of_this_mujoco():
            return False
        if model_digest(sources) == self._sha256():
            return True
        # It may hold where its files were.
        return not self._changes and model_digest(present) == self._sha256()

    def _of_registry_alone(self, present: Any, missing: str) -> Check:
        """Compare where the archive has nothing but a compiled model."""
        differing = set(differing_from(present, self._changes))
        if not self._fit.is_exact:
            differing -= set(self._nearly_as_recorded(present))
        if differing:
            reason = f"{_listed(differing)}: recorded otherwise than the reset sets it"
            return self._check(_MODEL, Verdict.FAIL, reason)
        comparison = self._with_stored(present)
        if comparison is not None and comparison.is_same:
            return self._check(_MODEL, Verdict.PASS, "bit for bit")
        if not (self._is_of_this_mujoco() and self._fit.is_exact):
            reason = (
                f"{missing}, and the hash of the compiled model says nothing here: "
                f"{self._fit.why or 'it is of another MuJoCo'}"
            )
            return self._check(_MODEL, Verdict.NOT_CHECKABLE, reason)
        if comparison is not None:
            reason = (
                "the recorded model is another one than the installed environment has "
                f"at the beginning of this episode: {comparison}"
            )
            return self._check(_MODEL, Verdict.FAIL, reason)
        reason = (
            f"{missing}, and the episode in which the model was first seen is not "
            f"here; what the reset changes ({_listed(self._changes)}) is as recorded"
        )
        return self._check(_MODEL, Verdict.NOT_CHECKABLE, reason)

    def _with_stored(self, present: Any) -> ModelComparison | None:
        """Compare with the model that the recorded hash is of; None if it is not known.

        An episode that changes nothing in it has it.
        """
        sha256 = self._sha256()
        if not self._is_of_this_mujoco():
            return None
        if not self._changes:
            if model_digest(present) != sha256:
                return ModelComparison(trouble="its sha256 is another")
            self._models.note(sha256, present)
            return ModelComparison()
        stored = self._models.known(sha256)
        if stored is None:
            return None
        return compare_models(stored, self._changes, present)

    def _of_sources(self, sources: Any) -> Check:
        changed = [name for name in self._changes if not is_of_pictures(name)]
        suffix = f"; the recording changes {_listed(changed)} in it" if changed else ""
        if self._is_of_this_mujoco() and model_digest(sources) == self._sha256():
            return self._check(_SOURCES, Verdict.PASS, f"bit for bit{suffix}")
        why = self._fit.why or (
            "it holds the paths of its files; all below is of what the sources give"
            if keeps_paths(sources)
            else "it is of another MuJoCo"
            if not self._is_of_this_mujoco()
            else ""
        )
        if why:
            reason = f"the hash of the compiled model says nothing here: {why}{suffix}"
            return self._check(_SOURCES, Verdict.NOT_CHECKABLE, reason)
        reason = "they compile to another model than the recorded sha256 says"
        return self._check(_SOURCES, Verdict.FAIL, reason)

    def _nearly_as_recorded(self, present: Any) -> tuple[str, ...]:
        """Return the names of changed fields that are nearly what was recorded."""
        tolerance = self._derived.tolerance
        near = []
        for name in differing_from(present, self._changes):
            ours = np.asarray(_member(present, name), np.float64)
            theirs = np.asarray(self._changes[name], np.float64)
            if ours.shape == theirs.shape and np.allclose(
                ours, theirs, rtol=tolerance, atol=tolerance
            ):
                near.append(name)
        return tuple(near)

    def _with_changes(self, of_model: Check, replay: Replay | str) -> Check:
        """Return the check of the model, with what became of changes on the way."""
        if isinstance(replay, str) or not replay.changed:
            return of_model
        name, step = next(iter(replay.changed.items()))
        reason = (
            f"the recording says that {name} was changed, and the environment has "
            f"another value of it after step {step}"
        )
        if of_model.verdict is Verdict.FAIL:
            reason = f"{of_model.reason}; {reason}"
        return self._check(of_model.claim, Verdict.FAIL, reason)

    def _sha256(self) -> str:
        return str(_mapping(self._facts.get("model")).get("sha256"))

    def _is_of_this_mujoco(self) -> bool:
        model = _mapping(self._facts.get("model"))
        return bool(model.get("mujoco") == versions().get("mujoco"))

    def _is_mjcf(self) -> bool:
        return _mapping(self._facts.get("environment")).get("framework") == "mjcf"

    # The steps --------------------------------------------------------------------

    def _steps(self, model: Any, replay: Replay | str) -> Check:
        if model is None:
            reason = "there is no model to make a step with that could be trusted"
            return self._check(_STEPS, Verdict.NOT_CHECKABLE, reason)
        try:
            steps = follow_steps(
                self._reader,
                model,
                is_exact=self._fit.is_exact,
                uneven=self._is_mjcf(),
            )
        except InvalidArgument as error:
            return self._check(_STEPS, Verdict.FAIL, _text(error))
        if steps.trouble:
            return self._check(_STEPS, Verdict.FAIL, steps.trouble)
        verdict, reason, figures = judged(steps.differences, self._fit)
        figures = {**figures, "substeps": steps.substeps}
        if steps.changed:
            reason += f"; the recording changes {_listed(steps.changed)} on the way"
        if verdict is Verdict.FAIL:
            verdict, reason = self._why_not(steps.keeps_more_than_state, replay, reason)
        elif steps.unknown:
            is_last = steps.unknown == [self._reader.row_count - 1]
            verdict = verdict if is_last else Verdict.NOT_CHECKABLE
            reason += (
                "; the last state is not recorded, because the environment had reset "
                "itself already"
                if is_last
                else f"; {len(steps.unknown)} states are not recorded, the first is "
                f"that after step {steps.unknown[0]}"
            )
        return self._check(_STEPS, verdict, reason, figures)

    def _why_not(
        self, keeps_more: bool, replay: Replay | str, reason: str
    ) -> tuple[Verdict, str]:
        """Return what comes of states that do not follow by MuJoCo alone."""
        if keeps_more:
            return Verdict.NOT_CHECKABLE, (
                "the model lets bodies sleep, or solves contacts by IPC, and then "
                f"MuJoCo keeps more than its state; {reason}"
            )
        if not isinstance(replay, str) and _goes_through(replay):
            return Verdict.NOT_CHECKABLE, (
                "the environment does more than mj_step between its states, and gives "
                f"these very states when it is made again; {reason}"
            )
        if isinstance(replay, str):
            reason += (
                "; an environment may do more than mj_step, but that it did, only the "
                "environment itself could show"
            )
        return Verdict.FAIL, reason

    # What pictures are drawn from ---------------------------------------------------

    def _begun_snapshot(self, environment: Any) -> Any:
        if not self._reader.frame_count:
            return None
        with contextlib.suppress(InvalidArgument):
            return begun_snapshot(
                self._reader,
                *environment.simulation(),
                tolerance=self._derived.tolerance,
            )
        return None

    def _pictures(self, model: Any, of_steps: Check, begun: Any) -> Check:
        if model is None:
            return self._check(_PICTURES, Verdict.NOT_CHECKABLE, of_steps.reason)
        substeps = of_steps.figures.get("substeps", 0)
        if not substeps and self._reader.row_count > 1:
            reason = f"no step could be made again: {of_steps.reason}"
            return self._check(_PICTURES, Verdict.NOT_CHECKABLE, reason)
        try:
            followed = follow_snapshots(
                self._reader,
                model,
                substeps=substeps,
                uneven=self._is_mjcf(),
                few=not self._is_shown(),
                begun=begun,
            )
        except InvalidArgument as error:
            return self._check(_PICTURES, Verdict.FAIL, _text(error))
        return self._judged_pictures(followed, of_steps)

    def _is_shown(self) -> bool:
        """Tell whether there is any video beside the episode, be it of another."""
        return any(self._reader.path.parent.glob("*.video.*"))

    def _judged_pictures(self, followed: FollowedSnapshots, of_steps: Check) -> Check:
        differences, unknown = followed.differences, followed.unknown
        last = self._reader.row_count - 1
        if not differences.rows:
            reason = "none of the states that it has pictures of is recorded"
            return self._check(_PICTURES, Verdict.NOT_CHECKABLE, reason)
        verdict, reason, figures = judged(differences, self._derived, "picture")
        pictures = self._reader.frame_count - len(unknown)
        if differences.rows < pictures:
            reason += f", a sample of {pictures}: there are no videos of them"
        if verdict is not Verdict.PASS:
            place = differences.first if self._derived.is_exact else differences.worst
            assert place is not None
            frame = int(np.searchsorted(self._reader.frame_steps, place[0]))
            reason = f"frame {frame}: {reason}"
        of_step = of_steps.figures
        if (
            verdict is Verdict.FAIL
            and of_steps.verdict is Verdict.NOT_CHECKABLE
            and of_step.get("maximum", 0.0) > of_step.get("tolerance", 0.0)
        ):
            verdict = Verdict.NOT_CHECKABLE
            reason = f"its states do not follow by mj_step alone either; {reason}"
        elif unknown:
            if verdict is Verdict.PASS and unknown != [last]:
                verdict = Verdict.NOT_CHECKABLE
            reason += (
                f"; of {len(unknown)} more the state is not recorded, the first is "
                f"that after step {unknown[0]}"
            )
        return self._check(_PICTURES, verdict, reason, figures)

    # The environment --------------------------------------------------------------

    def _replayed(
        self, environment: EnvironmentAgain, observation: Any
    ) -> Replay | str:
        reason = self._no_actions()
        if reason:
            return reason
        try:
            kinds = action_kinds(self._reader)
            replay = self._run(environment, observation, kinds[0])
            if len(kinds) > 1 and _only_rewards_differ(replay):
                observation = self._begun(environment)
                other = self._run(environment, observation, kinds[1])
                if other.rewards.differing < replay.rewards.differing:
                    return other
        except (InvalidArgument, NotMadeAgain) as error:
            return _text(error)
        return replay

    def _no_actions(self) -> str:
        facts = self._facts
        if self._reader.kind("action") is None:
            return "its actions are no plain arrays, and were not recorded"
        if "irregular_actions_from" in facts:
            return (
                "its actions are not recorded from step "
                f"{facts['irregular_actions_from']!r:.20} on: they were of another kind"
            )
        return ""

    def _run(
        self, environment: EnvironmentAgain, observation: Any, kind: Any
    ) -> Replay:
        return replay_episode(
            self._reader,
            environment,
            observation,
            kind=kind,
            is_exact=self._fit.is_exact,
            has_limit=self._has_limit(),
            begins_as_recorded=bool(self._unrepeated),
        )

    def _has_limit(self) -> bool:
        return recorded_environment(self._facts).max_episode_steps is not UNKNOWN

    def _replay_checks(
        self, replay: Replay, environment: EnvironmentAgain
    ) -> Iterator[Check]:
        doubt = self._doubt(replay, environment)
        how = environment.made_with
        freely = "; put into the first recorded state" if self._unrepeated else ""
        if replay.synchronised_from is not None:
            freely += (
                f"; from step {replay.synchronised_from} on each step begins at the "
                "recorded state"
            )
        if self._unrepeated:
            yield self._check(_START, Verdict.NOT_CHECKABLE, self._unrepeated)
        else:
            began = f"; {self._began()}"
            yield self._judged(
                _START, replay.first_state, self._derived, began, doubt, how
            )
        yield self._judged(_STATES, replay.states, self._fit, freely, doubt, how)
        yield self._judged(_REWARDS, replay.rewards, self._derived, freely, doubt, how)
        yield self._ends(replay, doubt, how)
        if self._reader.kind("observation") is not None:
            yield self._observations(replay, freely, doubt, how)

    def _judged(
        self,
        claim: str,
        differences: Differences,
        fit: Fit,
        suffix: str,
        doubt: str,
        how: str,
    ) -> Check:
        unit = {_START: "state", _OBSERVATIONS: "observation"}.get(claim, "step")
        verdict, reason, figures = judged(differences, fit, unit)
        if verdict is Verdict.FAIL:
            return self._failed(claim, reason + suffix, doubt, how, figures)
        if how and claim == _REWARDS:
            suffix += f"; {how}"
        return self._check(claim, verdict, reason + suffix, figures)

    def _ends(self, replay: Replay, doubt: str, how: str) -> Check:
        trouble = replay.ending or replay.trouble
        if trouble:
            return self._failed(_ENDS, trouble, doubt, how)
        reason = f"{replay.steps} steps"
        if not self._has_limit():
            reason += (
                "; whether it was cut off where it should be is not known, because the "
                "recording does not say after how many steps that is"
            )
        return self._check(_ENDS, Verdict.PASS, reason)

    def _observations(self, replay: Replay, suffix: str, doubt: str, how: str) -> Check:
        if "irregular_observations_from" in self._facts:
            reason = "some were of another kind than the first, and are not recorded"
            return self._check(_OBSERVATIONS, Verdict.NOT_CHECKABLE, reason)
        if replay.observations is None:
            return self._failed(_OBSERVATIONS, replay.observation_trouble, doubt, how)
        if self._unrepeated:
            suffix += "; the first is not compared"
        return self._judged(
            _OBSERVATIONS, replay.observations, self._derived, suffix, doubt, how
        )

    def _failed(
        self,
        claim: str,
        reason: str,
        doubt: str,
        how: str,
        figures: Mapping[str, Any] | None = None,
    ) -> Check:
        """Return a failure, or what is in doubt for a reason that may be honest."""
        if how:
            reason = f"{reason}; {how}"
        if doubt:
            return self._check(
                claim, Verdict.NOT_CHECKABLE, f"{doubt}; as it is, {reason}", figures
            )
        return self._check(claim, Verdict.FAIL, reason, figures)

    def _doubt(self, replay: Replay, environment: EnvironmentAgain) -> str:
        recorded = recorded_environment(self._facts)
        if recorded.wrappers is None:
            return (
                "the recording does not say which wrappers stood between the monitor "
                "and the environment"
            )
        if replay.synchronised_from is not None and not environment.is_all_in_state:
            return (
                f"{self._fit.why}, and such an environment keeps more between steps "
                "than a state that it could be put into"
            )
        return framework_doubt(self._facts, recorded.framework)

    def _began(self) -> str:
        facts = self._facts
        framework = _mapping(facts.get("environment")).get("framework")
        if framework == "mjcf":
            return "nothing in its reset is random"
        seed = facts.get("seed")
        if type(seed) is not int:
            return "reset from the recorded random state"
        if framework == "gymnasium" or facts.get("random_state") is None:
            return f"reset with the recorded seed {seed}"
        given = "is" if _is_state_of(seed, facts["random_state"]) else "is not"
        return (
            f"reset from the recorded random state, which {given} that of seed {seed}"
        )

    def _check(
        self,
        claim: str,
        verdict: Verdict,
        reason: str,
        figures: Mapping[str, Any] | None = None,
    ) -> Check:
        return Check(
            level=Level.PHYSICS,
            claim=claim,
            subject=self._subject,
            verdict=verdict,
            reason=reason,
            figures=figures or {},
        )


def _goes_through(replay: Replay) -> bool:
    """Tell whether an environment went through the recorded states, bit for bit."""
    return (
        replay.first_state.first is None
        and replay.states.first is None
        and replay.states.rows > 0
        and not replay.trouble
        and not replay.ending
    )


def _only_rewards_differ(replay: Replay) -> bool:
    return replay.rewards.first is not None and (
        replay.synchronised_from is not None or replay.states.first is None
    )


def _is_state_of(seed: int, state: Any) -> bool:
    try:
        own = np.random.RandomState(seed).get_state(legacy=False)
        key = np.asarray(state["state"]["key"])
        return np.array_equal(own["state"]["key"], key) and (
            own["state"]["pos"] == state["state"]["pos"]
        )
    except (TypeError, ValueError, KeyError, OverflowError):
        return False


def _member(model: Any, name: str) -> Any:
    for part in name.split("."):
        model = getattr(model, part)
    return model


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _listed(names: Any) -> str:
    known = sorted(names)
    more = f" and {len(known) - _SHOWN} more" if len(known) > _SHOWN else ""
    return f"{', '.join(known[:_SHOWN])}{more}"


def _text(error: Exception) -> str:
    return str(error).rstrip(".")
