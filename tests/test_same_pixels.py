# SPDX-License-Identifier: Apache-2.0
"""Frames rendered from recorded states equal those of `render()`, byte for byte."""

import contextlib
import copy
import gc
import importlib.util
import json
from pathlib import Path

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
from mjrec.environments.named_environment import EnvironmentOptions
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.rendering.pool import WorkerPool
from mjrec.simulation.cameras import raw_data, raw_model
from mjrec.simulation.find_simulation import simulation_in

SIZE = {"height": 48, "width": 64}
STEPS = 5
SEEDS = (3, 4)

GYMNASIUM = sorted(
    env_id
    for env_id, spec in gymnasium.registry.items()
    if "gymnasium.envs.mujoco" in str(spec.entry_point) and env_id.endswith("-v5")
)
has_dm_control = importlib.util.find_spec("dm_control") is not None


def suite_tasks():
    if not has_dm_control:
        return []
    from dm_control import suite

    return list(suite.ALL_TASKS)


def parametrize_environments(names, cases, *default):
    return parametrize(names, cases, default=default, part=pytest.mark.environments)


@pytest.fixture(scope="module")
def workers():
    with WorkerPool(1) as one, WorkerPool(3) as three:
        yield [one, three]


def check_frames(directory, live, workers, *, is_seen_to_move=True):
    """Check that rendered frames equal live frames."""
    paths = {*directory.glob("*.h5"), *in_flight(directory)}
    for episode, frames in enumerate(live):
        [path] = [p for p in paths if p.name.endswith(f".episode{episode:06d}.h5")]
        for pool in workers[: 1 if episode else None]:
            drawn = list(pool.frames(path, range(len(frames))))
            np.testing.assert_array_equal(drawn, frames)
    assert live[0][0].std() > 3  # A blank frame would not vary.
    if is_seen_to_move:
        assert len({frame.tobytes() for frames in live for frame in frames}) > len(live)


def monitored(env, directory, **options):
    deferred = {"render": "deferred", "workers": 0, "allow_early_reset": True}
    return mjrec.Monitor(env, directory, lambda _: True, **deferred, **options)


def record(env, directory, frame=None, *, each_step=lambda _: None, **options):
    """Record two episodes and return all frames."""
    # MuJoCo frees a viewer in the current context, so collect earlier viewers now.
    gc.collect()
    with monitored(env, directory, **options) as monitor:
        frame = frame or monitor.render
        live = list(episodes(env, monitor, lambda *_: frame(), each_step))
        monitor.close(wait=False)
    return live


def episodes(env, wrapped, look, each_step=lambda _: None):
    """Play two episodes and yield the results of `look` for each."""
    random = np.random.RandomState(1)
    is_gymnasium = hasattr(env, "unwrapped")
    space = env.action_space if is_gymnasium else env.action_spec()
    ends = ("low", "high") if is_gymnasium else ("minimum", "maximum")
    low, high = (np.clip(getattr(space, end), -1, 1) for end in ends)
    for seed in SEEDS:
        outcome = wrapped.reset(**({"seed": seed} if is_gymnasium else {}))
        seen = [look(outcome)]
        for step in range(STEPS):
            each_step(step)
            outcome = wrapped.step(random.uniform(low, high, space.shape))
            seen.append(look(outcome))
            # The discount of a dm_env episode is 1 until it ends.
            if is_gymnasium and any(outcome[2:4]):
                break
        yield seen


def draw_quickly(model):
    model.vis.quality.shadowsize = 256
    model.vis.quality.offsamples = 0


def make(env_id, **kwargs):
    env = gymnasium.make(env_id, **{"render_mode": "rgb_array", **SIZE, **kwargs})
    draw_quickly(env.get_wrapper_attr("model"))
    return env


def test_full_quality(workers, tmp_path):
    """This test uses default shadows and antialiasing, which the others reduce."""
    env = gymnasium.make("InvertedPendulum-v5", render_mode="rgb_array")
    live = record(gymnasium.wrappers.TimeLimit(env, 2), tmp_path)
    check_frames(tmp_path, live, workers[:1])


@parametrize_environments("env_id", GYMNASIUM, "HalfCheetah-v5")
def test_gymnasium(env_id, workers, tmp_path):
    check_frames(tmp_path, record(make(env_id), tmp_path), workers)


@parametrize_environments("env_id", GYMNASIUM, "Hopper-v5")
def test_gymnasium_cameras_of_the_model(env_id, workers, tmp_path):
    """Either the environment or the monitor names the camera."""
    model = gymnasium.make(env_id).unwrapped
    for number in range(model.model.ncam):
        name = model.model.camera(number).name
        camera = {"camera_name": name} if name else {"camera_id": number}
        live = record(make(env_id, **camera), tmp_path / str(number))
        check_frames(tmp_path / str(number), live, workers[:1])
        bare = make(env_id, render_mode=None, height=9, width=9)
        view = {"camera": name or number, **SIZE}
        record(bare, tmp_path / f"{number} bare", list, **view)
        check_frames(tmp_path / f"{number} bare", live, workers[:1])


def test_camera_and_visual_options_of_the_user(workers, tmp_path, monkeypatch):
    """The viewer changes within an episode."""
    monkeypatch.chdir(tmp_path)  # MuJoCo logs full scenes in the working directory.
    env = make(
        "Ant-v5",
        max_geom=12,
        default_camera_config={"distance": 7.0, "lookat": np.array([0.5, 0, 0.2])},
        visual_options={int(mujoco.mjtVisFlag.mjVIS_COM): True},
    )

    def change(step):
        viewer = env.unwrapped.mujoco_renderer.viewer
        viewer.cam.azimuth += 20 * step
        viewer.vopt.flags[int(mujoco.mjtVisFlag.mjVIS_TRANSPARENT)] = step == 3

    check_frames(tmp_path, record(env, tmp_path, each_step=change), workers[:1])


@parametrize_environments(
    "env_id", robotics_ids(), "FetchPickAndPlace-v4", "AntMaze_UMaze-v5"
)
def test_robotics(env_id, workers, tmp_path):
    """Some of these environments move goals in `render`."""
    with robots_that_reset():
        live = record(make(env_id), tmp_path)
    # The ant is too small to see in large mazes.
    check_frames(tmp_path, live, workers[:1], is_seen_to_move=False)


def record_dm(env, directory, camera):
    def frame():
        return env.physics.render(**SIZE, camera_id=-1 if camera is None else camera)

    view = {"env_id": "dm_control/any", "camera": camera, **SIZE}
    return record(env, directory, frame, **view)


@pytest.mark.dm_control
@parametrize_environments(
    "domain, task, visualize_reward",
    [(*task, reward) for task in suite_tasks() for reward in (False, True)],
    ("finger", "turn_easy", True),
)
def test_suite(domain, task, visualize_reward, workers, tmp_path):
    """Each task is rendered from each camera; `visualize_reward` changes colors."""
    from dm_control import suite

    options = {"task_kwargs": {"random": 5}, "visualize_reward": visualize_reward}
    env = suite.load(domain, task, **options)
    draw_quickly(env.physics.model)
    cameras = [None, *range(1 if visualize_reward else env.physics.model.ncam)]
    for camera in cameras:
        place = tmp_path / str(camera)
        live = record_dm(env, place, camera)
        check_frames(place, live, workers[:1], is_seen_to_move=camera in (None, 0))


def composer_environments():
    """Return constructors by name, except soccer, which has a reward per player."""
    if not has_dm_control:
        return {}
    from dm_control import manipulation
    from dm_control.locomotion.examples import basic_cmu_2019 as cmu
    from dm_control.locomotion.examples import basic_rodent_2020 as rodent

    walks = (
        *(cmu.cmu_humanoid_run_walls, cmu.cmu_humanoid_run_gaps),
        *(cmu.cmu_humanoid_go_to_target, cmu.cmu_humanoid_maze_forage),
        *(rodent.rodent_escape_bowl, rodent.rodent_run_gaps, rodent.rodent_maze_forage),
    )
    tasks = ("reach_site_features", "place_brick_features", "stack_2_bricks_features")
    return {
        **{w.__name__: lambda w=w: w(np.random.RandomState(2)) for w in walks},
        **{task: lambda task=task: manipulation.load(task, seed=2) for task in tasks},
    }


@pytest.mark.dm_control
@parametrize_environments(
    "name, camera",
    [(name, camera) for name in composer_environments() for camera in (None, 0)],
    ("reach_site_features", None),
)
def test_composer(name, camera, workers, tmp_path):
    """Composer tasks compile a new model for each episode."""
    live = record_dm(composer_environments()[name](), tmp_path, camera)
    check_frames(tmp_path, live, workers[:1])


def own_environment(name):
    options = EnvironmentOptions(**SIZE, max_steps=STEPS)
    path = Path(__file__).parents[1] / "assets" / f"{name}.xml"
    env = environment_from_name(str(path), options).environment
    draw_quickly(env.unwrapped.simulation.model)
    return env


@pytest.mark.parametrize("name", ["walker_on_plane", "showcase"])
def test_own_model(name, workers, tmp_path):
    """An infinite plane is centered on the camera of the previous frame."""
    check_frames(tmp_path, record(own_environment(name), tmp_path), workers)


def test_forget_frames_resets_cameras(tmp_path):
    previous = []
    with monitored(own_environment("walker_on_plane"), tmp_path) as monitor:
        for number in range(3):
            if number == 2:
                monitor.forget_frames()
            monitor.reset(seed=0)
            monitor.step(np.zeros(1))
        monitor.close(wait=False)
    for path in in_flight(tmp_path):
        with open_trajectory(path) as reader:
            previous.append(reader.facts["scene"]["previous_cameras"])
    assert [each is None for each in previous] == [True, False, True]


class Negative(InvertedPendulumEnv):
    def render(self):
        return 255 - super().render()


@pytest.mark.parametrize(
    ("kind", "mode", "named"),
    [
        (Negative, "rgb_array", "Negative overrides render()"),
        (InvertedPendulumEnv, "depth_array", "depth_array"),
    ],
)
def test_overridden_render_is_recorded_live(kind, mode, named, tmp_path):
    """`render="deferred"` is an error, and metadata names the reason."""
    env = kind(render_mode=mode, **SIZE)
    with pytest.raises(mjrec.PicturesDiffer) as error:
        mjrec.Monitor(env, tmp_path / "out", render="deferred")
    assert named.partition(" ")[0] in str(error.value)
    assert not (tmp_path / "out").exists()
    if named == "depth_array":
        return
    with mjrec.Monitor(env, tmp_path, env_id="any", allow_early_reset=True) as monitor:
        monitor.reset(seed=0)
        shown = monitor.render()
    assert named in json.dumps(metadata_of(tmp_path, 0))
    [frame] = frames_in(tmp_path, 0)
    assert np.abs(frame.astype(int) - shown).mean() < 12


POINTS = {int(mujoco.mjtVisFlag.mjVIS_CONTACTPOINT): True}


@pytest.mark.parametrize(
    ("options", "arrays", "reason"),
    [
        ({"visual_options": POINTS}, None, "mjVIS_CONTACTPOINT in the visual options"),
        # The self-check compares the first frame.
        ({}, ("geom_xmat",), "drawn from its snapshot differs"),
    ],
)
def test_frames_that_states_cannot_give_are_drawn_live(
    options, arrays, reason, tmp_path, monkeypatch, caplog
):
    """The log names the reason, and `render="deferred"` is an error."""
    if arrays:
        monkeypatch.setattr("mjrec.simulation.captured_arrays.ALWAYS", arrays)
    env = make("InvertedPendulum-v5", **options)
    with pytest.raises(mjrec.PicturesDiffer, match=reason):
        monitored(env, tmp_path / "deferred").reset(seed=0)
    with mjrec.Monitor(env, tmp_path / "live", allow_early_reset=True) as monitor:
        monitor.reset(seed=0)
    assert reason in caplog.text
    assert len(frames_in(tmp_path / "live", 0)) == 1


def show(viewer, what):
    viewer.vopt.flags[int(mujoco.mjtVisFlag.__members__[f"mjVIS_{what}"])] = True


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda env, viewer: viewer.add_marker(pos=np.zeros(3)), "markers were added"),
        (
            lambda env, viewer: setattr(env, "model", copy.copy(env.model)),
            "switched to another model",
        ),
        (lambda env, viewer: env.model.geom_type.fill(6), "geom_type of the model"),
        (lambda env, viewer: show(viewer, "CONTACTPOINT"), "mjVIS_CONTACTPOINT"),
        (lambda env, viewer: show(viewer, "INERTIA"), "xipos"),
    ],
)
def test_frames_end_where_states_no_longer_suffice(change, reason, tmp_path, caplog):
    env = make("InvertedPendulum-v5")
    monitor = monitored(env, tmp_path)
    monitor.reset(seed=0)
    monitor.render()
    change(env.unwrapped, env.unwrapped.mujoco_renderer.viewer)
    monitor.step(np.zeros(1))
    monitor.close()
    assert reason in caplog.text
    [path] = tmp_path.glob("*.trajectory.*")
    with open_trajectory(path) as trajectory:
        assert trajectory.frame_count == 1


QUADRUPED = pytest.param("quadruped-escape", marks=pytest.mark.dm_control)


@parametrize_environments(
    "name",
    ["HalfCheetah-v5", *robotics_ids(), QUADRUPED],
    *("HalfCheetah-v5", "FetchPickAndPlace-v4", "HandManipulateBlock-v1", QUADRUPED),
)
def test_recording_disturbs_nothing(name, tmp_path):
    """States and random numbers stay bit-identical, and no viewer is created."""
    spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)

    def run(wrap):
        if name == "quadruped-escape":
            from dm_control import suite

            env = suite.load("quadruped", "escape", task_kwargs={"random": 0})
        else:
            env = gymnasium.make(name)
        simulation = simulation_in(env)

        def look(outcome):
            model, data = raw_model(simulation.model), raw_data(simulation.data)
            state = np.empty(mujoco.mj_stateSize(model, spec))
            mujoco.mj_getState(model, data, state, spec)
            return [*outcome[:4], state, model.hfield_data.copy()]

        with contextlib.closing(wrap(env)) as wrapped:
            seen = list(episodes(env, wrapped, look))
        is_suites = name == "quadruped-escape"
        random = env.task.random if is_suites else env.unwrapped.np_random
        return simulation, [*seen, random.random()]

    with robots_that_reset():
        _, bare = run(lambda env: env)
        drawn, recorded = run(lambda env: monitored(env, tmp_path, env_id=name))
    np.testing.assert_equal(bare, recorded)
    viewers = getattr(drawn, "mujoco_renderer", None)
    assert getattr(viewers, "viewer", None) is None
    assert getattr(drawn, "_contexts", None) is None
