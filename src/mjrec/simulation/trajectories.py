# SPDX-License-Identifier: Apache-2.0
"""Recorded episodes, read back as arrays.

Reading needs no simulator: MuJoCo is imported where a model or its data is asked for.
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
from .foreign_files import open_vetted_trajectory

if TYPE_CHECKING:
    import mujoco

_SHOWN = 10


def load_trajectory(
    path: str | os.PathLike[str], *, trust_models: bool = False
) -> Trajectory:
    """Return a recorded episode.

    Args:
        path: of its `openaigym.trajectory.*.h5`. If the episode is not over, or its
            process was killed, there is no such file yet, and its monitor's log is
            read.
        trust_models: let `model()` and `mjrec.render` load a compiled model that
            another user or machine wrote. A crafted model can run any code; without
            this, the model is compiled from its sources, if they exist.
            `MJREC_TRUST_MODELS=1` does the same for all.

    Raises:
        UnreadableFile: the file is missing, damaged, of a newer format, or hostile.
        InvalidArgument: it is a directory; the message lists its trajectories.
    """
    path = Path(path)
    if path.is_symlink() and infix_of(path.name) is None:
        # The user's own name for a file, `latest.h5`; a link that bears the name of a
        # monitor's file was put there with the directory.
        path = Path(os.path.realpath(path))
    if path.is_dir() or (path.is_file() and is_bundle(path.name)):
        raise InvalidArgument(_what_is_in(path))
    with open_vetted_trajectory(path) as reader:
        return Trajectory(reader, trust_models=trust_models)


class Trajectory:
    """A recorded episode of T steps, with F frames made or promised of it.

    Rows `k` of `states`, `time` and `observations` are what was there after `k` steps;
    row 0 is what was there after the reset. Rows `k` of `actions`, `rewards`,
    `terminated` and `truncated` belong to the step from state `k` to state `k + 1`.

    To make a step again, set state `k`, give the inputs that stand in state `k + 1`,
    and simulate one control step; with the same MuJoCo on the same machine that is
    state `k + 1`, bit for bit, where the environment does nothing but `mj_step`
    (`substeps` times, `frame_skip` in Gymnasium)::

        model = trajectory.model()
        data = mujoco.MjData(model)
        trajectory.set_state(data, k)
        data.ctrl[:] = trajectory.component("ctrl")[k + 1]
        mujoco.mj_step(model, data, nstep=substeps)

    Besides `ctrl` the inputs are `qfrc_applied`, `xfrc_applied`, `eq_active`,
    `mocap_pos`, `mocap_quat` and `userdata`, for environments that use them. An action
    is what the environment was given, which need not be what the actuators were given.

    Snapshots and changes of the model are read when they are asked for; the rest is
    in memory.

    Args:
        reader: of the file; it may be closed afterwards.
        trust_models: whether a compiled model that a stranger wrote is loaded.

    Attributes:
        path: of the file that was read.
        trust_models: as given.
        facts: all that is known besides arrays, as
            `docs/reference/trajectories.md` lists it.
        states: `(T + 1, n) float64`, the physics states (`mjSTATE_INTEGRATION`, in
            MuJoCo's units); n is 0 where there was no simulation. See `component`.
        actions: `(T, *shape)`; None where actions are no plain arrays.
        rewards: `(T,) float64`.
        terminated: `(T,) bool`, the task ended the episode.
        truncated: `(T,) bool`, a limit from outside the task ended it.
        observations: `(T + 1, *shape)`; None where they were not recorded.
        frame_steps: `(F,) int64`, after how many steps each frame was taken.
        dropped: how many rows at the end were torn when its process was killed.
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
        # A stranger's file may name any path.
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
        """What makes the environment again: framework, id, kwargs; None if unknown."""
        return self.facts.get("environment")

    @property
    def episode_id(self) -> int | None:
        """The episode's number in its monitor's run."""
        return self.facts.get("episode_id")

    @property
    def seed(self) -> Any:
        """As it was given to `reset`."""
        return self.facts.get("seed")

    @property
    def complete(self) -> bool:
        """Whether the episode was recorded to its end."""
        return bool(self.facts.get("complete", False))

    @property
    def components(self) -> tuple[str, ...]:
        """The names of what a state consists of: `time`, `qpos`, `qvel`, `ctrl` ..."""
        return tuple(self._columns)

    @property
    def time(self) -> NDArray[np.float64] | None:
        """`(T + 1,)`, the simulation's time in seconds; None without a simulation."""
        return self.component("time")[:, 0] if "time" in self.components else None

    @functools.cached_property
    def snapshots(self) -> dict[str, NDArray[Any]]:
        """What the frames are made from: MuJoCo's arrays by name, `(F, *shape)`.

        Raises:
            UnreadableFile: the file is gone or damaged.
        """
        with open_vetted_trajectory(self.path) as reader:
            rows = reader.snapshots(0, len(self.frame_steps))
        return {name: rows[name].copy() for name in rows.dtype.names or ()}

    def component(self, name: str) -> NDArray[np.float64]:
        """Return a part of the states, `(T + 1, length)`.

        Args:
            name: MuJoCo's, in lower case, one of `components`: `qpos` is
                `(T + 1, nq)`, `time` `(T + 1, 1)`.

        Raises:
            UnknownName: this model's states have no such part.
        """
        if name not in self._columns:
            raise UnknownName("state component", name, self.components)
        return self.states[:, self._columns[name]]

    def model(self, step: int = 0) -> mujoco.MjModel:
        """Return the model as it was in this episode, a new one at each call.

        Args:
            step: after how many steps, where the environment changes its model on the
                way; what it set in the reset is there from step 0 on.

        Raises:
            UnreadableFile: the model beside this file is missing or damaged, or was
                written by another MuJoCo version and not with its sources.
            UntrustedModel: likewise, and it was written by another user.
            InvalidArgument: there is no such step.
        """
        # Here, because reading needs no simulator.
        from .fields import apply_fields
        from .model_store import load_model

        step = self._step(step)
        stored = self.facts.get("model")
        if stored is None:
            raise UnreadableFile(
                self.path, "it was recorded without a MuJoCo simulation to be seen"
            )
        if not isinstance(stored, Mapping):
            raise UnreadableFile(self.path, "what it says of its model is no object")
        model = load_model(self.path.parent, stored, trust_models=self.trust_models)
        try:
            # One at a time: there may be thousands, and each as large as a texture.
            with open_vetted_trajectory(self.path) as reader:
                for change in reader.iter_model_changes():
                    if change.step <= step:
                        apply_fields(model, change.fields)
        except InvalidArgument as error:
            raise UnreadableFile(self.path, error) from error
        return model

    def set_state(self, data: mujoco.MjData, step: int) -> None:
        """Put a recorded state into `data`; what follows from it is not computed.

        Args:
            data: of `model()`.
            step: after how many steps; -1 is the last.

        Raises:
            InvalidArgument: there is no such step, or the state is not one of the
                data's model.
        """
        # Here, because reading needs no simulator.
        from .states import set_state

        row = self.states[self._step(step)]
        set_state(data.model, data, self._columns, row)

    def _step(self, step: int) -> int:
        count = len(self.states)
        if isinstance(step, bool) or not isinstance(step, int | np.integer):
            raise InvalidArgument(f"A step is a whole number, got {step!r}.")
        if not -count <= step < count:
            raise InvalidArgument(
                f"{self.path.name} holds {count} states, counted from 0; there is no "
                f"state {step}."
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
        return f"{path} is a {kind}, and holds no trajectories."
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return (
        f"{path} is a {kind}. Name one of the trajectories in it: "
        f"{', '.join(names[:_SHOWN])}{more}."
    )
