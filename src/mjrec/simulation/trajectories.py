# SPDX-License-Identifier: Apache-2.0
"""Recorded episodes, read back as arrays.

Reading needs no simulator. MuJoCo is imported only for a model or its data.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument, UnknownName, UnreadableFile
from ..formats.bundle import finished_trajectories, trajectories_in
from ..formats.monitor_directory import infix_of, is_bundle
from ..formats.notebook import shown
from ..formats.spans import recordings_in_flight
from ..formats.trajectory import TrajectoryReader
from ..plain_text import listed
from .foreign_files import open_vetted_trajectory

if TYPE_CHECKING:
    import mujoco

_SHOWN = 10


def load_trajectory(
    path: str | os.PathLike[str], *, trust_models: bool = False
) -> Trajectory:
    """Load a recorded episode.

    Args:
        path: the episode's file, `openaigym.trajectory.*.h5`. If the episode is still
            running, or its process was killed, this file does not exist, and the
            monitor's log is read instead.
        trust_models: whether `model()` and `mjrec.render` may load a compiled model
            that another user or machine wrote. A crafted model can run any code. If
            False, the model is compiled from its sources, if they exist.
            `MJREC_TRUST_MODELS=1` allows loading all compiled models.

    Raises:
        UnreadableFile: the file is missing, damaged or hostile, or has a newer format.
        InvalidArgument: the path is a directory; the message lists its trajectories.
    """
    path = Path(path)
    if path.is_symlink() and infix_of(path.name) is None:
        # A link such as `latest.h5` is the user's own. A link that has a monitor file's
        # name may be part of an untrusted directory.
        path = Path(os.path.realpath(path))
    if path.is_dir() or (path.is_file() and is_bundle(path.name)):
        raise InvalidArgument(_what_is_in(path))
    with open_vetted_trajectory(path) as reader:
        return Trajectory(reader, trust_models=trust_models)


class Trajectory:
    """A recorded episode of T steps, with F frames that may still have to be rendered.

    Row `k` of `states`, `time` and `observations` is the value after `k` steps, and row
    0 is the value after the reset. Row `k` of `actions`, `rewards`, `terminated` and
    `truncated` belongs to the step from state `k` to state `k + 1`.

    To reproduce a step, set state `k`, set the inputs stored in state `k + 1`, and
    simulate one control step. With the same MuJoCo version on the same machine, the
    result is state `k + 1`, bit for bit, if the environment does nothing but call
    `mj_step` (`substeps` times; Gymnasium calls this number `frame_skip`)::

        model = trajectory.model()
        data = mujoco.MjData(model)
        trajectory.set_state(data, k)
        data.ctrl[:] = trajectory.component("ctrl")[k + 1]
        mujoco.mj_step(model, data, nstep=substeps)

    In addition to `ctrl`, the inputs are `qfrc_applied`, `xfrc_applied`, `eq_active`,
    `mocap_pos`, `mocap_quat` and `userdata`, for environments that use them. An action
    is the input to the environment, which may differ from the input to the actuators.

    Snapshots and changes to the model are read on demand; all other data is in memory.

    Args:
        reader: the file's reader; it may be closed afterwards.
        trust_models: whether to load an untrusted compiled model.

    Attributes:
        path: the file that was read.
        trust_models: whether to load an untrusted compiled model.
        facts: all metadata, as listed in `docs/reference/trajectories.md`.
        states: `(T + 1, n) float64`, the physics states (`mjSTATE_INTEGRATION`, in
            MuJoCo's units); n is 0 if there was no simulation. See `component`.
        actions: `(T, *shape)`; None if actions are not plain arrays.
        rewards: `(T,) float64`.
        terminated: `(T,) bool`, whether the task ended the episode.
        truncated: `(T,) bool`, whether a limit outside the task ended the episode.
        observations: `(T + 1, *shape)`; None if they were not recorded.
        frame_steps: `(F,) int64`, the number of steps before each frame.
        dropped: number of rows at the end that were incomplete because the process was
            killed.
    """

    def __init__(self, reader: TrajectoryReader, *, trust_models: bool = False) -> None:
        count, row_count = reader.step_count, reader.row_count
        self.path = reader.path
        self.trust_models = trust_models
        self.facts = reader.facts
        self.states = reader.states(0, row_count)
        self.actions = reader.actions(0, count)
        self.rewards = reader.rewards
        self.terminated = reader.terminated
        self.truncated = reader.truncated
        self.observations = reader.observations(0, row_count)
        self.frame_steps = reader.frame_steps
        self.dropped = reader.dropped
        self._columns = reader.columns

    def __len__(self) -> int:
        """Return T, the number of steps."""
        return len(self.rewards)

    def __repr__(self) -> str:
        ending = "" if self.complete else ", incomplete"
        return (
            f"<Trajectory {self.path.name}: {self.env_id}, {len(self)} steps{ending}>"
        )

    def _repr_html_(self) -> str:
        """Show the episode in a notebook: its numbers and its video."""
        title = f"{self.env_id}, episode {self.episode_id}"
        facts = {
            "steps": len(self),
            "return": float(self.rewards.sum()),
            "seed": self.seed,
            "state": f"{len(self.states)} x {self.states.shape[1]}",
            "frames": len(self.frame_steps),
            "ended": None if self.complete else "incomplete",
        }
        return shown(title, facts, self._videos())

    def _videos(self) -> list[Path]:
        video = self.facts.get("video")
        name = video.get("name") if isinstance(video, Mapping) else None
        # An untrusted file may name any path.
        if not isinstance(name, str) or Path(name).name != name:
            return []
        path = self.path.parent / name
        return [path] if path.is_file() else []

    @property
    def env_id(self) -> str | None:
        """The environment's name, as in the manifest."""
        return self.facts.get("env_id")

    @property
    def environment(self) -> dict[str, Any] | None:
        """The framework, id and kwargs that recreate the environment, or None."""
        return self.facts.get("environment")

    @property
    def episode_id(self) -> int | None:
        """The episode's number in its monitor's run."""
        return self.facts.get("episode_id")

    @property
    def seed(self) -> Any:
        """The seed, as passed to `reset`."""
        return self.facts.get("seed")

    @property
    def complete(self) -> bool:
        """Whether the episode was recorded to the end."""
        return bool(self.facts.get("complete", False))

    @property
    def components(self) -> tuple[str, ...]:
        """The names of a state's components: `time`, `qpos`, `qvel`, `ctrl` ..."""
        return tuple(self._columns)

    @property
    def time(self) -> NDArray[np.float64] | None:
        """The simulation time in seconds, `(T + 1,)`, or None without a simulation."""
        return self.component("time")[:, 0] if "time" in self.components else None

    @functools.cached_property
    def snapshots(self) -> dict[str, NDArray[Any]]:
        """The arrays used to draw frames, `(F, *shape)`, keyed by their MuJoCo names.

        Raises:
            UnreadableFile: the file has been removed or is damaged.
        """
        with open_vetted_trajectory(self.path) as reader:
            rows = reader.snapshots(0, len(self.frame_steps))
        return {name: rows[name].copy() for name in rows.dtype.names or ()}

    def component(self, name: str) -> NDArray[np.float64]:
        """Return a component of the states, `(T + 1, length)`.

        Args:
            name: one of `components`, MuJoCo's name in lower case. `qpos` is
                `(T + 1, nq)`, `time` is `(T + 1, 1)`.

        Raises:
            UnknownName: this model's states have no such component.
        """
        if name not in self._columns:
            raise UnknownName("state component", name, self.components)
        return self.states[:, self._columns[name]]

    def model(self, step: int = 0) -> mujoco.MjModel:
        """Return a new copy of the model as it was in this episode.

        Args:
            step: the number of steps taken, which matters if the environment changes
                its model during the episode. Changes made by the reset are included
                from step 0 on.

        Raises:
            UnreadableFile: the model next to this file is missing or damaged, or was
                written by another MuJoCo version without its sources.
            UntrustedModel: the model cannot be compiled from its sources, and was
                compiled by another user.
            InvalidArgument: the step does not exist.
        """
        # Imported here, because reading needs no simulator.
        from .fields import apply_fields
        from .model_store import load_model

        step = self._step(step)
        stored = self.facts.get("model")
        if stored is None:
            raise UnreadableFile(
                self.path, "no MuJoCo simulation was found when it was recorded"
            )
        if not isinstance(stored, Mapping):
            raise UnreadableFile(self.path, "its metadata about the model is invalid")
        model = load_model(self.path.parent, stored, trust_models=self.trust_models)
        try:
            # Apply one change at a time, because there may be thousands of changes,
            # each as large as a texture.
            with open_vetted_trajectory(self.path) as reader:
                for change in reader.iter_model_changes():
                    if change.step <= step:
                        apply_fields(model, change.fields)
        except InvalidArgument as error:
            raise UnreadableFile(self.path, error) from error
        return model

    def set_state(self, data: mujoco.MjData, step: int) -> None:
        """Write a recorded state into `data`, without computing derived quantities.

        Args:
            data: a `mujoco.MjData` of `model()`.
            step: the number of steps taken; -1 means the last state.

        Raises:
            InvalidArgument: the step does not exist, or the state does not belong to
                the data's model.
        """
        # Imported here, because reading needs no simulator.
        from .states import set_state

        row = self.states[self._step(step)]
        set_state(data.model, data, self._columns, row)

    def _step(self, step: int) -> int:
        count = len(self.states)
        if isinstance(step, bool) or not isinstance(step, int | np.integer):
            raise InvalidArgument(f"A step must be a whole number, not {step!r}.")
        if not -count <= step < count:
            raise InvalidArgument(
                f"{self.path.name} contains {count} states, counted from 0, so state "
                f"{step} does not exist."
            )
        return step % count


def _what_is_in(path: Path) -> str:
    if is_bundle(path.name):
        kind, names = "bundle", [each.name for each in trajectories_in(path)]
    else:
        kind = "directory"
        finished = (each.name for each in finished_trajectories(path))
        in_flight = (each.path.name for each in recordings_in_flight(path))
        names = sorted({*finished, *in_flight})
    if not names:
        return f"{path} is a {kind} without trajectories."
    shown = listed(names, _SHOWN)
    return f"{path} is a {kind}. Choose one of its trajectories: {shown}."
