# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from trajectories_by_hand import INFIX, new_logs
from trajectory_contents import TrajectoryContent, content_of

from mjrec.errors import FileNotWritten, PicturesDiffer
from mjrec.formats.monitor_directory import trajectory_prefix
from mjrec.formats.span_writer import SpanWriter
from mjrec.formats.spans import recordings_in_flight
from mjrec.formats.trajectory import packed
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.recorder.trajectory_recorder import Pace, TrajectoryRecorder
from mjrec.simulation.capture import EpisodeStart


class Counter:
    """A simulation whose state is the number of the step, 0.02 seconds each."""

    timestep = 0.02

    def __init__(self) -> None:
        self.step = 0
        self.changes: dict[int, Mapping[str, Any]] = {}
        self.hidden_from = self.gone_from = 10**6

    start = EpisodeStart(
        state=packed([("time", ("<f8", (1,))), ("qpos", ("<f8", (2,)))]),
        snapshot=packed([("geom_xpos", ("<f8", (1, 3)))]),
        model={"sha256": "ab"},
        scene={"height": 48},
        model_fields={"geom_rgba": np.ones((1, 4), np.float32)},
    )

    def open(self, directory: Path) -> None: ...
    def resetting(self) -> Any:
        return contextlib.nullcontext()

    def begin_episode(self) -> EpisodeStart:
        return self.start

    def capture_state(self, out: Any) -> None:
        if self.step >= self.gone_from:
            raise PicturesDiffer("it is another simulation")
        out[:] = (self.time(), self.step, -self.step)

    def changed_fields(self) -> Mapping[str, Any] | None:
        return self.changes.get(self.step)

    def capture_snapshot(self, out: Any) -> Mapping[str, Any] | None:
        if self.step >= self.hidden_from:
            raise PicturesDiffer("a marker is in the way")
        out.view(np.float64)[:] = self.step
        return self.changes.get(self.step)

    def time(self) -> float:
        return self.step * self.timestep

    def model_changed(self) -> None: ...
    def forget_pictures(self) -> None: ...
    def finish(self) -> None: ...
    def close(self) -> None: ...


def recorder(
    path: Path,
    states: Any,
    *,
    max_fps: Any = None,
    observation: Any = None,
) -> TrajectoryRecorder:
    """Return the recorder of an episode of `states`."""
    return TrajectoryRecorder(
        new_logs(path.parent),
        path.stem,
        facts={"episode_id": 3},
        states=states,
        start=None if states is None else states.start,
        pace=Pace(
            clock=(lambda: None) if states is None else states.time,
            declared=lambda: Fraction(30),
            max_fps=max_fps,
        ),
        observation=observation,
    )


def play(
    recorder: TrajectoryRecorder,
    states: Counter,
    steps: int,
    *,
    done: bool = True,
    observe: Callable[[int], Any] = lambda _: None,
) -> None:
    """Take so many steps, the last of which ends the episode if it is `done`."""
    for step in range(1, steps + 1):
        recorder.before_step(np.full(2, step, np.float32))
        states.step = step
        last = done and step == steps
        recorder.step(step / 2, last, False, observe(step), last, True)


NAME = f"{trajectory_prefix(INFIX, 3)}.h5"


def content(path: Path) -> TrajectoryContent:
    """Return what a log has of a trajectory."""
    with open_trajectory(path) as reader:
        return content_of(reader)


def test_a_row_a_step_and_a_frame_a_step(tmp_path: Path) -> None:
    """States, actions, rewards, flags and snapshots, those of the reset included."""
    states, path = Counter(), tmp_path / NAME
    trajectory = recorder(path, states)
    play(trajectory, states, 3)
    trajectory.end({"complete": True})
    read = content(path)
    assert read.states.tolist() == [[k * 0.02, k, -k] for k in range(4)]
    assert read.actions is not None
    assert read.actions.tolist() == [[1, 1], [2, 2], [3, 3]]
    assert read.rewards.tolist() == [0.5, 1, 1.5]
    assert read.terminated.tolist() == [False, False, True]
    assert not read.truncated.any()
    assert read.frame_steps.tolist() == [0, 1, 2, 3]
    positions = read.snapshots["geom_xpos"]
    assert positions[:, 0, 0].tolist() == [0, 1, 2, 3]
    facts = read.facts
    assert (facts["rate"], facts["timestep"], facts["stride"]) == ("50", "1/50", 1)
    assert facts["complete"] is True
    assert trajectory.frame_count == 4


@pytest.mark.parametrize(
    ("max_fps", "steps", "frames"),
    [
        (25, 7, [0, 2, 4, 6, 7]),
        (24, 6, [0, 3, 6]),
        (50, 2, [0, 1, 2]),
        (1, 4, [0, 4]),
    ],
)
def test_every_nth_step_and_the_last(
    tmp_path: Path, max_fps: int, steps: int, frames: list[int]
) -> None:
    """With the smallest n that keeps to max_fps."""
    states, path = Counter(), tmp_path / NAME
    trajectory = recorder(path, states, max_fps=max_fps)
    play(trajectory, states, steps)
    trajectory.end({})
    read = content(path)
    assert read.frame_steps.tolist() == frames
    assert read.states[:, 1].tolist() == list(range(steps + 1))


def test_reset_alone_leaves_nothing_until_the_end(tmp_path: Path) -> None:
    """A reset that is replaced has no log; one that is the end has a frame."""
    states, path = Counter(), tmp_path / NAME
    recorder(path, states).discard()
    assert list(tmp_path.iterdir()) == []
    trajectory = recorder(path, states)
    trajectory.end({"complete": False})
    trajectory.end({"complete": True})
    read = content(path)
    assert (len(read.states), len(read.rewards), read.frame_steps.tolist()) == (
        1,
        0,
        [0],
    )
    assert read.facts["rate"] == "30"
    assert read.facts["complete"] is False


def test_without_a_simulation_there_are_actions_and_rewards(tmp_path: Path) -> None:
    """For environments whose state nobody can see."""
    path = tmp_path / NAME
    trajectory = recorder(path, None)
    trajectory.before_step(1)
    trajectory.step(1.0, True, False, None, True, True)
    trajectory.end({})
    read = content(path)
    assert read.states.shape == (2, 0)
    assert read.actions is not None
    assert (read.actions.tolist(), read.rewards.tolist()) == ([1], [1.0])
    assert read.frame_steps.size == 0
    assert read.facts["timestep"] is None


def test_dictionaries_say_what_they_were_made_from(tmp_path: Path) -> None:
    """The names and shapes of their arrays, in order."""
    states, path = Counter(), tmp_path / NAME
    first = {"goal": np.zeros(2), "speed": 1.0}
    trajectory = recorder(path, states, observation=first)
    play(trajectory, states, 1, observe=lambda _: {"goal": np.ones(2), "speed": 2.0})
    trajectory.end({})
    read = content(path)
    assert read.observations is not None
    assert read.observations.tolist() == [[0, 0, 1], [1, 1, 2]]
    parts = read.facts["observation_parts"]
    assert parts == [["goal", [2]], ["speed", []]]


def test_state_after_an_environments_own_reset_is_not_a_number(tmp_path: Path) -> None:
    """It belongs to the next episode; there is no frame of it either."""
    states, path = Counter(), tmp_path / NAME
    trajectory = recorder(path, states)
    trajectory.before_step(np.zeros(2))
    trajectory.step(0.0, True, False, None, True, False)
    trajectory.end({})
    read = content(path)
    assert np.isnan(read.states[1]).all()
    assert read.frame_steps.tolist() == [0]


def test_frames_stop_where_they_would_differ(tmp_path: Path) -> None:
    """States and changes of the model go on; the facts say why frames do not."""
    states, path = Counter(), tmp_path / NAME
    states.hidden_from = 2
    states.changes[3] = {"site_rgba": np.zeros((1, 4), np.float32)}
    trajectory = recorder(path, states)
    with pytest.raises(PicturesDiffer):
        play(trajectory, states, 2, done=False)
    trajectory.stop_frames("a marker is in the way")
    trajectory.before_step(np.zeros(2))
    states.step = 3
    trajectory.step(0.0, True, False, None, True, True)
    trajectory.end({})
    read = content(path)
    assert (len(read.rewards), read.frame_steps.tolist()) == (3, [0, 1])
    changes = [(c.step, list(c.fields)) for c in read.model_changes]
    assert changes == [(0, ["geom_rgba"]), (3, ["site_rgba"])]
    assert read.facts["broken_reason"] == "a marker is in the way"


def test_step_without_a_state_is_a_step_all_the_same(tmp_path: Path) -> None:
    """Its state is not a number; rewards and actions go on, and it is told once."""
    states, path = Counter(), tmp_path / NAME
    states.gone_from = 2
    trajectory = recorder(path, states)
    with pytest.raises(PicturesDiffer):
        play(trajectory, states, 2, done=False)
    trajectory.stop_frames("it is another simulation")
    trajectory.before_step(np.full(2, 3.0))
    trajectory.step(1.5, True, False, None, True, True)
    trajectory.end({})
    read = content(path)
    assert np.isnan(read.states).all(axis=1).tolist() == [False, False, True, True]
    assert read.rewards.tolist() == [0.5, 1, 1.5]
    assert read.actions is not None
    assert read.actions[-1].tolist() == [3, 3]


@pytest.mark.parametrize("place", ["make_room", "commit"])
def test_an_interrupted_beginning_is_begun_anew(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recording without its first frame would promise a video of nothing."""
    path = tmp_path / NAME
    trajectory = recorder(path, Counter())

    def handler(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(SpanWriter, place, handler)
        trajectory.before_step(np.zeros(2))
        with pytest.raises(KeyboardInterrupt):
            trajectory.step(0.0, False, False, None, False, True)
    trajectory.end({"complete": False})
    read = content(path)
    assert read.states.tolist() == [[0, 0, 0]]
    assert read.frame_steps.tolist() == [0]
    assert len(recordings_in_flight(tmp_path)) == 1


def test_what_is_said_first_of_the_end_counts(tmp_path: Path) -> None:
    """Also where it could not be written then, and is again with other facts."""
    directory = tmp_path / "d"
    directory.mkdir()
    states, path = Counter(), directory / NAME
    trajectory = recorder(path, states)
    play(trajectory, states, 2)
    directory.rename(tmp_path / "elsewhere")
    with pytest.raises(FileNotWritten):
        trajectory.end({"complete": True})
    (tmp_path / "elsewhere").rename(directory)
    trajectory.end({"complete": False, "reason": "reset"})
    facts = content(path).facts
    assert facts["complete"] is True
    assert "reason" not in facts


def test_nothing_is_recorded_after_a_stop(tmp_path: Path) -> None:
    """What there was stays, with the reason."""
    states, path = Counter(), tmp_path / NAME
    trajectory = recorder(path, states)
    play(trajectory, states, 1, done=False)
    trajectory.stop("the disk is full")
    play(trajectory, states, 2, done=False)
    trajectory.take_frame()
    trajectory.end({"complete": False})
    read = content(path)
    assert (len(read.rewards), read.frame_steps.tolist()) == (1, [0, 1])
    assert read.facts["broken_reason"] == "the disk is full"
