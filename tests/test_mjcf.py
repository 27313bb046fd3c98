# SPDX-License-Identifier: Apache-2.0
"""Test MJCF files as environments."""

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import mjrec
from mjrec.environments.gymnasium_scenes import gymnasium_scenes
from mjrec.environments.mjcf_environments import MjcfEnvironment, make_mjcf
from mjrec.environments.named_environment import EnvironmentOptions
from mjrec.simulation.mjcf import load_mjcf

# A motor moves a red ball on a rail; a green ball is far away.
MODEL = """
<mujoco>
  <option timestep="{timestep}"/>
  <visual><headlight ambient="1 1 1"/></visual>
  <worldbody>
    {cameras}
    <geom name="far" size="1" pos="0 50 0" rgba="0 1 0 1"/>
    <body name="ball">
      <joint name="rail" type="slide" axis="1 0 0"/>
      <geom size=".3" rgba="1 0 0 1" mass="1"/>
      {follower}
    </body>
  </worldbody>
  <actuator>
    <motor joint="rail" gear="{gear}" ctrllimited="true" ctrlrange="-2 3"/>
    <position joint="rail" kp="0.1"/>
  </actuator>
</mujoco>
"""
FIXED = '<camera name="fixed" pos="0 53 0" xyaxes="-1 0 0 0 0 1"/>'
FOLLOWER = '<camera name="follow" mode="trackcom" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>'


@pytest.fixture
def write(tmp_path):
    def write_model(**values):
        path = tmp_path / "my rail (2).xml"
        defaults = {"timestep": 0.002, "cameras": "", "follower": "", "gear": 5}
        path.write_text(MODEL.format(**{**defaults, **values}))
        return path

    return write_model


@pytest.mark.parametrize(
    ("timestep", "fps"), [(0.0033, 60), (0.0166667, 60), (0.025, 40)]
)
def test_sixty_frames_a_second(write, timestep, fps):
    """Frame times are at most half a timestep off; slow simulations keep their rate."""
    env = MjcfEnvironment(write(timestep=timestep))
    assert env.metadata["render_fps"] == fps
    assert env.control_timestep() == pytest.approx(1 / fps)
    for _ in range(2):
        env.reset()
        for frame in range(1, 301):
            env.step(np.zeros(2))
            drift = abs(env.simulation.data.time - frame / fps)
            # The tolerance of 1e-5 accounts for the rounding of these timesteps.
            assert drift <= timestep / 2 + 1e-5 * frame / fps


# States are unbounded, and the model's author chose the actuator ranges.
@pytest.mark.filterwarnings("ignore:.*Box (action|observation) space:UserWarning")
def test_environment_passes_check_env(write):
    """Actions are controls; observations are positions and velocities."""
    check_env(MjcfEnvironment(write()), skip_render_check=True)
    env = MjcfEnvironment(write())
    space = env.action_space
    assert (space.low.tolist(), space.high.tolist()) == ([-2, -np.inf], [3, np.inf])
    assert env.reset(seed=3)[0].tolist() == [0, 0]
    for _ in range(10):
        observation, *rest = env.step(np.array([1, 0]))
    data = env.simulation.data
    assert observation.tolist() == [data.qpos[0], data.qvel[0]]
    assert observation[0] > 0.01
    assert rest == [0.0, False, False, {}]


def test_model_without_actuators_takes_empty_actions(tmp_path):
    path = tmp_path / "falling.mjcf"
    body = '<body><freejoint/><geom size=".1"/></body>'
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    env = MjcfEnvironment(path)
    env.reset()
    assert env.action_space.shape == (0,)
    assert env.step(env.action_space.sample())[0][2] < 0


def test_unstable_simulation_terminates_at_its_last_state(write, tmp_path, monkeypatch):
    """MuJoCo resets an unstable simulation by itself, so the episode must end."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT here.
    env = MjcfEnvironment(write(gear=1e12))
    env.reset()
    last, *_ = env.step(np.zeros(2))
    time = env.simulation.data.time
    observation, _, terminated, truncated, info = env.step(np.array([1.0, 0.0]))
    assert (terminated, truncated) == (True, False)
    assert "unstable" in info["unstable"]
    assert observation.tolist() == last.tolist()
    assert env.simulation.data.time == time > 0
    env.reset()
    assert env.step(np.zeros(2))[2] is False


@pytest.mark.parametrize("action", [[0.0], [0, np.nan], np.zeros((2, 1))])
def test_invalid_action_is_refused(write, action):
    env = MjcfEnvironment(write())
    env.reset()
    reason = r"finite numbers with the shape \(2,\)"
    with pytest.raises(mjrec.InvalidArgument, match=reason):
        env.step(action)


def test_mjcf_environment_is_recorded_from_states(write):
    path = write(cameras=FIXED)
    scenes = gymnasium_scenes(make_mjcf(path, EnvironmentOptions()))
    assert scenes.obstacle is None
    limited = make_mjcf(path, EnvironmentOptions(max_steps=3))
    assert gymnasium_scenes(limited).environment == {
        "framework": "mjcf",
        "id": "mjcf/my_rail__2_",
        "kwargs": {},
        "wrappers": [],
        "max_episode_steps": 3,
    }
    assert scenes.environment["max_episode_steps"] == 1000
    limited.unwrapped.render = lambda: None
    assert "overrides render()" in gymnasium_scenes(limited).obstacle


def test_default_camera_follows_or_is_the_first(write):
    size = {"render_mode": "rgb_array", "height": 32, "width": 48}
    env = MjcfEnvironment(write(cameras=FIXED, follower=FOLLOWER), **size)
    assert env.camera == "follow"
    env.reset()
    for _ in range(60):
        env.step(np.array([3, 0]))
    assert env.simulation.data.qpos[0] > 1
    frame = env.render()  # The ball is in the middle.
    assert frame.shape == (32, 48, 3)
    assert frame[16, 24, 0] > 100 > frame[16, 24, 1]
    env.close()
    env.close()

    path = write(cameras=FIXED)
    first, free = MjcfEnvironment(path), MjcfEnvironment(path, camera=-1)
    cameras = [each.camera for each in (first, free, MjcfEnvironment(write()))]
    assert cameras == ["fixed", -1, -1]
    assert (free.height, free.width) == (480, 480)


def test_wrong_arguments_are_refused_at_once(write):
    path = write(cameras=FIXED)
    with pytest.raises(mjrec.UnknownName, match=r"'nose'.*fixed"):
        MjcfEnvironment(path, camera="nose")
    with pytest.raises(mjrec.UnknownName, match="fixed"):
        gymnasium_scenes(MjcfEnvironment(path), camera="forward")
    with pytest.raises(mjrec.NoPictures, match='render_mode="rgb_array"'):
        MjcfEnvironment(path).render()
    with pytest.raises(mjrec.InvalidArgument, match="render_mode"):
        MjcfEnvironment(path, render_mode="human")
    with pytest.raises(mjrec.InvalidArgument, match=r"no other arguments.*frame_skip"):
        make_mjcf(path, EnvironmentOptions(kwargs={"frame_skip": 2}))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<mujoco><wrld/></mujoco>", "unrecognized element.*wrld"),
        ("", "XML"),
        ('<mujoco><asset><mesh file="nowhere.stl"/></asset></mujoco>', "nowhere.stl"),
    ],
)
def test_invalid_file_is_an_error_with_name_and_reason(tmp_path, text, reason):
    path = tmp_path / "bad.xml"
    path.write_text(text)
    with pytest.raises(mjrec.UnreadableFile, match=f"bad.xml: .*{reason}") as caught:
        load_mjcf(path)
    assert "\n" not in str(caught.value)
