# SPDX-License-Identifier: Apache-2.0
"""MJCF files, simulated and as an environment."""

from fractions import Fraction

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import mjrec
from mjrec.environments.gymnasium_scenes import gymnasium_scenes
from mjrec.environments.mjcf_environments import MjcfEnvironment, make_mjcf
from mjrec.environments.named_environment import EnvironmentOptions
from mjrec.simulation.mjcf import load_mjcf

# A red ball on a rail with a motor, a free one, and a green one far from both.
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
    <motor joint="rail" gear="5" ctrllimited="true" ctrlrange="-2 3"/>
    <position joint="rail" kp="0.1"/>
  </actuator>
</mujoco>
"""
FIXED = '<camera name="fixed" pos="0 53 0" xyaxes="-1 0 0 0 0 1"/>'
FOLLOWER = '<camera name="follow" mode="trackcom" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>'


@pytest.fixture
def write(tmp_path):
    def write_model(*, timestep=0.002, cameras="", follower=""):
        path = tmp_path / "my rail (2).xml"
        options = {"timestep": timestep, "cameras": cameras, "follower": follower}
        path.write_text(MODEL.format(**options))
        return path

    return write_model


@pytest.mark.parametrize("timestep", [0.0033, 0.0166667])
def test_there_are_sixty_frames_to_the_second(write, timestep):
    """No frame is more than half a timestep off, and nothing adds up; each episode."""
    env = MjcfEnvironment(write(timestep=timestep))
    assert env.metadata["render_fps"] == 60
    assert env.control_timestep() == pytest.approx(1 / 60)
    for _ in range(2):
        env.reset()
        for frame in range(1, 301):
            env.step(np.zeros(2))
            # A hundred-thousandth is the rounding of 1/60 and 1/240 to these digits.
            off = abs(env.simulation.data.time - frame / 60)
            assert off <= timestep / 2 + 1e-5 * frame / 60


def test_a_long_timestep_makes_one_frame_a_step(write):
    """A simulation slower than 60 steps a second plays at its own rate."""
    env = MjcfEnvironment(write(timestep=0.025))
    assert env.simulation.frame_rate == Fraction(40)
    assert (env.metadata["render_fps"], env.control_timestep()) == (40, 0.025)
    env.reset()
    env.step(np.zeros(2))
    assert env.simulation.data.time == 0.025


# States have no bounds, and the actuators' ranges are the author's.
@pytest.mark.filterwarnings("ignore:.*Box (action|observation) space:UserWarning")
def test_the_environment_keeps_gymnasiums_contract(write):
    """Actions are the controls in their ranges, observations positions and speeds."""
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


def test_a_model_without_actuators_is_simulated(tmp_path):
    """A passive model takes empty actions."""
    path = tmp_path / "falling.mjcf"
    body = '<body><freejoint/><geom size=".1"/></body>'
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    env = MjcfEnvironment(path)
    env.reset()
    assert env.action_space.shape == (0,)
    assert env.step(env.action_space.sample())[0][2] < 0


def test_an_unstable_simulation_ends_where_it_was_sound(tmp_path, monkeypatch):
    """MuJoCo starts over by itself; the episode must not go on from there."""
    # MuJoCo writes MUJOCO_LOG.TXT where it is.
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "unstable.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="j" type="slide"/><geom size=".1"/>'
        '</body></worldbody><actuator><motor joint="j" gear="1e12"/></actuator>'
        "</mujoco>"
    )
    env = MjcfEnvironment(path)
    env.reset()
    sound, *_ = env.step(np.array([0.0]))
    time = env.simulation.data.time
    observation, _, terminated, truncated, info = env.step(np.array([1.0]))
    assert (terminated, truncated) == (True, False)
    assert "unstable" in info["unstable"]
    assert observation.tolist() == sound.tolist()
    assert env.simulation.data.time == time > 0
    env.reset()
    assert env.step(np.array([0.0]))[2] is False


@pytest.mark.parametrize("action", [[0.0], [0, np.nan], [0, np.inf], np.zeros((2, 1))])
def test_what_is_no_control_is_refused(write, action):
    """MuJoCo would go on with other controls, or raise something obscure."""
    env = MjcfEnvironment(write())
    env.reset()
    with pytest.raises(
        mjrec.InvalidArgument, match=r"finite numbers with the shape \(2,\)"
    ):
        env.step(action)


@pytest.mark.parametrize(("asked", "expected"), [(None, 1000), (7, 7)])
def test_episodes_end_after_max_steps(write, asked, expected):
    """A model has no end of its own; its id in recordings is the file's name."""
    env = make_mjcf(write(), EnvironmentOptions(max_steps=asked, frames=False))
    env.reset()
    ends = [env.step(np.zeros(2))[2:4] for _ in range(expected)]
    assert ends == [(False, False)] * (expected - 1) + [(False, True)]
    assert env.spec.id == "mjcf/my_rail__2_"


class Draws(MjcfEnvironment):
    def render(self):
        return super().render()


def test_frames_follow_from_states(write):
    """Wrapped or not, unless something overrides; cameras are checked at once."""
    path = write(cameras=FIXED)
    limited = gymnasium.wrappers.TimeLimit(MjcfEnvironment(path), 3)
    scenes = gymnasium_scenes(limited)
    assert scenes.obstacle is None
    assert scenes.environment == {
        "framework": "mjcf",
        "id": "mjcf/my_rail__2_",
        "kwargs": {},
        "wrappers": [],
        "max_episode_steps": 3,
    }
    assert "Draws overrides render()" in str(gymnasium_scenes(Draws(path)).obstacle)
    with pytest.raises(mjrec.UnknownName, match="fixed"):
        gymnasium_scenes(limited, camera="forward")


def test_frames_show_the_camera_that_follows_or_the_first(write):
    """The ball stays in the middle of the frame however far it goes."""
    size = {"render_mode": "rgb_array", "height": 32, "width": 48}
    env = MjcfEnvironment(write(cameras=FIXED, follower=FOLLOWER), **size)
    assert env.camera == "follow"
    env.reset()
    for _ in range(60):
        env.step(np.array([3, 0]))
    assert env.simulation.data.qpos[0] > 1
    frame = env.render()
    assert frame.shape == (32, 48, 3)
    assert frame[16, 24, 0] > 100 > frame[16, 24, 1]
    env.close()
    env.close()
    with pytest.raises(mjrec.UnknownName, match=r"'nose'.*fixed, follow"):
        MjcfEnvironment(env.path, camera="nose")

    path = write(cameras=FIXED)
    env = MjcfEnvironment(path, **size)
    env.reset()
    frame = env.render()
    assert frame[16, 24, 1] > 100 > frame[16, 24, 0]
    env.close()
    cameras = [env, MjcfEnvironment(path, camera=-1), MjcfEnvironment(write())]
    assert [each.camera for each in cameras] == ["fixed", -1, -1]
    assert (cameras[1].height, cameras[1].width) == (480, 480)


def test_without_a_render_mode_nothing_is_rendered(write):
    """Rendering is an error that says how to make the environment."""
    env = MjcfEnvironment(write())
    env.reset()
    with pytest.raises(mjrec.NoPictures, match='render_mode="rgb_array"'):
        env.render()
    with pytest.raises(mjrec.InvalidArgument, match="render_mode"):
        MjcfEnvironment(write(), render_mode="human")
    with pytest.raises(mjrec.InvalidArgument, match=r"no more arguments.*frame_skip"):
        make_mjcf(write(), EnvironmentOptions(kwargs={"frame_skip": 2}))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<mujoco><wrld/></mujoco>", "unrecognized element.*wrld"),
        ("", "XML"),
        ('<mujoco><asset><mesh file="nowhere.stl"/></asset></mujoco>', "nowhere.stl"),
    ],
)
def test_a_bad_file_gives_mujocos_reason_and_its_own_name(tmp_path, text, reason):
    """One sentence: which file, and what MuJoCo says is wrong in it."""
    path = tmp_path / "bad.xml"
    path.write_text(text)
    with pytest.raises(mjrec.UnreadableFile, match=f"bad.xml: .*{reason}") as caught:
        load_mjcf(path)
    assert "\n" not in str(caught.value)
