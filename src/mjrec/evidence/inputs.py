# SPDX-License-Identifier: Apache-2.0
"""The inputs of a run: all that is taken from an archive to make the run again.

The list is closed. What does not stand here is an output, and has to come out again:
states, rewards, ends, statistics, frames, videos. An input that is not the default
stands in the report.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .. import json_text
from ..environments.scenes import shown_wrappers

INPUTS_FILE: Final = "inputs.json"
ARRAYS_FILE: Final = "arrays.npz"

# Of the options in a journal, with the types that they may have.
OPTIONS: Final[Mapping[str, tuple[type, ...]]] = {
    "fps": (str,),
    "max_fps": (str,),
    "quality": (str,),
    "render": (str,),
    "trajectories": (bool, str),
    "step_trigger": (str,),
    "video_length": (int,),
    "name_prefix": (str,),
    "observations": (bool,),
    "annotate": (bool,),
    "tiled": (bool,),
    "camera": (str, int, dict, list),
    "height": (int,),
    "width": (int,),
    "own_camera": (str, int),
    "seed": (int,),
}


@dataclass(frozen=True, kw_only=True)
class EpisodeInputs:
    """What an episode was begun with, what was done in it, and what cut it off.

    Attributes:
        episode_id: its number.
        type: "t" or "e".
        seed: given to the reset.
        options: given to the reset.
        random_state: of the environment's generators just before the reset, as the
            archive has it. It is used only where no seed leads to it.
        first_state: the name of the array with the state after the reset. It is used
            only where neither a seed nor a random state leads there.
        states: the name of the array of all states, where another MuJoCo or machine is
            claimed: each step is then made from the recorded state before it, so that
            differences of the last bits do not grow; None else.
        steps: how many were taken.
        actions: the name of the array of actions, also where some are irregular; None
            where they were not kept.
        steps_taken: the name of the arrays `<name>.<part>` of `RecordedSteps`, where
            wrappers are not here; None else.
        dtypes: from which step on they were given as which dtype.
        parts: name and shape of the arrays of a dictionary; None for plain arrays.
        irregular: `step`, `value` and, of an array, `dtype` of those that fit into no
            array.
        cut: why the episode is no part of the statistics (`reset`, `close`, `killed`
            ...); None of a complete one.
        exception: what was raised, where that cut it off.
        has_trajectory: its trajectory was kept.
        is_chosen: its video was chosen.
        start_time: a statement, as `end_time`.
        end_time: likewise.
        believed: `reward`, `terminated`, `truncated` and `success` of a complete
            episode. They are used only where actions were not kept.
        evaluation: `seed` and `episode` of an evaluation that it belongs to; None else.
        selection: what its video says of the choice among an evaluation's episodes.
    """

    episode_id: int
    type: str = "t"
    seed: Any = None
    options: Any = None
    random_state: Any = None
    first_state: str | None = None
    states: str | None = None
    steps: int = 0
    actions: str | None = None
    steps_taken: str | None = None
    dtypes: Sequence[tuple[int, str]] = ()
    parts: Sequence[tuple[str, Sequence[int]]] | None = None
    irregular: Sequence[Mapping[str, Any]] = ()
    cut: str | None = None
    exception: Mapping[str, Any] | None = None
    has_trajectory: bool = False
    is_chosen: bool = False
    start_time: float | None = None
    end_time: float | None = None
    believed: Mapping[str, Any] = field(default_factory=dict)
    evaluation: Mapping[str, Any] | None = None
    selection: Mapping[str, Any] | None = None


@dataclass(frozen=True, kw_only=True)
class RecordingInputs:
    """What one monitor recorded, and how it was asked to.

    Attributes:
        infix: what the names of its files have in the middle.
        env_id: the environment's name in the recordings.
        sources: the name of the file with what the author's MJCF model was made from;
            None of other environments.
        environment: `framework`, `id`, `kwargs`, `wrappers`, `wrapper_arguments` and
            `max_episode_steps`; None where the journal does not say.
        options: of the recorder, those that are not the default; see `OPTIONS`.
        schedule: the name of the schedule.
        rule: the name of the rule of `keep`; None where there is none.
        first_episode_id: the number of its first episode.
        kept: the episodes that the rule has chosen in the end.
        clip_starts: the numbers of steps at which clips were begun by a trigger.
        episodes: in their order.
        evaluation_events: kind and facts of what the journal says of an evaluation's
            episodes that began and failed, in its order.
        evaluation_keeps: what the choices among all recordings of an evaluation said.
        monitor_csv_start: the time in Stable-Baselines3's file, a statement; None where
            that was not asked for.
        provenance: the provenance, a statement; None where it was not known.
        provenance_after: how many lines the journal had before it, after its first.
        was_killed: another process has put the recording in order.
        has_sources: it had stored what its models were made from, when it was killed.
        is_closed: it was closed by its monitor.
    """

    infix: str
    env_id: str
    environment: Mapping[str, Any] | None
    sources: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    schedule: str | None = None
    rule: str | None = None
    first_episode_id: int = 0
    kept: Sequence[int] = ()
    clip_starts: Sequence[int] = ()
    episodes: Sequence[EpisodeInputs] = ()
    evaluation_events: Sequence[tuple[str, Mapping[str, Any] | None]] = ()
    evaluation_keeps: Sequence[Mapping[str, Any]] = ()
    monitor_csv_start: float | None = None
    provenance: Mapping[str, Any] | None = None
    provenance_after: int = 0
    was_killed: bool = False
    has_sources: bool = False
    is_closed: bool = False

    @property
    def is_evaluation(self) -> bool:
        """Whether it has an evaluation's episodes."""
        return bool(self.evaluation_events)

    @property
    def failed(self) -> Sequence[Mapping[str, Any]]:
        """What is said of an evaluation's episodes that could not be completed."""
        events = self.evaluation_events
        return [facts for kind, facts in events if kind == "failed" and facts]

    @property
    def name(self) -> str:
        """What findings call it."""
        return f"recording {self.infix}"

    def item(self, episode: EpisodeInputs) -> str:
        """Return what findings call one of its episodes."""
        return f"episode {episode.episode_id} of {self.infix}"


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """All inputs of a packed run, or of a monitor directory.

    Attributes:
        recordings: by the times of their first resets.
        packing: what `mjrec pack` was asked for; empty of a directory.
    """

    recordings: Sequence[RecordingInputs]
    packing: Mapping[str, Any] = field(default_factory=dict)

    def unusual(self) -> dict[str, dict[str, Any]]:
        """Return environments and inputs that are not default, by what they are of."""
        found = {each.name: dict(_unusual(each)) for each in self.recordings}
        packing = {
            name: value
            for name, value in self.packing.items()
            if name in ("episodes", "anonymous", "max_size") and value
        }
        return {name: said for name, said in {**found, "pack": packing}.items() if said}

    def write(self, folder: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write the inputs into a folder, for another process.

        Args:
            folder: an empty one.
            arrays: that the episodes name.
        """
        text = json_text.dumps(dataclasses.asdict(self))
        (folder / INPUTS_FILE).write_text(text)
        np.savez(folder / ARRAYS_FILE, **arrays)  # type: ignore[arg-type]  # its stub takes no mapping

    @classmethod
    def read(cls, folder: Path) -> Inputs:
        """Return the inputs that were written into a folder."""
        said = json_text.loads((folder / INPUTS_FILE).read_text())
        recordings = [
            RecordingInputs(
                **{
                    **recording,
                    "episodes": tuple(
                        EpisodeInputs(**each) for each in recording["episodes"]
                    ),
                }
            )
            for recording in said["recordings"]
        ]
        return cls(recordings=tuple(recordings), packing=said["packing"])


def given_actions(
    episode: EpisodeInputs, arrays: Mapping[str, NDArray[Any]]
) -> Iterator[Any]:
    """Yield the actions of an episode, each of the dtype that it was given in.

    A float32 action may give another reward than the same number as float64 does.

    Args:
        episode: its inputs.
        arrays: recorded actions by the names in the inputs.
    """
    irregular = {int(each["step"]): each for each in episode.irregular}
    recorded = arrays.get(episode.actions or "")
    for step, action in enumerate(_regular(episode, recorded)):
        yield _whole(irregular[step]) if step in irregular else action


def _unusual(recording: RecordingInputs) -> Iterator[tuple[str, Any]]:
    environment = recording.environment or {}
    of_author = ", a model (MJCF) of the author's"
    is_mjcf = environment.get("framework") == "mjcf"
    yield "environment", f"{environment.get('id')}{of_author if is_mjcf else ''}"
    for name, value in (environment.get("kwargs") or {}).items():
        yield f"environment: {name}", value
    if environment.get("max_episode_steps"):
        yield "max_episode_steps", environment["max_episode_steps"]
    if environment.get("wrappers"):
        yield "wrappers", shown_wrappers(environment)
    for name, value in recording.options.items():
        if value is not None:
            yield name, value
    if recording.schedule not in (None, "capped_cubic_video_schedule"):
        yield "schedule", recording.schedule
    if recording.rule is not None:
        yield "keep", recording.rule
    for keep in recording.evaluation_keeps[-1:]:
        yield "keep", str(keep.get("rule"))
    resets = [each.options for each in recording.episodes if each.options]
    if resets:
        different = dict.fromkeys(map(json_text.dumps, resets))
        yield "options of resets", list(map(json_text.loads, different))


def _regular(episode: EpisodeInputs, recorded: NDArray[Any] | None) -> Iterator[Any]:
    if recorded is None:
        yield from itertools.repeat(None, episode.steps)
    elif episode.parts is not None:
        yield from (_split(action, episode.parts) for action in recorded)
    else:
        bounds = [*(step for step, _ in episode.dtypes), len(recorded)]
        names = [name for _, name in episode.dtypes]
        yield from recorded[: bounds[0]]
        for name, (start, stop) in zip(names, itertools.pairwise(bounds), strict=True):
            yield from recorded[start:stop].astype(name)


def _split(action: NDArray[Any], parts: Any) -> dict[str, NDArray[Any]]:
    """Return the dictionary of arrays that one vector was made from."""
    taken: dict[str, NDArray[Any]] = {}
    offset = 0
    for name, shape in parts:
        size = int(np.prod(shape))
        taken[name] = action[offset : offset + size].reshape(shape)
        offset += size
    return taken


def _whole(said: Mapping[str, Any]) -> Any:
    value = said.get("value")
    return value if "dtype" not in said else np.asarray(value, said["dtype"])
