# SPDX-License-Identifier: Apache-2.0
"""Environments are recreated from a recording without running any other code."""

import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import ClipAction, RescaleAction

import mjrec
from mjrec.environments.recreate import (
    NotRecreated,
    Recreated,
    checked_options,
    recreate,
)
from mjrec.environments.scenes import generator_state
from mjrec.environments.wrapping import RecordedSteps, around_gymnasium
from mjrec.formats.trajectory_hdf5 import open_hdf5

PENDULUM = "InvertedPendulum-v5"


def facts(env_id, *, framework="gymnasium", **said):
    """Return what a recording says about its environment."""
    known = {"framework": framework, "id": env_id, "kwargs": {}, "wrappers": []}
    return {**known, "max_episode_steps": None, **said}


def refusal(said, *trust):
    """Return the reason why an environment is not recreated."""
    with pytest.raises(NotRecreated) as raised:
        recreate(said, trust=frozenset(trust))
    return str(raised.value)


@pytest.fixture
def pendulum():
    """Return a recreated Gymnasium environment."""
    return recreate(facts(PENDULUM))


def test_an_environment_is_made_with_its_arguments_limit_and_view():
    kwargs = {"frame_skip": 3, "render_mode": "rgb_array", "width": 32, "height": 24}
    env = recreate(facts(PENDULUM, kwargs=kwargs, max_episode_steps=2)).environment
    env.reset(seed=1)
    env.step(np.zeros(1))
    assert env.unwrapped.data.time == pytest.approx(0.06)
    assert env.step(np.zeros(1))[3]
    assert env.unwrapped.spec.kwargs == kwargs


@pytest.mark.parametrize("limit", [None, 7, 5000])
def test_the_recorded_limit_replaces_the_registered_one(limit):
    """The recorded limit may be none, lower or higher."""
    made = recreate(facts("HalfCheetah-v5", max_episode_steps=limit)).environment
    assert made.spec.max_episode_steps == limit


@pytest.mark.parametrize(
    "env_id",
    ["subprocess:check_output", "os:system", f"../{PENDULUM}", "Nobody-v0", ""],
)
def test_other_ids_are_refused(env_id):
    """Only ids of known packages are accepted, and the error names the remedy."""
    reason = refusal(facts(env_id))
    assert reason.startswith("this would run code from the archive")
    assert f"--trust {env_id}" in reason


def test_no_module_is_imported_for_an_id(tmp_path, monkeypatch):
    """Names in a recording are text, even if they could be imported."""
    (tmp_path / "traps.py").write_text("raise SystemExit('it ran')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    refusal(facts("traps:Trap-v0"))
    refusal(facts("traps:Trap-v0", framework="dm_control"))
    said = {"entry_point": "traps:Trap", "kwargs": {"args": ["touch", "ran"]}}
    refusal(facts(PENDULUM, **said, spec=said))
    recreate(facts(PENDULUM, entry_point="traps:T", wrappers=["traps.T"]))
    assert "traps" not in sys.modules
    assert not (tmp_path / "ran").exists()


def mine(**kwargs):
    """Return an environment that a user has registered."""
    return gymnasium.make(PENDULUM, **kwargs).unwrapped


def test_a_registered_id_is_made_where_the_reader_trusts_it(monkeypatch):
    """Trust requires the exact name, with or without its module."""
    monkeypatch.setattr(gymnasium.envs.registration, "registry", {**gymnasium.registry})
    gymnasium.register("Mine-v0", entry_point=f"{__name__}:mine")
    for trust in ("Mine-v0", "gymnasium:Mine-v0"):
        recreate(facts("Mine-v0"), trust=frozenset([trust]))
    assert "--trust" in refusal(facts("Mine-v0"))
    assert "--trust" in refusal(facts("Mine-v0"), "Mine-v")


CARTPOLE = {"framework": "dm_control", "env_id": "dm_control/cartpole-balance"}
REFUSED = [
    # Arguments must not name files, hold objects or be excessive.
    *(
        {"kwargs": kwargs}
        for kwargs in (
            {"xml_file": "/etc/passwd"},
            {"xml_file": "ant.xml"},
            {"frame_skip": "../x"},
            {"reward": "a.b"},
            {"max_episode_steps": 7},
            {"disable_env_checker": False},
            {"frame_skip": [0] * 20_000},
            {"frame_skip": 10**6},
            {"reset_noise_scale": 1e300},
            {"width": 10**6},
            {"default_camera_config": {"path": 1}},
            {"render_mode": "human"},
            {"no_such": 1},
            None,
            [1],
        )
    ),
    {"env_id": 7},
    {"framework": "pickle"},
    {"framework": "mjcf"},
    {"max_episode_steps": "many"},
    {"max_episode_steps": -1},
    {"wrappers": ["a.B"], "wrapper_arguments": [1, 2]},
    {"framework": "dm_control", "env_id": "dm_control/x"},
    {"framework": "dm_control", "env_id": "dm_control/x-y"},
    {**CARTPOLE, "wrappers": ["a.B"]},
    {**CARTPOLE, "kwargs": {"random": 1}},
    {**CARTPOLE, "kwargs": {"task_kwargs": {"file": "x"}}},
    # This task draws its model from an unknown seed.
    {**CARTPOLE, "env_id": "dm_control/lqr-lqr_2_1"},
]


@pytest.mark.parametrize("said", REFUSED)
def test_what_cannot_be_made_is_refused(said):
    """Facts without an environment are refused too."""
    refusal(facts(**{"env_id": PENDULUM, **said}))
    refusal({})


def test_gymnasium_wrappers_are_recreated():
    """Wrappers keep their arguments and order."""
    env = ClipAction(RescaleAction(gymnasium.make("HalfCheetah-v5"), -2, 2))
    again = recreate(facts("HalfCheetah-v5", **around_gymnasium(env))).environment
    assert isinstance(again, ClipAction)
    assert around_gymnasium(again) == around_gymnasium(env)
    for each in (env, again):
        each.reset(seed=1)
    action = np.full(6, 1.5, np.float32)
    assert np.array_equal(env.step(action)[0], again.step(action)[0])


def test_of_other_wrappers_there_are_stand_ins():
    """A stand-in steps with recorded controls and returns recorded values."""
    recreated = recreate(facts("HalfCheetah-v5", wrappers=["a.B", "c.D"]))
    env, stand_in = recreated.environment, recreated.stand_in
    assert around_gymnasium(env)["wrappers"] == ["a.B", "c.D"]
    bare, controls = gymnasium.make("HalfCheetah-v5"), np.full((2, 6), 0.5)
    bare.reset(seed=1)
    reward = float(bare.step(controls[0])[1])
    ends = np.zeros(2, bool)
    recorded = RecordedSteps(
        controls=controls,
        rewards=np.array([reward, 7.0]),
        terminated=ends,
        truncated=ends,
    )
    env.reset(seed=1)
    stand_in.begin(recorded)
    assert [env.step("anything")[1] for _ in range(2)] == [reward, 7.0]
    assert stand_in.differing == 1


@pytest.mark.parametrize(
    "state",
    [
        "MT19937",
        {},
        {"bit_generator": "PCG64", "state": 7},
        {"bit_generator": "os", "state": {"state": 1, "inc": 2}},
        {"bit_generator": "PCG64", "state": {"state": "x", "inc": 2}},
    ],
)
def test_a_malformed_random_state_is_refused(state, pendulum):
    with pytest.raises(NotRecreated):
        pendulum.set_random_state(state)


def test_a_random_state_leads_to_the_same_beginning(pendulum):
    """The seed can be recovered only from an unused dm_control generator."""
    pendulum.environment.reset(seed=3)
    before = pendulum.random_state()
    first = pendulum.environment.reset()[0]
    pendulum.set_random_state(before)
    assert np.array_equal(pendulum.environment.reset()[0], first)
    assert pendulum.seed_behind(pendulum.random_state()) is None
    legacy = generator_state(np.random.RandomState(4))
    assert Recreated(environment=None, is_dm_env=True).seed_behind(legacy) == 4


def test_steps_from_recorded_states_are_the_recorded_steps(pendulum, tmp_path):
    """Steps are equal bit for bit here; elsewhere, differences do not grow."""
    kept = {"video_callable": False, "trajectory_callable": True}
    with mjrec.Monitor(gymnasium.make(PENDULUM), tmp_path, **kept) as monitor:
        monitor.reset(seed=3)
        monitor.action_space.seed(3)
        for _ in range(3):
            monitor.step(monitor.action_space.sample())
    with open_hdf5(next(tmp_path.glob("*.h5"))) as reader:
        states, actions = reader.read("state", 0, 4), reader.actions(0, 3)
        rewards = reader.rewards
    pendulum.environment.reset(seed=99)
    unknown = np.full_like(states.view(np.float64), np.nan).view(states.dtype)
    for number, action in enumerate(actions):
        pendulum.put_into(states[number : number + 1])
        # An unknown state must not change the environment.
        pendulum.put_into(unknown[:1])
        _, reward, *_ = pendulum.environment.step(action)
        assert reward == rewards[number]
        data = pendulum.environment.unwrapped.data
        assert np.array_equal(data.qpos, states["qpos"][number + 1])
    # No seed leads to this state, so the observation must be computed from it.
    state = states[2:3]
    expected = [*state["qpos"][0], *state["qvel"][0]]
    assert pendulum.enter(state, None).tolist() == expected


def test_options_of_a_reset_are_plain():
    """Only options made of numbers and words reach the reset."""
    assert checked_options(None) is None
    assert checked_options({"a": [1, 2]}) == {"a": [1, 2]}
    for options in ({"file": "x"}, {"a": "../x"}, {"a": {"path": 1}}, "no"):
        with pytest.raises(NotRecreated):
            checked_options(options)


@pytest.mark.dm_control
def test_a_task_of_the_suite_is_recreated():
    """The task keeps its arguments, and its generator's state reveals the seed."""
    pytest.importorskip("dm_control.suite")
    kwargs = {"task_kwargs": {"random": 5, "time_limit": 0.2}}
    said = facts("dm_control/cartpole-balance", framework="dm_control", kwargs=kwargs)
    recreated = recreate({**said, "max_episode_steps": 5})
    assert recreated.seed_behind(recreated.random_state()) == 5
    env = recreated.environment
    env.reset()
    assert recreated.seed_behind(recreated.random_state()) is None
    assert [env.step(np.zeros(1)).last() for _ in range(5)] == [False] * 4 + [True]
