# SPDX-License-Identifier: Apache-2.0
"""Making a run again from its inputs: played and recorded as before.

Each recording is played in order in one environment, so that the states of its random
generators follow from the first seed. What can never come out again (names of files,
the clock, the provenance) is told to the recorder. What could not be recreated is
noted, with the excuse for it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import signal
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..environments.recreate import NotRecreated, Recreated, checked_options, recreate
from ..environments.scenes import new_warnings
from ..environments.stand_ins import RecordedSteps
from ..errors import Error, UnreadableFile
from ..formats.journal import KILLED
from ..recorder.ending_reasons import EXCEPTION, INTERRUPT, RESET
from ..simulation.model_sources import read_authored
from .inputs import EpisodeInputs, RecordingInputs, given_actions
from .notes import Notes, read_notes
from .recorder_again import monitor_again

# Steps that an archive only claims are counted one by one.
_MOST_BELIEVED_STEPS = 100_000_000
_STEPS_BETWEEN_COUNTS = 1000
# What cuts an episode off from outside, and the excuse that it is. A run that is closed
# in the middle of its last episode is a usual one.
_EVENTS = {
    RESET: "early reset",
    EXCEPTION: "exception",
    INTERRUPT: "fault",
    KILLED: "kill",
}
_SOURCE = "source/"
_MODES = {"e": "evaluation"}


def play_recording(
    recording: RecordingInputs,
    directory: Path,
    *,
    arrays: Mapping[str, NDArray[Any]],
    trust: frozenset[str],
    sources: Path,
    only_counted: bool,
    notes: Notes,
    on_steps: Callable[[int], object],
) -> Mapping[str, NDArray[np.float64]]:
    """Play a recording again into a monitor directory; its videos are pending then.

    Args:
        recording: its inputs.
        directory: where others of the same run may be already.
        arrays: actions and first states by the names in the inputs.
        trust: ids of environments that may be made besides those of the registries.
        sources: the folder with what the author's models were made from.
        only_counted: only rewards and ends are asked for: no states are kept but of
            episodes with a video.
        notes: what could not be recreated, and why.
        on_steps: called with a number of steps that were just taken.

    Returns:
        The rewards of each episode that was played, by the name of its actions, where
        only they are asked for.

    Raises:
        NotRecreated: its environment cannot be made here.
        Error: it could not be recorded.
    """
    if recording.environment is None:
        raise NotRecreated("the journal does not say which environment it is of")
    mjcf = None
    if recording.sources is not None:
        mjcf = _unpack_sources(sources / recording.sources, directory.parent)
    recreated = recreate(
        recording.environment,
        own_camera=recording.options.get("own_camera"),
        trust=trust,
        mjcf=mjcf,
    )

    if recreated.turns_by_rk4():
        notes.add(
            recording.name,
            "rk4",
            "MuJoCo 4.0 turns free bodies otherwise by the integrator RK4",
            count=len(recording.episodes),
        )

    def play() -> Mapping[str, NDArray[np.float64]]:
        playing = _Playing(
            recording,
            recreated,
            directory,
            arrays=arrays,
            only_counted=only_counted,
            notes=notes,
            on_steps=on_steps,
        )
        try:
            playing.run()
        except NotRecreated:
            playing.abandon()
            raise
        return playing.rewards

    if not recording.was_killed:
        return play()
    # What a kill leaves is left by a kill.
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            play()
        # It should not have come here.
        os._exit(1)
    _, status = os.waitpid(child, 0)
    if os.waitstatus_to_exitcode(status) != -signal.SIGKILL:
        raise NotRecreated("the recording that was killed could not be played")
    notes.all = list(read_notes(directory.parent))
    if not recording.has_sources:
        # A thread may have stored them just before.
        for path in directory.glob("openaigym.model.*.zip"):
            path.unlink()
    return {}


class _Playing:
    """One recording, being played; as of `play_recording`."""

    def __init__(
        self,
        recording: RecordingInputs,
        recreated: Recreated,
        directory: Path,
        *,
        arrays: Mapping[str, NDArray[Any]],
        only_counted: bool,
        notes: Notes,
        on_steps: Callable[[int], object],
    ) -> None:
        self._recording = recording
        self._recreated = recreated
        self._directory = directory
        self._arrays = arrays
        self._notes = notes
        self._on_steps = on_steps
        self._only_counted = only_counted
        self._now = 0.0
        self._warned: Mapping[str, int] = {}
        self._events = [*recording.evaluation_events]
        self.rewards: dict[str, NDArray[np.float64]] = {}
        # Of either framework.
        self._monitor: Any = monitor_again(
            recording,
            recreated,
            directory,
            clock=self._clock,
            only_counted=only_counted,
            notes=notes,
        )

    def _clock(self) -> float:
        return self._now

    def run(self) -> None:
        """Play all episodes. Where the recording was killed, so is this process."""
        recorder = self._monitor.recorder
        for episode in self._recording.episodes:
            if self._recording.is_evaluation:
                self._monitor.forget_frames()
                self._say_begun(episode)
                recorder.evaluation_facts = functools.partial(
                    self._evaluation_facts, episode.evaluation or {}
                )
            self._begin(episode)
            self._warned = self._recreated.warnings()
            if episode.actions is not None:
                self._play(episode)
            elif episode.cut is None or episode.steps:
                self._believe(episode)
            self._cut_off(episode)
            self._say_failed()
            if episode.cut == KILLED:
                break
        for event in self._events:
            self._say(*event)
        if self._recording.was_killed and not self._recording.episodes:
            self._notes.add(
                self._recording.name,
                "kill",
                "it was killed before the first step of an episode: that is believed",
            )
        if self._recording.has_sources:
            recorder.finish_models()
        if self._recording.was_killed:
            self._notes.write(self._directory.parent)
            os.kill(os.getpid(), signal.SIGKILL)
        self._monitor.close()

    def _say_begun(self, episode: EpisodeInputs) -> None:
        """Say what the journal says of an evaluation until an episode begins."""
        while self._events:
            kind, facts = self._events.pop(0)
            self._say(kind, facts)
            if kind == "begun" and facts and facts == episode.evaluation:
                break

    def _say_failed(self) -> None:
        """Say that an episode failed, if that comes next."""
        while self._events and self._events[0][0] == "failed":
            self._say(*self._events.pop(0))

    def _say(self, kind: str, facts: Mapping[str, Any] | None) -> None:
        self._monitor.recorder.note_event(kind, None if facts is None else dict(facts))
        if kind == "failed" and facts is not None:
            self._notes.add(
                self._recording.name,
                "exception",
                f"seed {facts['seed']}, episode {facts['episode']} failed, as its "
                f"author says: {facts.get('failure')!s:.200}",
            )

    def abandon(self) -> None:
        """Let go of a recording that cannot go on; what is there is of no use."""
        with contextlib.suppress(Error):
            self._monitor.close()

    def _evaluation_facts(self, said: Mapping[str, Any]) -> Mapping[str, Any]:
        warnings = new_warnings(self._warned, self._recreated.warnings())
        return {**said, "warnings": warnings}

    def _begin(self, episode: EpisodeInputs) -> None:
        """Reset the environment, with the random state that leads to the beginning."""
        self._monitor.set_monitor_mode(_MODES.get(episode.type))
        if episode.start_time is not None:
            self._now = episode.start_time
        seed = episode.seed if type(episode.seed) is int else None
        if self._recreated.is_dm_env:
            self._monitor.seed = episode.seed
            if seed is not None:
                self._recreated.seed(seed)
        self._settle_random_state(episode, seed)
        with self._set_into_first_state(episode):
            if self._recreated.is_dm_env:
                self._monitor.reset()
            else:
                options = checked_options(episode.options)
                self._monitor.reset(seed=seed, options=options)
        if episode.end_time is not None:
            self._now = episode.end_time

    def _settle_random_state(self, episode: EpisodeInputs, seed: int | None) -> None:
        stated = episode.random_state
        if stated is None or stated == self._recreated.random_state():
            return
        if seed is not None and not self._recreated.is_dm_env:
            # Nothing depends on it: the reset seeds the generator anew.
            self._recreated.set_random_state(stated)
            return
        if seed is None and (fresh := self._recreated.seed_behind(stated)) is not None:
            self._recreated.seed(fresh)
            return
        self._recreated.set_random_state(stated)
        self._note(
            episode,
            "unseeded beginning",
            "no seed leads to its beginning: the state of the random generator before "
            "its reset is believed",
        )

    @contextlib.contextmanager
    def _set_into_first_state(self, episode: EpisodeInputs) -> Iterator[None]:
        """Let the reset of an episode end in its recorded first state.

        Only where nothing leads there: no seed was given, and no generator was there.
        """
        known = self._arrays.get(episode.first_state or "")
        base = getattr(self._recreated.environment, "unwrapped", None)
        if known is None or base is None or self._recreated.random_state() is not None:
            yield
            return
        self._note(
            episode,
            "unseeded beginning",
            "it was begun without a seed: its first state is believed",
        )
        reset = base.reset

        def reset_into_state(**given: Any) -> tuple[Any, dict[str, Any]]:
            observation, info = reset(**given)
            return self._recreated.enter(known, observation), info

        base.reset = reset_into_state
        try:
            yield
        finally:
            del base.reset

    def _play(self, episode: EpisodeInputs) -> None:
        """Take the steps of an episode, until the environment ends it."""
        step, is_dm_env = self._monitor.step, self._recreated.is_dm_env
        self._begin_stand_in(episode)
        counted, rewards = 0, []
        states = self._arrays.get(episode.states or "")
        for action in given_actions(episode, self._arrays):
            if states is not None:
                self._recreated.put_into(states[counted : counted + 1])
            result = step(action)
            counted += 1
            if self._only_counted:
                rewards.append(result.reward if is_dm_env else result[1])
            if counted % _STEPS_BETWEEN_COUNTS == 0:
                self._on_steps(_STEPS_BETWEEN_COUNTS)
            if result.last() if is_dm_env else result[2] or result[3]:
                break
        self._note_stand_in(episode)
        if self._only_counted and episode.actions is not None:
            self.rewards[episode.actions] = np.array(rewards, np.float64)
        self._on_steps(counted % _STEPS_BETWEEN_COUNTS)

    def _begin_stand_in(self, episode: EpisodeInputs) -> None:
        stand_in, name = self._recreated.stand_in, episode.steps_taken
        if stand_in is None:
            return
        if name is None:
            raise NotRecreated(
                "wrappers are not here, and what they made of actions is not recorded",
                excuse="wrappers",
            )
        fields = (each.name for each in dataclasses.fields(RecordedSteps))
        parts = {part: self._arrays[f"{name}.{part}"] for part in fields}
        stand_in.begin(RecordedSteps(**parts))

    def _note_stand_in(self, episode: EpisodeInputs) -> None:
        stand_in = self._recreated.stand_in
        if stand_in is None:
            return
        names = (self._recording.environment or {}).get("wrappers") or ()
        without = f"without {', '.join(map(str, names)):.300}"
        if stand_in.differing:
            self._note(
                episode,
                "wrappers",
                f"{without} the rewards or the end of {stand_in.differing} of its "
                "steps are others: they are believed",
            )
        if stand_in.translated:
            self._note(
                episode,
                "wrappers",
                f"{without} the actions of {stand_in.translated} of its steps are not "
                "its controls: that they led to these is believed",
            )

    def _believe(self, episode: EpisodeInputs) -> None:
        """Tell the recorder what the archive says of an episode without actions."""
        self._note(
            episode,
            "actions not kept",
            "its actions were not kept: its length, return and end are believed",
        )
        if episode.steps > _MOST_BELIEVED_STEPS:
            raise NotRecreated(f"an episode cannot have {episode.steps} steps")
        recorder, said = self._monitor.recorder, episode.believed
        ends = {name: said.get(name) is True for name in ("terminated", "truncated")}
        for left in range(max(1, episode.steps) - 1, -1, -1):
            recorder.before_step()
            reward = 0.0 if left or said.get("reward") is None else said["reward"]
            last = (
                ends
                if left == 0 and episode.cut is None
                else dict.fromkeys(ends, False)
            )
            recorder.step(reward, **last, success=None if left else said.get("success"))

    def _cut_off(self, episode: EpisodeInputs) -> None:
        """Let happen what an episode was cut off by."""
        if (excuse := _EVENTS.get(episode.cut or "")) is not None:
            self._note(
                episode, excuse, "it was cut off: that it ended there is believed"
            )
        if episode.cut not in (EXCEPTION, INTERRUPT):
            return
        said = episode.exception or {}
        kind: type[BaseException] = KeyboardInterrupt
        if episode.cut == EXCEPTION:
            kind = _exception_kind(str(said.get("type", "Exception")))
        self._monitor.recorder.note_error(kind(said.get("message", "")))

    def _note(self, episode: EpisodeInputs, excuse: str, reason: str) -> None:
        self._notes.add(self._recording.item(episode), excuse, reason)


def _exception_kind(name: str) -> type[BaseException]:
    """Return an exception whose name in files is this one; nothing is imported."""
    module, _, qualified = name.rpartition(".")
    return type(qualified, (Exception,), {"__module__": module or "builtins"})


def _unpack_sources(path: Path, into: Path) -> tuple[Path, Any]:
    """Return an MJCF file, with all that it refers to beside it, and its model.

    Args:
        path: of the zip file that a recorder wrote.
        into: a folder.

    Raises:
        NotRecreated: it is not there, damaged or dangerous, or MuJoCo refuses it.
    """
    try:
        # It looks at all names in it.
        model = read_authored(path)
    except (OSError, UnreadableFile) as error:
        raise NotRecreated(f"its model cannot be compiled: {error}") from error
    folder = into / path.stem
    with zipfile.ZipFile(path) as archive:
        main = json.loads(archive.read("contents.json"))["main"]
        for name in archive.namelist():
            if name.startswith(_SOURCE):
                target = folder / name.removeprefix(_SOURCE)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(archive.read(name))
    return folder / main, model
