# SPDX-License-Identifier: Apache-2.0
"""Policies by their names, and the actions that they give."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

import mjrec
from mjrec.environments.episode_seeds import EpisodeSeeds, episode_seeds
from mjrec.environments.gymnasium_actions import GymnasiumActions
from mjrec.environments.policies import Policy, load_policy, policy_from

SEEDS = EpisodeSeeds(environment=1, actions=2, policy=3)

MIXED = spaces.Dict(
    {
        "arm": spaces.Box(np.array([-1, 1], np.float32), np.array([1, 2], np.float32)),
        "grip": spaces.Discrete(3),
        "both": spaces.Tuple([spaces.MultiDiscrete([2, 5]), spaces.MultiBinary(3)]),
    }
)


def acting_in(space: Any) -> Any:
    """Return something that has an action space, as a Gymnasium environment has."""
    return SimpleNamespace(action_space=space)


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Write a module into the working directory; forget it afterwards."""
    monkeypatch.chdir(tmp_path)
    written = []

    def write_module(text: str, name: str = "mjrec_test_policy") -> None:
        (tmp_path / f"{name}.py").write_text(text)
        written.append(name)

    yield write_module
    for name in written:
        sys.modules.pop(name, None)


Write = Callable[..., None]
BOX = acting_in(spaces.Box(-1, 1, (2,), np.float32))


def load(name: str, environment: Any = BOX) -> Policy:
    return load_policy(f"mjrec_test_policy:{name}", environment)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 2, (3,), np.float32),
        spaces.Box(-np.inf, np.inf, (2,), np.float64),
        spaces.Discrete(5, start=-2),
        spaces.MultiDiscrete([3, 4]),
        MIXED,
    ],
)
def test_random_actions_are_the_episodes(space: gymnasium.Space[Any]) -> None:
    """They lie in the space, and the same seed gives the same ones again."""

    def drawn(policy: Policy, episode: int) -> list[Any]:
        policy.reset(episode_seeds(0, episode))
        return [policy(None) for _ in range(20)]

    policy = load_policy("random", acting_in(space))
    first = drawn(policy, 3)
    assert all(space.contains(action) for action in first)
    assert repr(drawn(policy, 4)) != repr(first)
    assert repr(drawn(policy, 3)) == repr(first)
    assert repr(drawn(load_policy("random", acting_in(space)), 3)) == repr(first)


def test_drawing_leaves_the_environments_own_space_alone() -> None:
    """Who draws from that one gets what they would have got."""
    space = spaces.Box(-1, 1, (2,), np.float32)
    policy = load_policy("random", acting_in(space))
    space.seed(9)
    expected = space.sample()
    space.seed(9)
    policy.reset(SEEDS)
    policy(None)
    assert np.array_equal(space.sample(), expected)


@pytest.mark.parametrize(
    ("space", "zero"),
    [
        (spaces.Box(-1, 1, (2,), np.float32), [0, 0]),
        (spaces.Box(np.array([0.5, -3]), np.array([2, -1.0]), dtype=float), [0.5, -1]),
        (spaces.Discrete(3), 0),
        (spaces.Discrete(3, start=4), 4),
        (spaces.Discrete(3, start=-1), 0),
        (spaces.MultiDiscrete([2, 2], start=[1, -1]), [1, 0]),
        (spaces.MultiBinary(2), [0, 0]),
    ],
)
def test_zero_is_the_action_nearest_to_zero(space: Any, zero: Any) -> None:
    """Within the bounds, of the space's own type."""
    policy = load_policy("zero", acting_in(space))
    policy.reset(SEEDS)
    action = policy(None)
    assert space.contains(action)
    assert np.array_equal(action, zero)


def test_zero_of_parts_is_zero_in_each() -> None:
    """And of what has none is an error, before any episode begins."""
    policy = load_policy("zero", acting_in(MIXED))
    assert MIXED.contains(policy(None))
    with pytest.raises(mjrec.PolicyError, match="no zero of the action space Text"):
        load_policy("zero", acting_in(spaces.Text(3)))


def test_an_environment_may_write_into_zero() -> None:
    """The next zero is zero again."""
    policy = load_policy("zero", BOX)
    policy(None)[:] = 7
    assert policy(None).tolist() == [0, 0]


def test_dm_envs_actions_are_drawn_within_their_bounds() -> None:
    """Nested ones too; a number without bounds is drawn around zero."""
    specs = pytest.importorskip("dm_env").specs
    endless = 1e10
    spec = {
        "bounded": specs.BoundedArray((2,), np.float32, [-1, 2], [0, 3]),
        "endless": specs.BoundedArray((2,), float, -endless, endless),
        "half": specs.BoundedArray((), float, 5, np.inf),
        "parts": [specs.DiscreteArray(4), specs.Array((3,), np.float64)],
    }
    environment = SimpleNamespace(action_spec=lambda: spec)
    policy = load_policy("random", environment)

    def drawn() -> list[Any]:
        policy.reset(SEEDS)
        return [policy(None) for _ in range(300)]

    actions = drawn()
    assert repr(drawn()) == repr(actions)
    for action in actions:
        spec["bounded"].validate(action["bounded"])
        spec["parts"][0].validate(action["parts"][0])
        assert action["half"] >= 5
    bounded = np.array([action["bounded"] for action in actions])
    assert bounded.mean(axis=0) == pytest.approx([-0.5, 2.5], abs=0.1)
    free = np.array([action["endless"] for action in actions])
    assert (abs(free.mean()), free.std()) == (
        pytest.approx(0, abs=0.2),
        pytest.approx(1, abs=0.2),
    )
    zero = load_policy("zero", environment)(None)
    assert zero["bounded"].tolist() == [0, 2]
    assert (zero["half"], zero["parts"][0]) == (5, 0)
    assert zero["endless"].tolist() == [0, 0]


def test_dm_envs_actions_are_checked() -> None:
    """Every leaf by itself, and that none is missing."""
    specs = pytest.importorskip("dm_env").specs
    from mjrec.environments.dm_env_actions import DmEnvActions

    spec = (specs.DiscreteArray(4), {"a": specs.BoundedArray((2,), float, -1, 1)})
    actions = DmEnvActions(spec)
    assert actions.checked((3, {"a": [0, 5]})) == (3, {"a": [0, 5]})
    for bad in (
        None,
        (3,),
        (4, {"a": [0, 0]}),
        (1.0, {"a": [0, 0]}),
        (3, {}),
        (3, {"a": [0, np.nan]}),
        (3, {"a": [[0], [0, 1]]}),
        (3, [0, 0]),
    ):
        with pytest.raises(mjrec.PolicyError, match="DiscreteArray"):
            actions.checked(bad)


def test_actions_without_numbers_need_a_policy_of_ones_own() -> None:
    """dm_env has strings too."""
    specs = pytest.importorskip("dm_env").specs
    environment = SimpleNamespace(action_spec=lambda: specs.StringArray(()))
    with pytest.raises(mjrec.PolicyError, match="module:name"):
        load_policy("zero", environment)


@pytest.mark.parametrize(
    ("space", "action"),
    [
        (spaces.Box(-1, 1, (2,), np.float32), np.array([3.0, 0])),
        (spaces.Box(-1, 1, (2,), np.float32), [0, 1]),
        (spaces.Discrete(3), np.array(2)),
        (spaces.Discrete(3), np.array([1])),
        (spaces.MultiBinary(2), np.array([0, 1], np.int8)),
    ],
)
def test_actions_of_other_types_are_taken(space: Any, action: Any) -> None:
    """Policies give float64, lists, and arrays of one number."""
    checked = GymnasiumActions(space).checked(action)
    assert np.array_equal(np.ravel(checked), np.ravel(action))
    if isinstance(space, spaces.Discrete):
        assert type(checked) is int


@pytest.mark.parametrize(
    ("space", "action"),
    [
        (spaces.Box(-1, 1, (2,)), None),
        (spaces.Box(-1, 1, (2,)), np.zeros(3)),
        (spaces.Box(-1, 1, (2,)), np.zeros((1, 2))),
        (spaces.Box(-1, 1, (2,)), np.array([0, np.nan])),
        (spaces.Box(-1, 1, (2,)), np.array([0, np.inf])),
        (spaces.Box(-1, 1, (2,)), ["a", "b"]),
        (spaces.Box(-1, 1, (2,)), [[1], [1, 2]]),
        (spaces.Discrete(3), 3),
        (spaces.Discrete(3), 1.0),
        (spaces.Discrete(3), np.array([1, 2])),
        (spaces.Discrete(3), None),
        (spaces.MultiDiscrete([2, 2]), None),
        (MIXED, {"arm": 1}),
    ],
)
def test_what_is_no_action_is_refused(
    write: Write, space: gymnasium.Space[Any], action: Any
) -> None:
    """The message says what the space is and what came."""
    write("action = None\ndef policy(observation):\n    return action\n")
    policy = load("policy", acting_in(space))
    sys.modules["mjrec_test_policy"].action = action  # type: ignore[attr-defined]  # of the test's module
    with pytest.raises(mjrec.PolicyError, match="must give an action of ") as caught:
        policy(None)
    assert str(space) in str(caught.value)
    assert repr(action) in str(caught.value)


def test_a_function_is_the_policy(write: Write) -> None:
    """It is called with the observation."""
    write("def policy(observation):\n    return observation * 2\n")
    policy = load("policy")
    policy.reset(SEEDS)
    assert policy(np.array([0.1, 0.2])).tolist() == [0.2, 0.4]


def test_a_class_is_built_with_the_environment(write: Write) -> None:
    """And its reset gets the policy's own seed at each episode."""
    write(
        "class Policy:\n"
        "    def __init__(self, environment): self.space = environment.action_space\n"
        "    def reset(self, seed): self.seed = seed\n"
        "    def __call__(self, observation): return [self.seed, *self.space.shape]\n"
    )
    policy = load("Policy")
    policy.reset(SEEDS)
    assert policy(None) == [3, 2]


def test_parentheses_call_with_the_environment(write: Write) -> None:
    """What comes back is the policy."""
    write(
        "def make(environment):\n"
        "    return lambda observation: [environment.action_space.shape[0]] * 2\n"
    )
    assert load("make()")(None) == [2, 2]


def test_names_may_have_dots(write: Write) -> None:
    """A method of an object, for example."""
    write("class Inner:\n    @staticmethod\n    def act(o): return [0, 1]\n")
    assert load("Inner.act")(None) == [0, 1]


def test_predict_is_understood(write: Write) -> None:
    """Stable-Baselines3's: deterministic, with state and start of the episode."""
    write(
        "import numpy as np\n"
        "class Model:\n"
        "    def __init__(self, environment=None): self.calls = []\n"
        "    def predict(self, observation, state=None, episode_start=None,\n"
        "                deterministic=False):\n"
        "        self.calls.append((observation, state, episode_start.tolist(),\n"
        "                           deterministic))\n"
        "        return np.zeros(2), (0 if state is None else state) + 1\n"
        "    def __call__(self, observation): raise AssertionError('not this one')\n"
        "model = Model()\n"
    )
    policy = load("model")
    calls = sys.modules["mjrec_test_policy"].model.calls
    for _ in range(2):
        policy.reset(SEEDS)
        policy("a")
        policy("b")
    once = [("a", None, [True], True), ("b", 1, [False], True)]
    assert calls == once * 2


def test_a_predict_of_fewer_arguments_is_understood(write: Write) -> None:
    """Also one that gives just the action."""
    write(
        "class Short:\n"
        "    def __init__(self, environment): pass\n"
        "    def predict(self, state): return [state, 0]\n"
        "class Usual(Short):\n"
        "    def predict(self, obs, deterministic=True):\n"
        "        return [obs, int(deterministic)], None\n"
    )
    assert load("Short")(1) == [1, 0]
    assert load("Usual")(1) == [1, 1]


def test_the_working_directory_is_importable_and_then_no_more(write: Write) -> None:
    """A policy may import its neighbours; the path is put back."""
    write("value = [0.5, 0.5]\n", name="mjrec_test_neighbour")
    write(
        "def make(environment):\n"
        "    import mjrec_test_neighbour\n"
        "    return lambda observation: mjrec_test_neighbour.value\n"
    )
    path = list(sys.path)
    assert load("make()")(None) == [0.5, 0.5]
    assert sys.path == path


def test_an_unknown_policy_says_what_there_is(write: Write) -> None:
    """Built-in names, modules nearby, names in the module."""
    write("import math\ndef act(observation): pass\nclass Other: pass\n_x = 1\n")
    with pytest.raises(mjrec.UnknownName, match=r"'rnd'.*random, zero.*module:name"):
        load_policy("rnd", BOX)
    for half in (":act", "mjrec_test_policy:", "mjrec_test_policy:()"):
        with pytest.raises(mjrec.UnknownName, match="module:name"):
            load_policy(half, BOX)
    with pytest.raises(mjrec.UnknownName, match=r"'mjrec_test_plicy'.*test_policy"):
        load_policy("mjrec_test_plicy:act", BOX)
    with pytest.raises(mjrec.UnknownName, match=r"'atc'.*There are: Other, act"):
        load("atc")


def test_a_module_that_cannot_be_imported_says_why(write: Write) -> None:
    """Where it happened, and the exception for those who look."""
    write("def f(o): pass\n1 / 0\n")
    with pytest.raises(
        mjrec.PolicyError, match=r"ZeroDivisionError.*mjrec_test_policy.py, line 2"
    ) as caught:
        load("f")
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    write("import no_such_module_at_all\n")
    with pytest.raises(mjrec.PolicyError, match="no_such_module_at_all"):
        load("f")
    write("def f(o:\n")
    with pytest.raises(mjrec.PolicyError, match=r"SyntaxError.*line 1\)\.$"):
        load("f")


def test_what_a_policy_raises_is_named(write: Write) -> None:
    """While it is built, reset, or asked; with the line of its own file."""
    write(
        "class Late:\n"
        "    def __init__(self, environment): pass\n"
        "    def reset(self, seed): raise KeyError('in reset')\n"
        "    def __call__(self, o): raise KeyError('in call')\n"
        "class Early(Late):\n"
        "    def __init__(self): pass\n"
    )
    policy = load("Late")
    with pytest.raises(mjrec.PolicyError, match=r"reset\(3\).*in reset.*line 3") as e:
        policy.reset(SEEDS)
    assert isinstance(e.value.__cause__, KeyError)
    with pytest.raises(mjrec.PolicyError, match=r"in call.*line 4"):
        policy(None)
    with pytest.raises(mjrec.PolicyError, match=r"Building .*Early.*TypeError"):
        load("Early")


def test_what_is_no_policy_is_refused(write: Write) -> None:
    """A number, and a call of what cannot be called."""
    write("number = 3\ndef make(environment): return 3\n")
    with pytest.raises(mjrec.PolicyError, match="3, which neither"):
        load("number")
    with pytest.raises(mjrec.PolicyError, match="3, which neither"):
        load("make()")
    with pytest.raises(mjrec.PolicyError, match="Leave the parentheses away"):
        load("number()")


def test_an_object_is_a_policy_as_what_a_name_names() -> None:
    """Functions, objects with `predict` and classes need no module to be found in."""

    class Still:
        def __init__(self, environment: Any) -> None:
            self.shape = environment.action_space.shape

        def predict(self, observation: Any) -> Any:
            return np.zeros(self.shape, np.float32), None

    half = np.full(2, 0.5, np.float32)
    assert (
        policy_from(lambda observation: half, "half", BOX)(None).tolist() == [0.5] * 2
    )
    assert policy_from(Still, "Still", BOX)(None).tolist() == [0, 0]
    assert policy_from(Still(BOX), "Still", BOX)(None).tolist() == [0, 0]


def test_an_object_that_is_no_policy_is_named() -> None:
    """What it is called stands in what is said of it."""
    with pytest.raises(mjrec.PolicyError, match="mine gives 3"):
        policy_from(3, "mine", BOX)
    broken = policy_from(lambda observation: 1 / 0, "mine", BOX)
    with pytest.raises(mjrec.PolicyError, match="The policy mine raised ZeroDiv"):
        broken(None)
