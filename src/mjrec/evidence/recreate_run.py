# SPDX-License-Identifier: Apache-2.0
"""Recreation of a run from its inputs: it is replayed and recorded as before.

Each recording is replayed in order in one environment, so that the states of its random
generators follow from the first seed. Facts that can never be reproduced (file names,
the clock, the provenance) are passed to the recorder. Anything that could not be
recreated is noted with its excuse.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ..environments.recreate import NotRecreated, Recreated, checked_options, recreate
from ..environments.scenes import mujoco_warnings, new_warnings
from ..environments.wrapping import RecordedSteps
from ..errors import Error, UnreadableFile
from ..formats.killed_episodes import KILLED
from ..plain_text import counted
from ..recorder.endings import EXCEPTION, INTERRUPT, RESET
from ..simulation.model_sources import read_authored
from .excuses import note, read_notes, write_notes
from .findings import Finding
from .inputs import EpisodeInputs, RecordingInputs, given_actions
from .recreated_monitor import recreated_monitor

# A limit, because steps without recorded actions are counted one by one.
_MOST_BELIEVED_STEPS = 100_000_000
# Events that cut an episode off from outside, and their excuses. Closing a run in the
# middle of its last episode is normal, so it needs no excuse.
_EVENTS = {
    RESET: "early reset",
    EXCEPTION: "exception",
    INTERRUPT: "fault",
    KILLED: "kill",
}
_ENDS = ("terminated", "truncated")
_SOURCE = "source/"
_MODES = {"e": "evaluation"}


@dataclass(frozen=True, kw_only=True)
class Recreation:
    """The facts shared by all recordings of the run that is being recreated.

    Attributes:
        directory: the monitor directory.
        arrays: the episodes' arrays, keyed by their names in the inputs.
        trust: ids of environments that may be created in addition to those in the
            registries.
        sources: the folder with the sources of the author's models.
        notes: receives the facts that could not be recreated, with their excuses.
        on_step: called after each step.
    """

    directory: Path
    arrays: Mapping[str, NDArray[Any]]
    trust: frozenset[str]
    sources: Path
    notes: list[Finding]
    on_step: Callable[[], object]


def play_recording(recording: RecordingInputs, recreation: Recreation) -> None:
    """Replay a recording into a monitor directory, and leave its videos pending.

    Raises:
        NotRecreated: the environment cannot be created here, or the recording cannot
            be replayed.
        Error: the run could not be recorded.
    """
    if recording.environment is None:
        reason = "the journal does not name its environment"
        raise NotRecreated(reason, excuse="environment")
    directory = recreation.directory
    mjcf, is_elsewhere = None, recording.is_elsewhere
    sources = recreation.sources / (recording.sources or "")
    if sources.is_file():
        mjcf = _unpack_sources(sources, directory.parent, is_elsewhere=is_elsewhere)
    recreated = recreate(
        recording.environment,
        own_camera=recording.options.get("own_camera"),
        trust=recreation.trust,
        mjcf=mjcf,
        is_elsewhere=is_elsewhere,
    )
    if recreated.turns_by_rk4():
        reason = "MuJoCo 4.0 rotates free bodies differently with the integrator RK4"
        count = len(recording.episodes)
        recreation.notes.append(note(recording.name, "rk4", reason, count=count))
    if not recording.was_killed:
        _Playing(recording, recreated, recreation).run()
        return
    refusal = directory.with_name(f"{recording.infix}.refusal")
    # A child process is killed in the same place, so that it leaves the same files.
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            try:
                _Playing(recording, recreated, recreation).run()
            except NotRecreated as error:
                refusal.write_text(json.dumps([str(error), error.excuse]))
        # Only reached if the replay failed: a successful one kills the process.
        os._exit(1)
    _, status = os.waitpid(child, 0)
    if os.waitstatus_to_exitcode(status) != -signal.SIGKILL:
        reason, excuse = "the killed recording could not be replayed", None
        if refusal.exists():
            reason, excuse = json.loads(refusal.read_text())
        raise NotRecreated(reason, excuse=excuse)
    recreation.notes[:] = read_notes(directory.parent)
    if not recording.has_sources:
        # A thread may have stored the sources just before the kill.
        for path in directory.glob("openaigym.model.*.zip"):
            path.unlink()


class _Playing:
    """The replay of one recording.

    Args:
        recording: the recording's inputs.
        recreated: the recording's environment, recreated.
        recreation: the facts shared with the run's other recordings.
    """

    def __init__(
        self, recording: RecordingInputs, recreated: Recreated, recreation: Recreation
    ) -> None:
        self._recording, self._recreated = recording, recreated
        self._recreation = recreation
        self._now = 0.0
        self._warned: Mapping[str, int] = {}
        self._events = [*recording.evaluation_events]
        # A monitor for Gymnasium or dm_env.
        self._monitor: Any = recreated_monitor(
            recording,
            recreated,
            recreation.directory,
            clock=lambda: self._now,
            notes=recreation.notes,
        )

    def run(self) -> None:
        """Replay all episodes; if the recording was killed, kill this process too."""
        try:
            self._play_all()
        except (Error, MemoryError):
            raise
        except Exception as error:
            # The recording's files are not needed any more.
            with contextlib.suppress(Error):
                self._monitor.close()
            if isinstance(error, NotRecreated):
                raise
            # Environments may raise any error for what does not fit them.
            raise NotRecreated(f"{error!r:.200}") from error

    def _play_all(self) -> None:
        recorder = self._monitor.recorder
        for episode in self._recording.episodes:
            if self._recording.is_evaluation:
                self._monitor.forget_frames()
                self._say_begun(episode)
                recorder.evaluation_facts = functools.partial(
                    self._evaluation_facts, episode.evaluation or {}
                )
            self._begin(episode)
            self._warned = mujoco_warnings(self._recreated.environment)
            if episode.has_actions:
                self._play(episode)
            if episode.lost is not None:
                self._lose(episode, *episode.lost)
            elif not episode.has_actions and (episode.cut is None or episode.steps):
                self._believe(episode)
            self._cut_off(episode)
            self._say_failed()
            if episode.cut == KILLED:
                break
        for event in self._events:
            self._say(*event)
        if self._recording.was_killed and not self._recording.episodes:
            self._note(
                None,
                "kill",
                "it was killed before the first step of an episode; this is believed",
            )
        if self._recording.has_sources:
            recorder.finish_models()
        if self._recording.was_killed:
            write_notes(self._recreation.directory.parent, self._recreation.notes)
            os.kill(os.getpid(), signal.SIGKILL)
        self._monitor.close()

    def _say_begun(self, episode: EpisodeInputs) -> None:
        """Copy the journal's evaluation events up to the beginning of this episode."""
        while self._events:
            kind, facts = self._events.pop(0)
            self._say(kind, facts)
            if kind == "begun" and facts and facts == episode.evaluation:
                break

    def _say_failed(self) -> None:
        """Copy the journal's next events for as long as they are failures."""
        while self._events and self._events[0][0] == "failed":
            self._say(*self._events.pop(0))

    def _say(self, kind: str, facts: Mapping[str, Any] | None) -> None:
        self._monitor.recorder.run.note(kind, None if facts is None else dict(facts))
        if kind == "failed" and facts is not None:
            self._note(
                None,
                "exception",
                f"seed {facts['seed']}, episode {facts['episode']} failed, according "
                f"to its author: {facts.get('failure')!s:.200}",
            )

    def _evaluation_facts(self, said: Mapping[str, Any]) -> Mapping[str, Any]:
        warnings = new_warnings(self._warned, self._recreated.environment)
        return {**said, "warnings": warnings}

    def _begin(self, episode: EpisodeInputs) -> None:
        """Reset the environment with the episode's seed or random state."""
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
        if seed is None and (fresh := self._recreated.seed_behind(stated)) is not None:
            self._recreated.seed(fresh)
            return
        self._recreated.set_random_state(stated)
        # Nothing has to be believed if the reset reseeds the generator.
        if seed is None or self._recreated.is_dm_env:
            self._note(
                episode,
                "unseeded beginning",
                "no seed reproduces its initial state; the state of the random "
                "generator before the reset is believed",
            )

    @contextlib.contextmanager
    def _set_into_first_state(self, episode: EpisodeInputs) -> Iterator[None]:
        """Make the reset of an episode end in its recorded initial state.

        This is done only if nothing else reproduces that state: no seed was recorded,
        and the environment has no random generator.
        """
        known = self._recreation.arrays.get(f"{episode.arrays}.state")
        base = getattr(self._recreated.environment, "unwrapped", None)
        if known is None or base is None or self._recreated.random_state() is not None:
            yield
            return
        self._note(
            episode,
            "unseeded beginning",
            "it was started without a seed; its initial state is believed",
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
        """Take the recorded actions of an episode until the environment ends it."""
        take, is_dm_env = self._monitor.step, self._recreated.is_dm_env
        self._begin_stand_in(episode)
        states = self._recreation.arrays.get(f"{episode.arrays}.states")
        self._break_videos(episode)
        for step, action in enumerate(given_actions(episode, self._recreation.arrays)):
            if states is not None:
                self._recreated.put_into(states[step : step + 1])
            result = take(action)
            self._recreation.on_step()
            if result.last() if is_dm_env else result[2] or result[3]:
                break
        self._note_stand_in(episode)

    def _break_videos(self, episode: EpisodeInputs) -> None:
        """Cut short the live videos that were cut short in the original run."""
        for video in self._monitor.recorder.live_videos:
            name = Path(video.path).stem
            if name not in episode.broken:
                continue
            reason, frames = episode.broken[name]
            video.break_off(reason, frames=frames)
            self._note(
                episode,
                "broken video",
                f"{name} was cut short after {counted(frames, 'frame')}, according to "
                f"its author: {reason:.200}",
            )

    def _begin_stand_in(self, episode: EpisodeInputs) -> None:
        stand_in, arrays = self._recreated.stand_in, self._recreation.arrays
        if stand_in is None:
            return
        if f"{episode.arrays}.controls" not in arrays:
            raise NotRecreated(
                "wrappers are missing, and the controls they produced were not "
                "recorded",
                excuse="wrappers",
            )
        names = [each.name for each in dataclasses.fields(RecordedSteps)]
        parts = {part: arrays[f"{episode.arrays}.{part}"] for part in names}
        stand_in.begin(RecordedSteps(**parts))

    def _note_stand_in(self, episode: EpisodeInputs) -> None:
        stand_in = self._recreated.stand_in
        if stand_in is None:
            return
        names = (self._recording.environment or {}).get("wrappers") or ()
        without = f"without {', '.join(map(str, names)):.300}"
        for steps, claim in (
            (
                stand_in.differing,
                "the rewards or end flags of {} of its steps differ; the archive's "
                "are believed",
            ),
            (
                stand_in.translated,
                "in {} of its steps, the actions differ from the controls; that the "
                "wrappers turned the one into the other is believed",
            ),
        ):
            if steps:
                self._note(episode, "wrappers", f"{without} {claim.format(steps)}")

    def _lose(self, episode: EpisodeInputs, reason: str, missing: int) -> None:
        """Lose the end of a trajectory, or all of it, where the original run did."""
        is_gone, steps = episode.arrays is None, episode.steps
        error = _exception_kind("mjrec.errors.FileNotWritten")(reason)
        self._monitor.recorder.lose_states(error, all_rows=is_gone)
        of = f"{steps + missing}{' or more' if episode.cut else ''}"
        lost = "was lost, with any video of it"
        if not is_gone:
            lost = f"ends after {steps} of {of} steps"
        self._note(
            episode,
            "fault",
            f"its trajectory {lost}; its length, return and end are believed; "
            f"according to its author: {reason:.200}",
        )
        self._take_steps(episode, missing)

    def _believe(self, episode: EpisodeInputs) -> None:
        """Record an episode without its actions, from its length, return and end."""
        self._note(
            episode,
            "actions not kept",
            "its actions were not kept; its length, return and end are believed",
        )
        self._take_steps(episode, max(1, episode.steps))

    def _take_steps(self, episode: EpisodeInputs, steps: int) -> None:
        """Count the last steps of an episode without taking them."""
        if steps > _MOST_BELIEVED_STEPS:
            raise NotRecreated(f"an episode cannot have {steps} steps")
        recorder, said = self._monitor.recorder, episode.believed
        for left in range(steps - 1, -1, -1):
            recorder.before_step()
            reward = 0.0
            if left == 0 and said.get("reward") is not None:
                # A sum of parts might be rounded differently.
                recorder.stats_recorder.rewards, reward = 0.0, said["reward"]
            is_end = left == 0 and episode.cut is None
            last = {name: is_end and said.get(name) is True for name in _ENDS}
            recorder.step(reward, **last, success=None if left else said.get("success"))

    def _cut_off(self, episode: EpisodeInputs) -> None:
        """Note a cut-off from outside, and record the exception that caused it."""
        if (excuse := _EVENTS.get(episode.cut or "")) is not None:
            self._note(
                episode,
                excuse,
                "it was cut off; the step at which it ended is believed",
            )
        if episode.cut not in (EXCEPTION, INTERRUPT):
            return
        said = episode.exception or {}
        kind: type[BaseException] = KeyboardInterrupt
        if episode.cut == EXCEPTION:
            kind = _exception_kind(str(said.get("type", "Exception")))
        self._monitor.recorder.note_error(kind(said.get("message", "")))

    def _note(self, episode: EpisodeInputs | None, excuse: str, reason: str) -> None:
        """Note what is believed about an episode, or about the whole recording."""
        recording = self._recording
        item = recording.name if episode is None else recording.item(episode)
        self._recreation.notes.append(note(item, excuse, reason))


def _exception_kind(name: str) -> type[BaseException]:
    """Return a new exception class with this recorded name, without importing any."""
    module, _, qualified = name.rpartition(".")
    return type(qualified, (Exception,), {"__module__": module or "builtins"})


def _unpack_sources(path: Path, into: Path, *, is_elsewhere: bool) -> tuple[Path, Any]:
    """Unpack an MJCF file and the files that it refers to; return its path and model.

    Args:
        path: the zip file that a recorder wrote.
        into: the folder to unpack into.
        is_elsewhere: whether the recording claims other versions than those here.

    Raises:
        NotRecreated: the zip file is damaged or dangerous, or MuJoCo rejects the model.
    """
    try:
        # This checks all names in the zip file.
        model = read_authored(path)
    except (OSError, UnreadableFile) as error:
        raise NotRecreated(
            f"its model cannot be compiled: {error}",
            excuse="environment" if is_elsewhere else None,
        ) from error
    folder = into / path.stem
    with zipfile.ZipFile(path) as archive:
        main = json.loads(archive.read("contents.json"))["main"]
        for name in archive.namelist():
            if name.startswith(_SOURCE):
                target = folder / name.removeprefix(_SOURCE)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(archive.read(name))
    return folder / main, model
