# SPDX-License-Identifier: Apache-2.0
"""What is drawn from recorded states is what `render()` shows, byte for byte."""

from __future__ import annotations

import gc
import importlib.util
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from parts import parametrize
from recordings import frames_in, in_flight, metadata_of
from robots import robotics_ids, robots_that_reset

import mjrec
from mjrec.environments.from_name import environment_from_name
from mjrec.environments.options import EnvironmentOptions
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.rendering.pool import WorkerPool
from mjrec.simulation.cameras import raw_data, raw_model
from mjrec.simulation.find_simulation import simulation_in

HEIGHT, WIDTH = 48, 64
STEPS = 5
SEEDS = (3, 4)

GYMNASIUM = sorted(
    env_id
    for env_id, spec in gymnasium.registry.items()
    if "gymnasium.envs.mujoco" in str(spec.entry_point) and env_id.endswith("-v5")
)

has_dm_control = importlib.util.find_spec("dm_control") is not None


def suite_tasks() -> list[tuple[str, str]]:
    if not has_dm_control:
        return []
    from dm_control import suite

    return list(suite.ALL_TASKS)


def every(names: str, cases: list[Any], *default: Any) -> pytest.MarkDecorator:
    """Try all environments under `scripts/test --all`, and these by default."""
    return parametrize(names, cases, default=default, part=pytest.mark.environments)


@pytest.fixture(scope="module")
def one_worker() -> Iterator[WorkerPool]:
    """A process that draws."""
    with WorkerPool(1) as workers:
        yield workers


@pytest.fixture(scope="module")
def three_workers() -> Iterator[WorkerPool]:
    """Three that share a video."""
    with WorkerPool(3) as workers:
        yield workers


def differences(
    directory: Path,
    live: list[list[Any]],
    *crews: WorkerPool,
    is_seen_to_move: bool = True,
) -> list[str]:
    """Return which frames of a recording are not the pictures of their moments."""
    found = []
    for episode, frames in enumerate(live):
        ending = f".episode{episode:06d}.h5"
        names = {*directory.glob("*.h5"), *in_flight(directory)}
        [path] = [name for name in names if name.name.endswith(ending)]
        with open_trajectory(path) as trajectory:
            assert trajectory.frame_count == len(frames)
        for crew in crews:
            drawn = crew.frames(path, range(len(frames)))
            found += [
                f"episode {episode} frame {index}: {np.abs(a - b.astype(int)).max()}"
                for index, (a, b) in enumerate(zip(drawn, frames, strict=True))
                if not np.array_equal(a, b)
            ]
    # There was something to compare.
    assert live[0][0].std() > 3
    if is_seen_to_move:
        assert len({frame.tobytes() for frames in live for frame in frames}) > len(live)
    return found


def draw_quickly(model: Any) -> None:
    """Make a model whose pictures cost a software renderer little."""
    model.vis.quality.shadowsize = 256
    model.vis.quality.offsamples = 0


def record(env: Any, directory: Path, **options: Any) -> list[list[Any]]:
    """Record two episodes, and return the pictures of `render()` of every moment."""
    # MuJoCo frees what an environment has drawn with in whatever OpenGL context is
    # current: one that an earlier test has left is not to go between two pictures.
    gc.collect()
    live = []
    env.action_space.seed(0)
    monitor = mjrec.Monitor(
        env, directory, lambda _: True, render="deferred", workers=0, **options
    )
    for seed in SEEDS:
        monitor.reset(seed=seed)
        frames = [monitor.render()]
        done = False
        while not done:
            outcome = monitor.step(monitor.action_space.sample())
            frames.append(monitor.render())
            done = outcome[2] or outcome[3]
        live.append(frames)
    monitor.close()
    return live


def make(env_id: str, **kwargs: Any) -> Any:
    env = gymnasium.make(
        env_id,
        render_mode="rgb_array",
        width=WIDTH,
        height=HEIGHT,
        max_episode_steps=STEPS,
        **kwargs,
    )
    draw_quickly(env.get_wrapper_attr("model"))
    return env


def test_quality_that_the_model_asks_for(one_worker: Any, tmp_path: Path) -> None:
    """Gymnasium's own, with shadows and smooth edges; all others are simpler."""
    env = gymnasium.make("InvertedPendulum-v5", render_mode="rgb_array")
    live = record(gymnasium.wrappers.TimeLimit(env, 2), tmp_path)
    assert not differences(tmp_path, live, one_worker)


@every("env_id", GYMNASIUM, "HalfCheetah-v5")
def test_gymnasium(
    env_id: str, one_worker: Any, three_workers: Any, tmp_path: Path
) -> None:
    """The default camera, which the first picture settles."""
    live = record(make(env_id), tmp_path)
    assert not differences(tmp_path, live, one_worker, three_workers)


@every("env_id", GYMNASIUM, "Ant-v5")
def test_gymnasium_cameras_of_the_model(
    env_id: str, one_worker: Any, tmp_path: Path
) -> None:
    """Cameras that the environment was made with, by their names or numbers."""
    model = gymnasium.make(env_id).unwrapped.model
    for number in range(model.ncam):
        name = model.camera(number).name
        camera = {"camera_name": name} if name else {"camera_id": number}
        live = record(make(env_id, **camera), tmp_path / str(number))
        assert not differences(tmp_path / str(number), live, one_worker)


def test_camera_asked_of_the_monitor(one_worker: Any, tmp_path: Path) -> None:
    """It shows what an environment made with it would show, in another size too."""
    live = record(make("Hopper-v5", camera_name="track"), tmp_path / "made")
    env = gymnasium.make("Hopper-v5", max_episode_steps=STEPS)
    draw_quickly(env.unwrapped.model)  # type: ignore[attr-defined]  # it has one
    view = {"camera": "track", "height": HEIGHT, "width": WIDTH}
    monitor = mjrec.Monitor(
        env, tmp_path / "asked", lambda _: True, workers=0, render="deferred", **view
    )
    env.action_space.seed(0)
    for seed in SEEDS:
        monitor.reset(seed=seed)
        for _ in range(STEPS):
            monitor.step(monitor.action_space.sample())
    monitor.close()
    assert not differences(tmp_path / "asked", live, one_worker)


def test_camera_and_options_that_the_user_gave(one_worker: Any, tmp_path: Path) -> None:
    """Those of the environment's arguments, and of its viewer in mid-episode."""
    env = make(
        "Ant-v5",
        default_camera_config={"distance": 7.0, "lookat": np.array([0.5, 0, 0.2])},
        visual_options={int(mujoco.mjtVisFlag.mjVIS_COM): True},
    )
    monitor = mjrec.Monitor(env, tmp_path, lambda _: True, render="deferred", workers=0)
    monitor.reset(seed=3)
    live = [monitor.render()]
    for step in range(STEPS):
        viewer = env.unwrapped.mujoco_renderer.viewer
        viewer.cam.azimuth += 20 * step
        viewer.vopt.flags[int(mujoco.mjtVisFlag.mjVIS_TRANSPARENT)] = step == 3
        monitor.step(np.zeros(8))
        live.append(monitor.render())
    monitor.close()
    assert not differences(tmp_path, [live], one_worker)


@every("env_id", robotics_ids(), "FetchPickAndPlace-v4", "AntMaze_UMaze-v5")
def test_robotics(env_id: str, one_worker: Any, tmp_path: Path) -> None:
    """Also where each `render` moves goals."""
    with robots_that_reset():
        live = record(make(env_id), tmp_path)
    # In large mazes the ant is too small to be seen.
    assert not differences(tmp_path, live, one_worker, is_seen_to_move=False)


def record_dm(
    env: Any, directory: Path, *, camera: str | int | None = None
) -> list[list[Any]]:
    """Record two episodes, and return `physics.render()` of every moment."""
    monitor = mjrec.Monitor(
        env,
        directory,
        lambda _: True,
        render="deferred",
        workers=0,
        env_id="dm_control/any",
        camera=camera,
        height=HEIGHT,
        width=WIDTH,
    )
    spec = env.action_spec()
    random = np.random.RandomState(1)

    def picture() -> Any:
        return env.physics.render(HEIGHT, WIDTH, -1 if camera is None else camera)

    live = []
    for _ in SEEDS:
        monitor.reset()
        frames = [picture()]
        for _ in range(STEPS):
            limits = (np.clip(limit, -1, 1) for limit in (spec.minimum, spec.maximum))
            monitor.step(random.uniform(*limits, spec.shape))
            frames.append(picture())
        live.append(frames)
    monitor.close()
    return live


@pytest.mark.dm_control
@every(
    "domain, task, camera, visualize_reward",
    [
        (domain, task, camera, visualize_reward)
        for domain, task in suite_tasks()
        for camera in (None, 0)
        for visualize_reward in (False, True)
    ],
    ("finger", "turn_easy", None, True),
    ("quadruped", "escape", 0, False),
)
def test_suite(
    domain: str,
    task: str,
    camera: int | None,
    visualize_reward: bool,
    one_worker: Any,
    tmp_path: Path,
) -> None:
    """Every task, from two cameras, and with colours that show the reward."""
    from dm_control import suite

    env = suite.load(
        domain, task, task_kwargs={"random": 5}, visualize_reward=visualize_reward
    )
    draw_quickly(env.physics.model)
    live = record_dm(env, tmp_path, camera=camera)
    assert not differences(tmp_path, live, one_worker)


@pytest.mark.dm_control
@pytest.mark.environments
@pytest.mark.parametrize(("domain", "task"), suite_tasks())
def test_further_cameras_of_the_suite(
    domain: str, task: str, one_worker: Any, tmp_path: Path
) -> None:
    """All but the two that are tried above."""
    from dm_control import suite

    env = suite.load(domain, task, task_kwargs={"random": 5})
    draw_quickly(env.physics.model)
    for camera in range(1, env.physics.model.ncam):
        live = record_dm(env, tmp_path / str(camera), camera=camera)
        assert not differences(
            tmp_path / str(camera), live, one_worker, is_seen_to_move=False
        )


def composer_environments() -> dict[str, Callable[[], Any]]:
    """Return what makes each; no soccer, whose rewards are one for each player."""
    if not has_dm_control:
        return {}
    from dm_control import manipulation
    from dm_control.locomotion.examples import basic_cmu_2019 as cmu
    from dm_control.locomotion.examples import basic_rodent_2020 as rodent

    def state() -> Any:
        return np.random.RandomState(2)

    tasks = ("reach_site_features", "place_brick_features", "stack_2_bricks_features")
    return {
        "cmu_humanoid_run_walls": lambda: cmu.cmu_humanoid_run_walls(state()),
        "cmu_humanoid_run_gaps": lambda: cmu.cmu_humanoid_run_gaps(state()),
        "cmu_humanoid_go_to_target": lambda: cmu.cmu_humanoid_go_to_target(state()),
        "cmu_humanoid_maze_forage": lambda: cmu.cmu_humanoid_maze_forage(state()),
        "rodent_escape_bowl": lambda: rodent.rodent_escape_bowl(state()),
        "rodent_run_gaps": lambda: rodent.rodent_run_gaps(state()),
        "rodent_maze_forage": lambda: rodent.rodent_maze_forage(state()),
        **{task: lambda task=task: manipulation.load(task, seed=2) for task in tasks},
    }


@pytest.mark.dm_control
@every(
    "name, camera",
    [(name, camera) for name in composer_environments() for camera in (None, 0)],
    ("reach_site_features", None),
)
def test_composer(
    name: str, camera: int | None, one_worker: Any, tmp_path: Path
) -> None:
    """Tasks that compile another model for every episode."""
    env = composer_environments()[name]()
    live = record_dm(env, tmp_path, camera=camera)
    assert not differences(tmp_path, live, one_worker)


ENDLESS = """
<mujoco>
  <visual><quality shadowsize="256" offsamples="0"/><map zfar="50"/></visual>
  <asset>
    <texture name="checks" type="2d" builtin="checker" rgb1=".2 .6 .3" rgb2=".8 .8 .7"
      width="32" height="32"/>
    <material name="checks" texture="checks" texrepeat="1.7 1.7" reflectance=".2"/>
  </asset>
  <worldbody>
    <light directional="true" dir="0 .3 -1"/>
    <geom type="plane" size="0 0 1" material="checks"/>
    <body pos="0 0 .5">
      <joint name="rail" type="slide" axis="1 .3 0"/>
      <geom size=".3" rgba="1 .2 .1 1" mass="1"/>
      <camera name="ride" mode="trackcom" pos="0 -3 1.5" xyaxes="1 0 0 0 .4 .9"/>
      <site name="hook" pos="0 0 1"/>
      <body pos="0 0 .4">
        <joint axis="0 1 0"/>
        <geom type="capsule" size=".05" fromto="0 0 0 .6 0 0"/>
        <site name="end" pos=".6 0 0"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial limited="true" range="0 .9" width=".03">
      <site site="hook"/><site site="end"/>
    </spatial>
  </tendon>
  <actuator>
    <motor joint="rail" gear="400000" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


def test_own_model_over_an_infinite_plane(
    one_worker: Any, three_workers: Any, tmp_path: Path
) -> None:
    """It is drawn around the camera of the picture before; and a tendon is taut."""
    path = tmp_path / "endless.xml"
    path.write_text(ENDLESS)
    options = EnvironmentOptions(height=HEIGHT, width=WIDTH, max_steps=STEPS)
    env = environment_from_name(str(path), options).environment
    live = record(env, tmp_path / "out")
    assert not differences(tmp_path / "out", live, one_worker, three_workers)


class Overlay(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Draws something on top."""

    def render(self) -> Any:
        frame = super().render().copy()
        frame[:4] = 255
        return frame


class Negative(InvertedPendulumEnv):
    """Shows itself in other colours."""

    def render(self) -> Any:
        return 255 - super().render()


def small(render_mode: str = "rgb_array") -> dict[str, Any]:
    return {"render_mode": render_mode, "width": WIDTH, "height": HEIGHT}


@pytest.mark.parametrize(
    ("make_env", "named"),
    [
        (lambda: Overlay(make("InvertedPendulum-v5")), f"{__name__}.Overlay"),
        (lambda: Negative(**small()), f"{__name__}.Negative"),
        (lambda: InvertedPendulumEnv(**small("depth_array")), "depth_array"),
    ],
)
def test_deferred_where_it_would_lie_is_an_error(
    make_env: Callable[[], Any], named: str, tmp_path: Path
) -> None:
    """The message names what stands in the way, and nothing is written."""
    env = make_env()
    with pytest.raises(mjrec.PicturesDiffer, match=named):
        mjrec.Monitor(env, tmp_path / "out", render="deferred")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("make_env", "named"),
    [
        (lambda: Overlay(make("InvertedPendulum-v5")), "Overlay overrides render()"),
        (lambda: Negative(**small()), "Negative overrides render()"),
    ],
)
def test_deferred_where_it_would_lie_is_not_chosen(
    make_env: Callable[[], Any], named: str, tmp_path: Path
) -> None:
    """The video shows what render() shows, and its metadata says why it is live."""
    env = make_env()
    with mjrec.Monitor(env, tmp_path, env_id="any", allow_early_reset=True) as monitor:
        monitor.reset(seed=0)
        shown = monitor.render()
    assert named in json.dumps(metadata_of(tmp_path, 0))
    [frame] = frames_in(tmp_path, 0)
    # Encoded, but bright where the overlay is, or everywhere.
    assert np.abs(frame.astype(int) - shown).mean() < 12


def test_frames_end_where_markers_come(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """In the middle of an episode; nothing is shown that `render()` does not."""
    env = make("InvertedPendulum-v5")
    monitor = monitored(env, tmp_path)
    monitor.reset(seed=0)
    monitor.render()
    env.unwrapped.mujoco_renderer.viewer.add_marker(pos=np.zeros(3))
    monitor.step(np.zeros(1))
    monitor.close()
    assert "markers were added to the viewer" in caplog.text
    [path] = tmp_path.glob("*.trajectory.*")
    with open_trajectory(path) as trajectory:
        assert trajectory.frame_count == 1


def states_of(env: Any) -> Callable[[], Any]:
    """Return what gives the simulation's state, of either framework."""
    simulation = simulation_in(env)
    spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)

    def state() -> Any:
        model, data = raw_model(simulation.model), raw_data(simulation.data)
        vector = np.empty(mujoco.mj_stateSize(model, spec))
        mujoco.mj_getState(model, data, vector, spec)
        return vector

    return state


def gymnasium_run(env: Any) -> list[Any]:
    """Return all that two episodes give, states and random numbers among it."""
    state, given = states_of(env), []
    env.action_space.seed(0)
    for seed in SEEDS:
        given.append(env.reset(seed=seed)[0])
        for _ in range(STEPS):
            given += [*env.step(env.action_space.sample())[:4], state()]
        given.append(env.unwrapped.np_random.random())
    return given


def monitored(env: Any, directory: Path, **options: Any) -> Any:
    return mjrec.Monitor(
        env,
        directory,
        lambda _: True,
        render="deferred",
        workers=0,
        allow_early_reset=True,
        **options,
    )


@every(
    "env_id",
    ["HalfCheetah-v5", *robotics_ids()],
    *("HalfCheetah-v5", "FetchPickAndPlace-v4", "HandManipulateBlock-v1"),
)
def test_recording_disturbs_nothing(env_id: str, tmp_path: Path) -> None:
    """Everything is bit for bit as without, also where render() would change it."""
    with robots_that_reset():
        bare = gymnasium_run(gymnasium.make(env_id))
        env = gymnasium.make(env_id)
        recorded = gymnasium_run(monitored(env, tmp_path))
    for first, second in zip(bare, recorded, strict=True):
        np.testing.assert_equal(first, second)
    viewers = getattr(simulation_in(env), "mujoco_renderer", None)
    assert getattr(viewers, "viewer", None) is None
    env.close()


@pytest.mark.dm_control
def test_recording_disturbs_nothing_of_dm_controls(tmp_path: Path) -> None:
    """Random numbers included; and no context is made."""
    from dm_control import suite

    def run(wrap: Callable[[Any], Any]) -> list[Any]:
        env = suite.load("quadruped", "escape", task_kwargs={"random": 0})
        state, given, wrapped = states_of(env), [], wrap(env)
        for _ in SEEDS:
            given.append(wrapped.reset().observation)
            for _ in range(STEPS):
                given += [*wrapped.step(np.full(12, 0.3)), state()]
            given.append(env.task.random.rand())
        given.append(env.physics.model.hfield_data.copy())
        wrapped.close()
        return given

    contexts = []

    def recorded(env: Any) -> Any:
        contexts.append(env.physics)
        return monitored(env, tmp_path, env_id="dm_control/quadruped-escape")

    for first, second in zip(run(lambda env: env), run(recorded), strict=True):
        np.testing.assert_equal(first, second)
    assert contexts[0]._contexts is None
