# SPDX-License-Identifier: Apache-2.0
"""Which environments are made again from a recording, and that nothing else runs."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from mjrec.environments.made_again import (
    UNKNOWN,
    EpisodeStart,
    NotMadeAgain,
    make_again,
    recorded_environment,
)

SEEDED = EpisodeStart(seed=1, random_state=None, options=None)


def facts(env_id: Any, *, framework: Any = "gymnasium", **said: Any) -> dict[str, Any]:
    """Return what a recording says of its environment."""
    known = {"framework": framework, "id": env_id, "kwargs": {}, "wrappers": []}
    return {"environment": {**known, **said}}


def refusal(said: Mapping[str, Any], *trust: str) -> str:
    """Return why an environment is not made."""
    with pytest.raises(NotMadeAgain) as raised:
        make_again(recorded_environment(said), trust=frozenset(trust))
    return str(raised.value)


def test_an_environment_of_gymnasium_is_made_with_its_arguments_and_limit() -> None:
    """What changes the simulation is given to it; how it is shown is not."""
    kwargs = {"frame_skip": 3, "render_mode": "human", "camera_name": "track"}
    said = facts("InvertedPendulum-v5", kwargs=kwargs, max_episode_steps=2)
    environment = make_again(recorded_environment(said))
    environment.begin(SEEDED)
    _, data = environment.simulation()
    environment.step(np.zeros(1))
    assert data.time == pytest.approx(0.06)
    assert environment.step(np.zeros(1)).truncated
    environment.close()


@pytest.mark.parametrize(
    "env_id",
    [
        "subprocess:check_output",
        "os:system",
        "CartPole-v1",
        "../InvertedPendulum-v5",
        "Nobody-v0",
        "",
    ],
)
def test_other_ids_are_refused(env_id: str) -> None:
    """Only ids of known packages are made, and the way out is named."""
    reason = refusal(facts(env_id))
    assert reason.startswith("would run code from the archive")
    assert f"--trust {env_id}" in reason


def test_no_module_is_imported_for_an_id(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a recording names is text, though it could be imported or resolved."""
    (tmp_path / "traps.py").write_text("raise SystemExit('it ran')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    refusal(facts("traps:Trap-v0"))
    refusal(facts("traps:Trap-v0", framework="dm_control"))
    said = {"entry_point": "traps:Trap", "kwargs": {"args": ["touch", "ran"]}}
    refusal(facts("InvertedPendulum-v5", **said, spec=said))
    refusal(facts("InvertedPendulum-v5", entry_point="traps:T", wrappers=["traps.T"]))
    assert "traps" not in sys.modules
    assert not (tmp_path / "ran").exists()


def test_somebody_elses_id_in_the_registry_is_refused(
    registered: str,
) -> None:
    """That an id is registered does not make it one of Gymnasium's own."""
    assert refusal(facts(registered)).startswith("would run code from the archive")


def test_an_id_that_the_reader_trusts_is_made(registered: str) -> None:
    """With its exact name, or that of the module before it."""
    for trust in (registered, f"gymnasium:{registered}"):
        said = recorded_environment(facts(registered))
        environment = make_again(said, trust=frozenset([trust]))
        environment.close()
    assert "--trust" in refusal(facts(registered), registered[:-1])


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the id of an environment that a user has registered."""
    monkeypatch.setattr(gymnasium.envs.registration, "registry", {**gymnasium.registry})
    gymnasium.register("Mine-v0", entry_point=f"{__name__}:mine")
    return "Mine-v0"


def mine(**kwargs: Any) -> gymnasium.Env[Any, Any]:
    """Return an environment."""
    return gymnasium.make("InvertedPendulum-v5", **kwargs).unwrapped


@pytest.mark.parametrize(
    "kwargs",
    [
        {"xml_file": "/etc/passwd"},
        {"xml_file": "ant.xml"},
        {"frame_skip": "../x"},
        {"frame_skip": {"a": 1}},
        {"reward": "a.b"},
        {"max_episode_steps": 7},
        {"disable_env_checker": False},
        {"frame_skip": [0] * 20_000},
        {"no_such": 1},
        None,
    ],
)
def test_arguments_that_are_more_than_plain_values_are_refused(kwargs: Any) -> None:
    """Arguments name no files, and hold no objects."""
    refusal(facts("InvertedPendulum-v5", kwargs=kwargs))


def test_wrappers_are_named_and_not_made() -> None:
    """What stood between is not made again."""
    reason = refusal(facts("InvertedPendulum-v5", wrappers=["a.B", "c.D"]))
    assert "a.B, c.D" in reason


@pytest.mark.parametrize(
    "said",
    [
        {},
        {"environment": None},
        {"environment": "HalfCheetah-v5"},
        facts(7),
        facts("HalfCheetah-v5", framework="pickle"),
        facts("HalfCheetah-v5", kwargs=[1]),
        facts("HalfCheetah-v5", max_episode_steps="many"),
        facts("HalfCheetah-v5", max_episode_steps=-1),
    ],
)
def test_what_cannot_be_is_refused(said: dict[str, Any]) -> None:
    """Facts of another kind are a reason, and no other error."""
    with pytest.raises(NotMadeAgain):
        recorded_environment(said)


def test_what_an_older_recording_does_not_say_is_unknown() -> None:
    """Wrappers and limits that are not there are not none."""
    said = {"environment": {"framework": "gymnasium", "id": "A-v0", "kwargs": {}}}
    recorded = recorded_environment(said)
    assert recorded.wrappers is None
    assert recorded.max_episode_steps is UNKNOWN


@pytest.mark.parametrize(
    "state",
    [
        None,
        "MT19937",
        {},
        {"bit_generator": "PCG64", "state": 7},
        {"bit_generator": "os", "state": {"state": 1, "inc": 2}},
        {"bit_generator": "PCG64", "state": {"state": "x", "inc": 2}},
    ],
)
def test_a_random_state_that_is_none_is_a_reason(state: Any) -> None:
    """Hostile random states end in a refusal."""
    environment = make_again(recorded_environment(facts("InvertedPendulum-v5")))
    with pytest.raises(NotMadeAgain):
        environment.begin(EpisodeStart(seed=None, random_state=state, options=None))
    environment.close()


def test_options_of_a_reset_are_plain() -> None:
    """Options go to the reset only where they are numbers and words."""
    environment = make_again(recorded_environment(facts("InvertedPendulum-v5")))
    environment.begin(EpisodeStart(seed=1, random_state=None, options={"a": [1, 2]}))
    for options in ({"a": {"b": 1}}, {"file": "x"}, {"a": "../x"}, "no"):
        with pytest.raises(NotMadeAgain):
            environment.begin(EpisodeStart(seed=1, random_state=None, options=options))
    environment.close()


@pytest.mark.parametrize(
    "env_id", ["dm_control/nobody-walks", "dm_control/cartpole-x", "dm_control/x", "a"]
)
def test_unknown_tasks_of_the_suite_are_refused(env_id: str) -> None:
    """Only tasks that stand in the suite's own table are made."""
    pytest.importorskip("dm_control")
    assert "suite" in refusal(facts(env_id, framework="dm_control", kwargs=None))


def test_a_task_of_the_suite_ends_where_it_was_ended() -> None:
    """A limit that was in force is in force again."""
    pytest.importorskip("dm_control")
    said = facts(
        "dm_control/cartpole-swingup",
        framework="dm_control",
        kwargs=None,
        max_episode_steps=2,
    )
    environment = make_again(recorded_environment(said))
    environment.begin(SEEDED)
    assert not environment.step(np.zeros(1)).truncated
    assert environment.step(np.zeros(1)).truncated
