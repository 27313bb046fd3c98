# SPDX-License-Identifier: Apache-2.0
"""Which recorded pictures are drawn from what follows from the recorded states."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from forged_episodes import copied, episode, forge, physics_of
from parts import parametrize
from trajectory_contents import content_of

import mjrec
from mjrec.environments.mjcf_environments import MjcfEnvironment
from mjrec.evidence.verification import Check, Verdict
from mjrec.formats.trajectory import ModelChange, packed
from mjrec.formats.trajectory_file import open_trajectory

needs_dm_control = pytest.mark.skipif(
    importlib.util.find_spec("dm_control") is None, reason="dm_control is not installed"
)

# A path over the cylinder and one beside it, a reading that is drawn and one that is
# not, and frames of two and of three physics steps.
MACHINE = """<mujoco><option timestep="0.007"/><worldbody>
  <light pos="0 0 3" mode="targetbodycom" target="ball"/>
  <camera name="beside" mode="trackcom" pos="0 -3 1"/>
  <geom type="plane" size="1 1 .1"/><site name="top" pos="0 0 1"/>
  <geom name="round" type="cylinder" size=".1 .2" pos=".5 0 .7" euler="90 0 0"/>
  <body name="ball" pos="0 0 .3"><freejoint/><geom size=".1"/>
    <site name="eye" size=".01"/></body>
  <body pos="1 0 1"><joint name="hinge"/><geom size=".1" pos=".2 0 0"/>
    <site name="arm" pos=".1 0 -.1"/></body>
</worldbody>
<tendon><spatial limited="true" range="0 .5"><site site="top"/><geom geom="round"/>
  <site site="arm"/></spatial></tendon>
<sensor><rangefinder site="eye"/><accelerometer site="eye"/></sensor>
<actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""

OTHER_MACHINE = {"architecture": "abacus", "libc": "none", "cpu_flags": ""}


def record(directory: Path, env: Any, *, steps: int = 8, **options: Any) -> Path:
    """Record an episode of random actions, with a small video."""
    monitor: Any = mjrec.Monitor(env, directory, workers=1, **options)
    generator = np.random.default_rng(3)
    suited = hasattr(env, "action_spec")
    space = env.action_spec() if suited else env.action_space
    monitor.reset() if suited else monitor.reset(seed=5)
    for _ in range(steps):
        action = generator.uniform(-0.3, 0.3, space.shape)
        step = monitor.step(action if suited else action.astype(space.dtype))
        if not suited and (step[2] or step[3]):
            break
    monitor.close()
    return directory


def record_gymnasium(directory: Path, name: str) -> Path:
    """Record an episode of one of Gymnasium's."""
    env = gymnasium.make(
        name, render_mode="rgb_array", width=16, height=16, max_episode_steps=8
    )
    return record(directory, env)


def of_pictures(directory: Path) -> Check:
    """Return what is said of what the pictures are drawn from."""
    [check] = [c for c in physics_of(directory) if "drawn from" in c.claim]
    return check


@pytest.fixture(scope="session")
def pusher(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An episode of Pusher-v5, which is not to be changed."""
    return record_gymnasium(tmp_path_factory.mktemp("drawn") / "run", "Pusher-v5")


def changed(field: str, rows: slice | int, by: float) -> Any:
    """Return what adds something to the last number of a field of the snapshots."""

    def edit(directory: Path) -> None:
        path = episode(directory)

        def add(snapshots: Any) -> None:
            values = snapshots[field].reshape(len(snapshots), -1)
            values[rows, -1] += by
            snapshots[field] = values.reshape(snapshots[field].shape)

        forge(path, snapshots=add)

    return edit


@parametrize("name", ["HalfCheetah-v5", "Hopper-v5", "Ant-v5"])
def test_gymnasium_draws_what_steps_leave(name: str, tmp_path: Path) -> None:
    """Bodies are where they were before the last physics step."""
    check = of_pictures(record_gymnasium(tmp_path / "run", name))
    assert check.verdict is Verdict.PASS
    assert check.reason == "bit for bit, 9 pictures"


@pytest.mark.thorough
@needs_dm_control
@pytest.mark.parametrize(
    "task", ["reacher-easy", "finger-turn_hard", "point_mass-hard", "ball_in_cup-catch"]
)
def test_suite_draws_what_is_computed_anew(task: str, tmp_path: Path) -> None:
    """Also where the reset moves sites and the model."""
    from dm_control import suite

    env = suite.load(*task.split("-"))
    options: dict[str, Any] = {
        "height": 16,
        "width": 16,
        "env_id": f"dm_control/{task}",
    }
    check = of_pictures(record(tmp_path / "run", env, **options))
    assert check.verdict is Verdict.PASS
    assert check.reason == "bit for bit, 9 pictures"


def test_mjcf_draws_tendons_and_rays(tmp_path: Path) -> None:
    """What earlier paths and other sensors leave behind makes no difference."""
    path = tmp_path / "machine.xml"
    path.write_text(MACHINE)
    env = MjcfEnvironment(path, render_mode="rgb_array", width=16, height=16)
    limited = gymnasium.wrappers.TimeLimit(env, 30)
    check = of_pictures(record(tmp_path / "run", limited, steps=30))
    assert check.verdict is Verdict.PASS
    assert check.reason == "bit for bit, 31 pictures"


@pytest.mark.thorough
def test_some_pictures_are_asked_of_where_there_is_no_video(tmp_path: Path) -> None:
    """What nobody is shown costs little: the first, the last, and some between."""
    env = gymnasium.make("Pusher-v5")
    options = {"video_callable": False, "trajectory_callable": lambda _: True}
    directory = record(tmp_path / "run", env, steps=60, **options)
    check = of_pictures(directory)
    assert check.verdict is Verdict.PASS
    assert "3 pictures, a sample of 61" in check.reason
    changed("geom_xpos", 60, 1.0)(directory)
    assert of_pictures(directory).verdict is Verdict.FAIL


@pytest.mark.thorough
@pytest.mark.parametrize("field", ["geom_xpos", "geom_xmat", "light_xpos"])
def test_last_place_of_anything_drawn_is_seen(
    field: str, pusher: Path, tmp_path: Path
) -> None:
    """On the machine that recorded it, with frame, name and both numbers."""
    directory = copied(pusher, tmp_path / "run")
    changed(field, 4, 1e-15)(directory)
    check = of_pictures(directory)
    assert check.verdict is Verdict.FAIL
    assert check.reason.startswith(f"frame 4: after step 4 {field}[")
    assert check.figures["differing"] == 1


def test_elsewhere_the_tolerance_counts(pusher: Path, tmp_path: Path) -> None:
    """What is larger fails, what is smaller passes with what was found."""
    directory = copied(pusher, tmp_path / "run")
    forge(episode(directory), facts={"machine": OTHER_MACHINE})
    changed("geom_xpos", 4, 1e-9)(directory)
    near = of_pictures(directory)
    changed("geom_xpos", 4, 1.0)(directory)
    far = of_pictures(directory)
    assert (near.verdict, far.verdict) == (Verdict.PASS, Verdict.FAIL)
    assert "another machine" in near.reason
    assert near.figures["maximum"] > 0


def test_what_comes_of_states_that_are_not_known_is_said(
    pusher: Path, tmp_path: Path
) -> None:
    """Those before them and after are compared all the same."""
    directory = copied(pusher, tmp_path / "run")
    forge(episode(directory), states=lambda s: s.__setitem__(-1, np.nan))
    last = of_pictures(directory)
    forge(episode(directory), states=lambda s: s.__setitem__(3, np.nan))
    middle = of_pictures(directory)
    changed("geom_xpos", 6, 1.0)(directory)
    assert last.verdict is Verdict.PASS
    assert "8 pictures; of 1 more the state is not recorded" in last.reason
    assert middle.verdict is Verdict.NOT_CHECKABLE
    assert of_pictures(directory).verdict is Verdict.FAIL


def test_snapshots_that_are_not_of_the_model_fail(pusher: Path, tmp_path: Path) -> None:
    """Nothing that is drawn may be left out of them."""
    directory = copied(pusher, tmp_path / "run")
    path = episode(directory)
    with open_trajectory(path) as reader:
        content = content_of(reader)
    kinds = content.snapshots.dtype
    kept = [name for name in kinds.names if name != "geom_xpos"]
    snapshot = packed((name, kinds[name]) for name in kept)
    rows = np.zeros(len(content.snapshots), snapshot)
    for name in kept:
        rows[name] = content.snapshots[name]
    forge(path, snapshots=rows, snapshot=snapshot)
    check = of_pictures(directory)
    assert check.verdict is Verdict.FAIL
    assert "hold no geom_xpos" in check.reason


def test_moved_model_does_not_excuse_a_picture(pusher: Path, tmp_path: Path) -> None:
    """A geom that a recording says was moved is one that the environment has not."""
    directory = copied(pusher, tmp_path / "run")
    path = episode(directory)
    places = np.array(mjrec.load_trajectory(path).model().geom_pos)
    places += 1.0
    change = ModelChange(step=4, fields={"geom_pos": places})
    forge(path, model_changes=(change,))
    assert {c.verdict for c in physics_of(directory)} >= {Verdict.FAIL}
    assert of_pictures(directory).verdict is Verdict.FAIL
