# SPDX-License-Identifier: Apache-2.0
"""The inputs of a run: everything taken from an archive to recreate the run.

The list is complete. Everything else is an output and must be reproduced: states,
rewards, episode ends, statistics, frames, videos. The report lists each input that is
not the default.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .. import json_text
from ..environments.scenes import shown_wrappers
from ..formats.json_fields import from_json, to_json

INPUTS_FILE: Final = "inputs.json"
ARRAYS_FILE: Final = "arrays.npz"

# The options in a journal that are inputs, and the types that each may have.
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


# Inputs that change nothing but videos.
_OF_VIDEOS: Final = frozenset(
    (
        *("render_mode", "width", "height", "camera", "own_camera", "fps", "max_fps"),
        *("quality", "render", "annotate", "tiled"),
    )
)
_DTYPES: Final = frozenset(
    f"{kind}{bits}" for kind in ("float", "int", "uint") for bits in (8, 16, 32, 64)
) | {"bool"}


def count(value: Any) -> int:
    """Return a value unchanged if it is a valid count."""
    if type(value) is not int or value < 0:
        raise ValueError(f"{value!r:.80} is not a valid count")
    return value


def _dtype(name: Any) -> str:
    if name not in _DTYPES:
        raise ValueError(f"actions cannot have the dtype {name!r:.80}")
    return str(name)


Count: TypeAlias = Annotated[int, count]
Dtype: TypeAlias = Annotated[str, _dtype]


@dataclass(frozen=True, kw_only=True)
class EpisodeInputs:
    """The inputs of one episode: its reset, its actions, and any cut-off.

    Attributes:
        episode_id: the episode's number.
        type: "t" or "e".
        seed: the seed given to the reset.
        options: the options given to the reset.
        random_state: the state of the environment's random generators just before the
            reset, according to the archive. It is used only if no seed produces it.
        steps: number of steps taken.
        arrays: the name of its arrays; None if it has no trajectory. The array with
            this name contains the regular actions. `<name>.state` is the state after
            the reset; it is used only if neither a seed nor a random state reproduces
            it. `<name>.states` contains all states if the archive claims a different
            MuJoCo version or machine: each step then starts from the recorded state
            before it, so that differences in the last bits do not grow. `<name>.<part>`
            are the parts of `RecordedSteps` if the environment has wrappers.
        played: a digest of its recorded positions, velocities and rewards; None if it
            has no states. It is used only to find equal episodes.
        has_actions: whether the actions were kept, in the array or as irregular values.
        action_dtypes: pairs of a step and the dtype of the actions from that step on.
        action_parts: names and shapes of the arrays in a dictionary action; None if
            actions are plain arrays.
        irregular: `step`, `value` and, for an array, `dtype` of each action that does
            not fit into the array.
        cut: the reason why the episode is not in the statistics (`reset`, `close`,
            `killed` ...); None for a complete episode.
        exception: the exception, if one cut the episode off.
        broken: for each live video that was cut short, the reason and the number of
            frames kept; keyed by the video's name without extension.
        lost: if a fault ended its trajectory early, or left none, the fault's reason
            and the number of missing steps (1 if it is unknown); otherwise None.
        has_trajectory: whether its trajectory was kept.
        is_chosen: whether its video was chosen.
        start_time: the stated start time.
        end_time: the stated end time.
        believed: `reward`, `terminated`, `truncated` and `success` of a complete
            episode. They are used only if actions were not kept or were lost.
        evaluation: its `seed` and `episode` in an evaluation; None outside evaluations.
        selection: its video's facts about the choice among an evaluation's episodes.
    """

    episode_id: int
    type: str = "t"
    seed: Any = None
    options: Any = None
    random_state: Any = None
    steps: int = 0
    arrays: str | None = None
    played: str | None = None
    has_actions: bool = False
    action_dtypes: Sequence[tuple[Count, Dtype]] = ()
    action_parts: Sequence[tuple[str, Sequence[Count]]] | None = None
    irregular: Sequence[Mapping[str, Any]] = ()
    cut: str | None = None
    exception: Mapping[str, Any] | None = None
    broken: Mapping[str, tuple[str, int]] = field(default_factory=dict)
    lost: tuple[str, int] | None = None
    has_trajectory: bool = False
    is_chosen: bool = False
    start_time: float | None = None
    end_time: float | None = None
    believed: Mapping[str, Any] = field(default_factory=dict)
    evaluation: Mapping[str, Any] | None = None
    selection: Mapping[str, Any] | None = None


@dataclass(frozen=True, kw_only=True)
class RecordingInputs:
    """The inputs of one monitor's recording: its options and its episodes.

    Attributes:
        infix: the middle part of its files' names.
        env_id: the environment's name in the recordings.
        sources: the name of the file with the sources of the author's MJCF model; None
            for other environments.
        environment: `framework`, `id`, `kwargs`, `wrappers`, `wrapper_arguments` and
            `max_episode_steps`; None if they are not in the journal.
        is_elsewhere: whether the journal claims other versions than those here.
        options: the recorder's options that are not the default; see `OPTIONS`.
        schedule: the name of the schedule.
        rule: the name of the `keep` rule, or None.
        first_episode_id: the number of its first episode.
        kept: the episodes that the rule chose in the end.
        clip_starts: the numbers of the steps at which a trigger started clips.
        episodes: the episodes, in order.
        evaluation_events: the journal's events ("begun" or "failed") about episodes of
            an evaluation, each as its kind and facts, in the journal's order.
        evaluation_keeps: the facts about each choice among all recordings of an
            evaluation.
        faults: for each fault of the recorder, the number of journal lines before it
            (not counting the first) and its facts.
        monitor_csv_start: the time stated in Stable-Baselines3's file; None if that
            file was not requested.
        provenance: the stated provenance, or None if unknown.
        provenance_after: number of lines in the journal before the provenance, not
            counting the first.
        was_killed: whether another process recovered the recording.
        has_sources: whether the models' sources had been stored when it was killed.
    """

    infix: str
    env_id: str
    environment: Mapping[str, Any] | None
    is_elsewhere: bool = False
    sources: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    schedule: str | None = None
    rule: str | None = None
    first_episode_id: Count = 0
    kept: Sequence[int] = ()
    clip_starts: Sequence[int] = ()
    episodes: Sequence[EpisodeInputs] = ()
    evaluation_events: Sequence[tuple[str, Mapping[str, Any] | None]] = ()
    evaluation_keeps: Sequence[Mapping[str, Any]] = ()
    faults: Sequence[tuple[int, Mapping[str, Any]]] = ()
    monitor_csv_start: float | None = None
    provenance: Mapping[str, Any] | None = None
    provenance_after: int = 0
    was_killed: bool = False
    has_sources: bool = False

    @property
    def is_evaluation(self) -> bool:
        """Whether the recording contains episodes of an evaluation."""
        return bool(self.evaluation_events)

    @property
    def failed(self) -> Sequence[Mapping[str, Any]]:
        """The facts about each failed episode of an evaluation."""
        events = self.evaluation_events
        return [facts for kind, facts in events if kind == "failed" and facts]

    @property
    def name(self) -> str:
        """The recording's name in findings."""
        return f"recording {self.infix}"

    def item(self, episode: EpisodeInputs) -> str:
        """Return the name that findings use for an episode."""
        return f"episode {episode.episode_id} of {self.infix}"


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """All inputs of a packed run, or of a monitor directory.

    Attributes:
        recordings: the recordings, sorted by the times of their first resets.
        packing: the options of `mjrec pack`; empty for a monitor directory.
        planned: number of episodes in the plan of an evaluation, otherwise None.
    """

    recordings: Sequence[RecordingInputs]
    packing: Mapping[str, Any] = field(default_factory=dict)
    planned: int | None = None

    def unusual(self) -> dict[str, dict[str, Any]]:
        """Return environments and non-default inputs, keyed by recording or "pack"."""
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
            folder: an empty folder.
            arrays: the arrays that the episodes refer to.
        """
        text = json_text.dumps(to_json(self))
        (folder / INPUTS_FILE).write_text(text)
        np.savez(folder / ARRAYS_FILE, **arrays)  # type: ignore[arg-type]  # its stub takes no mapping

    @classmethod
    def read(cls, folder: Path) -> Inputs:
        """Read the inputs that `write` wrote into a folder."""
        return from_json(cls, json_text.loads((folder / INPUTS_FILE).read_text()))


def given_actions(
    episode: EpisodeInputs, arrays: Mapping[str, NDArray[Any]]
) -> Iterator[Any]:
    """Yield the actions of an episode, each with its original dtype.

    A float32 action may give a different reward from the same number as float64.

    Args:
        episode: the episode's inputs.
        arrays: the recorded actions, keyed by their names in the inputs.
    """
    irregular = {int(each["step"]): each for each in episode.irregular}
    recorded = arrays.get(episode.arrays or "")
    for step, action in enumerate(_regular(episode, recorded)):
        yield _whole(irregular[step]) if step in irregular else action


def _unusual(recording: RecordingInputs) -> Iterator[tuple[str, Any]]:
    environment = recording.environment or {}
    of_author = ", the author's own model (MJCF)"
    is_mjcf = environment.get("framework") == "mjcf"
    yield "environment", f"{environment.get('id')}{of_author if is_mjcf else ''}"
    unused = frozenset() if _may_have_videos(recording) else _OF_VIDEOS
    for name, value in (environment.get("kwargs") or {}).items():
        if name not in unused:
            yield f"environment: {name}", value
    if environment.get("max_episode_steps"):
        yield "max_episode_steps", environment["max_episode_steps"]
    if environment.get("wrappers"):
        yield "wrappers", shown_wrappers(environment)
    for name, value in recording.options.items():
        if value is not None and name not in unused:
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


def _may_have_videos(recording: RecordingInputs) -> bool:
    chosen = recording.rule, recording.options.get("step_trigger")
    is_kept = bool(recording.evaluation_keeps) or any(chosen)
    return is_kept or recording.schedule != "disable_videos"


def _regular(episode: EpisodeInputs, recorded: NDArray[Any] | None) -> Iterator[Any]:
    if recorded is None:
        yield from itertools.repeat(None, episode.steps)
    elif episode.action_parts is not None:
        yield from (_split(action, episode.action_parts) for action in recorded)
    else:
        bounds = [*(step for step, _ in episode.action_dtypes), len(recorded)]
        names = [name for _, name in episode.action_dtypes]
        yield from recorded[: bounds[0]]
        for name, (start, stop) in zip(names, itertools.pairwise(bounds), strict=True):
            yield from recorded[start:stop].astype(name)


def _split(action: NDArray[Any], parts: Any) -> dict[str, NDArray[Any]]:
    """Return the dictionary of arrays that one vector was concatenated from."""
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
