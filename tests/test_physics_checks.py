# SPDX-License-Identifier: Apache-2.0
"""Which recordings pass the level `physics`, and which forgeries it finds."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from forged_episodes import (
    copied,
    episode,
    fact,
    failed,
    forge,
    physics_of,
    record_gymnasium,
    record_mjcf,
    record_suite,
    swap_model,
    unchecked,
    verdicts,
)
from parts import parametrize
from trajectories_by_hand import write_log
from trajectory_contents import content_of

from mjrec.evidence.verification import Verdict
from mjrec.formats.trajectory import ModelChange
from mjrec.formats.trajectory_file import TrajectoryReader, open_trajectory

needs_dm_control = pytest.mark.skipif(
    importlib.util.find_spec("dm_control") is None, reason="dm_control is not installed"
)

BALL = """<mujoco><option timestep="0.01"/><worldbody>
  <geom type="plane" size="1 1 .1"/>
  <body pos="0 0 .3"><freejoint/><geom size=".1"/></body>
  <body pos="1 0 1"><joint name="hinge"/><geom size=".1" pos=".2 0 0"/></body>
</worldbody><actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""

NO_SEED = {"seed": None, "random_state": None}
OTHER_MACHINE = {"architecture": "abacus", "libc": "none", "cpu_flags": ""}


@pytest.fixture(scope="session")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return two episodes of InvertedPendulum-v5, which are not to be changed."""
    directory = tmp_path_factory.mktemp("pendulum") / "run"
    env = gymnasium.make("InvertedPendulum-v5")
    # It would fall.
    return record_gymnasium(directory, env, steps=12, size=0.02)


@pytest.fixture(scope="session")
def hopper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an episode of Hopper-v5 that falls."""
    directory = tmp_path_factory.mktemp("hopper") / "run"
    env = gymnasium.make("Hopper-v5")
    return record_gymnasium(directory, env, episodes=1, steps=100)


@pytest.fixture
def forged(pendulum: Path, tmp_path: Path) -> Path:
    """Return a copy of the pendulum's episodes to be forged."""
    return copied(pendulum, tmp_path / "run")


@parametrize(
    ("env_id", "kind"),
    [
        ("InvertedPendulum-v5", np.float32),
        ("HalfCheetah-v5", np.float32),
        ("HalfCheetah-v5", np.float64),
        ("Ant-v5", np.float32),
    ],
    default=2,
)
def test_an_honest_recording_passes(env_id: str, kind: type, tmp_path: Path) -> None:
    """All of a Gymnasium environment passes, whatever float the actions were."""
    env = gymnasium.make(env_id, max_episode_steps=15)
    checks = physics_of(record_gymnasium(tmp_path / "run", env, kind=kind))
    assert verdicts(checks) == {"pass": 17}
    assert all(check.reason.startswith("bit for bit") for check in checks[:5])


def test_an_episode_that_ends_by_itself_passes(hopper: Path) -> None:
    """A termination is one that the environment gives."""
    with first_episode(hopper) as reader:
        assert reader.terminated[-1]
    assert verdicts(physics_of(hopper)) == {"pass": 9}


def test_episodes_that_were_not_seeded_pass(tmp_path: Path) -> None:
    """A reset without a seed begins at the recorded state of the generator."""
    env = gymnasium.make("InvertedPendulum-v5")
    directory = tmp_path / "run"
    record_gymnasium(directory, env, seeds=lambda number: None if number else 1)
    # Else the generator would be where it should be by itself.
    episode(directory, 0).unlink()
    assert verdicts(physics_of(directory)) == {"pass": 9}


@parametrize("env_id", ["HalfCheetah-v5", "Reacher-v5", "Humanoid-v5"])
def test_an_episode_that_was_never_seeded_goes_on_from_its_first_state(
    env_id: str, tmp_path: Path
) -> None:
    """Without a seed and a random state nothing but its beginning is left open."""
    env = gymnasium.make(env_id)
    directory = tmp_path / "run"
    record_gymnasium(directory, env, seeds=lambda number: None, episodes=1)
    checks = physics_of(directory)
    assert verdicts(checks) == {"pass": 8, "not checkable": 1}
    assert all(check.reason.startswith("bit for bit") for check in checks[4:6])
    [start] = unchecked(checks)
    assert start.claim == "the environment begins in the recorded state"
    assert "give reset(seed=...)" in start.reason


@pytest.mark.thorough
def test_a_seed_that_is_taken_out_hides_no_reward(forged: Path) -> None:
    """Nor does one elsewhere, where each step begins at a recorded state."""
    forge(episode(forged), rewards=lambda r: r.__setitem__(3, 1e3), facts=NO_SEED)
    assert failed(physics_of(forged)) == ["rewards"]
    forge(episode(forged), facts={"machine": OTHER_MACHINE})
    assert failed(physics_of(forged)) == ["rewards"]


@pytest.mark.thorough
@needs_dm_control
def test_a_random_state_that_is_taken_out_hides_no_reward(tmp_path: Path) -> None:
    """Of the suite's tasks whose resets draw nothing that is not in the state."""
    directory = record_suite(tmp_path / "run", "cheetah", "run", episodes=1)
    forge(episode(directory), facts=NO_SEED)
    assert verdicts(physics_of(directory)) == {"pass": 8, "not checkable": 1}
    forge(episode(directory), rewards=lambda r: r.__setitem__(3, 1e3))
    assert failed(physics_of(directory)) == ["rewards"]


@pytest.mark.thorough
@needs_dm_control
def test_a_target_that_was_drawn_is_not_guessed(tmp_path: Path) -> None:
    """Where it stands in the model alone, nobody is accused."""
    directory = record_suite(tmp_path / "run", "reacher", "easy")
    for number in range(2):
        forge(episode(directory, number), facts=NO_SEED)
    checks = physics_of(directory)
    assert failed(checks) == []
    assert "neither a seed nor" in unchecked(checks)[-1].reason


@parametrize(
    ("name", "verdict"),
    [
        ("Humanoid-v5", Verdict.FAIL),
        pytest.param("dm_control/cheetah-run", Verdict.FAIL, marks=needs_dm_control),
        ("my pendulum", Verdict.NOT_CHECKABLE),
        (None, Verdict.NOT_CHECKABLE),
    ],
)
def test_results_bear_the_name_of_what_was_made(
    name: Any, verdict: Verdict, forged: Path
) -> None:
    """Another environment's name is a lie, one of the author's own is none."""
    forge(episode(forged), facts={"env_id": name})
    [check] = [c for c in physics_of(forged) if c.claim.startswith("the name")]
    assert check.verdict is verdict
    assert "made as InvertedPendulum-v5" in check.reason


def test_what_an_environment_was_made_with_is_said(tmp_path: Path) -> None:
    """Also where all is as it should be; how it is shown is not said."""
    env = gymnasium.make(
        "HalfCheetah-v5", forward_reward_weight=100.0, render_mode="rgb_array"
    )
    checks = physics_of(record_gymnasium(tmp_path / "run", env, episodes=1))
    assert verdicts(checks) == {"pass": 9}
    saying = [c.claim for c in checks if "forward_reward_weight=100.0" in c.reason]
    assert saying == [
        "the environment gives the recorded rewards",
        "the name that the results bear is that of the environment that was made",
    ]
    assert not any("render_mode" in check.reason for check in checks)


@needs_dm_control
@parametrize(
    ("domain", "task"),
    [
        ("cartpole", "swingup"),
        ("cheetah", "run"),
        ("reacher", "easy"),
        ("finger", "turn_hard"),
        ("point_mass", "hard"),
    ],
)
def test_a_recording_of_the_suite_passes(
    domain: str, task: str, tmp_path: Path
) -> None:
    """All of a suite's task passes, also where resets change the model."""
    directory = record_suite(tmp_path / "run", domain, task)
    assert verdicts(physics_of(directory)) == {"pass": 17}


@needs_dm_control
def test_a_model_that_is_drawn_at_random_is_not_checkable(tmp_path: Path) -> None:
    """The seed of lqr's springs is not recorded, and nobody is accused."""
    directory = record_suite(tmp_path / "run", "lqr", "lqr_2_1", episodes=1)
    checks = physics_of(directory)
    assert verdicts(checks) == {"not checkable": 4, "pass": 1}
    assert "draws its model at random" in unchecked(checks)[-1].reason


def test_an_mjcf_file_passes(tmp_path: Path) -> None:
    """Its environment is made again from the sources beside the recording."""
    directory = record_mjcf(tmp_path / "run", tmp_path / "ball.xml", BALL)
    checks = physics_of(directory)
    assert verdicts(checks) == {"pass": 9}
    assert checks[1].figures["rows"] == 15


def edited(row: int, column: int) -> Callable[[Any], None]:
    """Return what changes the last bit of a number."""

    def edit(array: Any) -> None:
        array[row, column] = np.nextafter(array[row, column], np.inf)

    return edit


def raised(index: int) -> Callable[[Any], None]:
    """Return what adds to a number."""

    def edit(array: Any) -> None:
        array[index] += 0.125

    return edit


@pytest.mark.parametrize(
    ("forgery", "found"),
    [
        pytest.param(
            {"states": edited(6, 1)},
            ["steps", "states"],
            id="one bit of a position",
        ),
        pytest.param({"states": edited(6, 0)}, ["steps", "states"], id="of a time"),
        pytest.param({"actions": raised(4)}, ["states", "observations"], id="action"),
        pytest.param({"rewards": raised(4)}, ["rewards"], id="reward"),
        pytest.param(
            {"observations": edited(4, 2)}, ["observations"], id="observation"
        ),
        pytest.param({"facts": {"seed": 6}}, ["start", "states"], id="seed"),
    ],
)
def test_an_edited_number_is_found(
    forgery: dict[str, Any], found: list[str], forged: Path
) -> None:
    """An edit that fits in all files is found, and only in the episode it is in."""
    forge(episode(forged), **forgery)
    checks = physics_of(forged)
    # Without videos, only a sample of what could be drawn is looked at.
    claims = [claim for claim in failed(checks) if claim != "pictures"]
    assert claims[: len(found)] == found
    assert {c.subject for c in checks if c.verdict is Verdict.FAIL} == {
        checks[0].subject
    }


def test_a_first_difference_is_named(forged: Path) -> None:
    """The reason of a failure names the step, the component and both values."""
    forge(episode(forged), rewards=raised(4))
    [check] = [c for c in physics_of(forged) if c.verdict is Verdict.FAIL]
    assert check.reason.startswith(
        "after step 5 the reward is recorded as 1.125, and is 1.0 when made again"
    )
    assert check.figures["differing"] == 1


def test_a_state_that_was_cut_out_is_found(tmp_path: Path) -> None:
    """A step that takes twice as long as the others is none, though nobody pushes."""
    env = gymnasium.make("InvertedPendulum-v5")
    forged = record_gymnasium(tmp_path / "run", env, episodes=1, steps=12, size=0)
    with first_episode(forged) as reader:
        content = content_of(reader)
    names = ("states", "actions", "rewards", "terminated", "truncated", "observations")
    arrays = {name: np.delete(getattr(content, name), 5, axis=0) for name in names}
    taken = content.frame_steps < len(arrays["states"])
    pictures = {n: getattr(content, n)[taken] for n in ("frame_steps", "snapshots")}
    forge(episode(forged), **arrays, **pictures)
    assert {"steps", "states"} <= set(failed(physics_of(forged)))


def test_a_termination_that_did_not_happen_is_found(
    hopper: Path, tmp_path: Path
) -> None:
    """A flipped flag at an episode's end is found."""
    forged = copied(hopper, tmp_path / "run")

    def flip(flags: Any) -> None:
        flags[-1] = not flags[-1]

    forge(episode(forged), terminated=flip, truncated=flip)
    assert failed(physics_of(forged)) == ["ends"]


def test_steps_after_the_end_are_found(forged: Path) -> None:
    """An episode that goes on where the environment ended it is found."""
    said = {**fact(episode(forged), "environment"), "max_episode_steps": 5}
    forge(episode(forged), facts={"environment": said})
    [check] = [c for c in physics_of(forged) if c.verdict is Verdict.FAIL]
    assert "after step 5 truncated is recorded as False, and is True" in check.reason


def test_a_swapped_model_is_found(forged: Path) -> None:
    """Another model of the same id is found though its hash and its name fit."""
    swap_model(forged, 0, 'gravity="0 0 -9.81"', 'gravity="0 0 -9.80"')
    checks = physics_of(forged)
    assert failed(checks) == ["model"]
    assert "opt.gravity" in checks[0].reason


def test_a_model_in_other_colours_is_found(forged: Path) -> None:
    """What only pictures depend on is compared too."""
    swap_model(forged, 0, 'rgba="0.3 0.3 0.7 1"', 'rgba="0.9 0.3 0.7 1"')
    checks = physics_of(forged)
    assert failed(checks) == ["model"]
    assert "rgba" in checks[0].reason


def test_a_run_in_a_doctored_environment_is_found(tmp_path: Path) -> None:
    """States that follow in a model with less gravity do not in the environment's."""
    source = Path(gymnasium.envs.mujoco.__path__[0]) / "assets/inverted_pendulum.xml"
    doctored = tmp_path / "light.xml"
    doctored.write_text(source.read_text().replace("-9.81", "-9.80"))
    env = gymnasium.make("InvertedPendulum-v5", xml_file=str(doctored))
    forged = record_gymnasium(tmp_path / "run", env, episodes=1)
    said = {**fact(episode(forged), "environment"), "kwargs": {}}
    forge(episode(forged), facts={"environment": said})
    assert {"model", "steps", "states"} <= set(failed(physics_of(forged)))


def test_a_change_of_the_model_that_did_not_happen_is_found(forged: Path) -> None:
    """The environment's model is looked at where the recording says it changed."""
    gravity = {"opt.gravity": np.array([0.0, 0.0, -9.0])}
    forge(episode(forged), model_changes=(ModelChange(step=4, fields=gravity),))
    checks = physics_of(forged)
    assert failed(checks) == ["model"]
    assert "opt.gravity" in checks[0].reason


@needs_dm_control
def test_another_random_state_is_found(tmp_path: Path) -> None:
    """An episode does not pass for one that began elsewhere."""
    directory = record_suite(tmp_path / "run", "cartpole", "swingup")
    other = fact(episode(directory, 1), "random_state")
    forge(episode(directory, 0), facts={"random_state": other})
    assert failed(physics_of(directory))[0] == "start"


def test_another_machine_is_compared_within_a_tolerance(pendulum: Path) -> None:
    """Numbers that are the same bit for bit pass wherever they were recorded."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mjrec.evidence.verifying.tolerances.machine_fingerprint", dict)
        assert verdicts(physics_of(pendulum)) == {"pass": 17}


@pytest.mark.parametrize(("error", "found"), [(1e-12, []), (1e-7, ["steps", "states"])])
def test_a_tolerance_is_kept_step_by_step(
    error: float, found: list[str], forged: Path
) -> None:
    """On another machine small errors pass, do not add up, and are in the figures."""

    def drift(states: Any) -> None:
        states[3:, 1] += error

    machine = {"machine": OTHER_MACHINE}
    forge(episode(forged), states=drift, facts=machine)
    checks = physics_of(forged)
    assert failed(checks)[: len(found)] == found
    if not found:
        steps = checks[1]
        assert failed(checks) == []
        assert steps.figures["median"] == 0
        assert 0 < steps.figures["p99"] <= steps.figures["maximum"] < 1e-9
        assert "within 1e-09" in steps.reason
        assert "another machine" in steps.reason


@pytest.mark.thorough
@pytest.mark.parametrize("env_id", ["Ant-v5", "HalfCheetah-v5"])
def test_steps_begin_at_recorded_states_on_another_machine(
    env_id: str, tmp_path: Path
) -> None:
    """Rewards that depend on where bodies were before are the same after a drift."""
    env = gymnasium.make(env_id)
    directory = record_gymnasium(tmp_path / "run", env, episodes=1, steps=10)

    def nudge(states: Any) -> None:
        states[2, 1] += 1e-13

    forge(episode(directory), states=nudge, facts={"machine": OTHER_MACHINE})
    checks = physics_of(directory)
    assert verdicts(checks) == {"pass": 9}
    assert any("begins at the recorded state" in check.reason for check in checks)


@pytest.mark.thorough
@needs_dm_control
def test_the_suite_goes_on_from_recorded_states(tmp_path: Path) -> None:
    """What dm_control computes before a step is there when it is put into a state."""
    directory = record_suite(tmp_path / "run", "finger", "turn_hard", episodes=1)

    def nudge(states: Any) -> None:
        states[2, 1] += 1e-13

    forge(episode(directory), states=nudge, facts={"machine": OTHER_MACHINE})
    assert failed(physics_of(directory)) == []


@parametrize(
    ("error", "verdict"),
    [
        (1e-12, Verdict.PASS),
        (1e-5, Verdict.NOT_CHECKABLE),
        (0.5, Verdict.FAIL),
    ],
)
def test_another_mujoco_is_named(error: float, verdict: Verdict, forged: Path) -> None:
    """Another major version may compute otherwise, but not anything."""
    versions = {**fact(episode(forged), "versions"), "mujoco": "2.9"}

    def nudge(states: Any) -> None:
        states[3:, 1] += error

    forge(episode(forged), states=nudge, facts={"versions": versions})
    steps = physics_of(forged)[1]
    assert steps.verdict is verdict
    assert "recorded with mujoco 2.9" in steps.reason


@pytest.mark.thorough
def test_contacts_that_may_jump_are_no_accusation(tmp_path: Path) -> None:
    """On another machine a box may touch at another corner."""
    boxes = BALL.replace('size=".1"/>', 'type="box" size=".1 .1 .1"/>', 1)
    directory = record_mjcf(tmp_path / "run", tmp_path / "box.xml", boxes)

    def nudge(states: Any) -> None:
        states[3:, 1] += 1e-5

    forge(episode(directory), states=nudge, facts={"machine": OTHER_MACHINE})
    steps = physics_of(directory)[1]
    assert steps.verdict is Verdict.NOT_CHECKABLE
    assert "contacts of boxes" in steps.reason


def test_another_gymnasium_is_a_doubt(forged: Path) -> None:
    """Where the environment may be another one, a difference accuses nobody."""
    versions = {**fact(episode(forged), "versions"), "gymnasium": "0.0"}
    forge(episode(forged), rewards=raised(4), facts={"versions": versions})
    checks = physics_of(forged)
    assert failed(checks) == []
    assert any("pip install gymnasium==0.0" in check.reason for check in checks)


def test_states_that_are_missing_are_said(forged: Path) -> None:
    """A gap in the states is no pass."""

    def lose(states: Any) -> None:
        states[5] = np.nan

    forge(episode(forged), states=lose)
    checks = physics_of(forged)
    steps = next(c for c in checks if c.claim.startswith("each recorded state"))
    assert steps.verdict is Verdict.NOT_CHECKABLE
    assert "that after step 5" in steps.reason


def test_without_sources_and_environment_nothing_is_proved(forged: Path) -> None:
    """A compiled model alone is not loaded, also not that of this user."""
    for path in forged.glob("*.zip"):
        path.unlink()
    said = {"framework": "gymnasium", "id": "Nobody-v0", "kwargs": {}, "wrappers": []}
    forge(episode(forged), facts={"environment": said})
    checks = [c for c in physics_of(forged) if "episode 0" in c.subject]
    assert verdicts(checks) == {"not checkable": 4}


@pytest.mark.thorough
def test_a_forged_state_fails_without_its_environment(forged: Path) -> None:
    """That an environment cannot be made again is no excuse."""
    said = {"framework": "gymnasium", "id": "Nobody-v0", "kwargs": {}, "wrappers": []}
    facts = {"environment": said, "env_id": "Nobody-v0"}
    forge(episode(forged), states=edited(6, 1), facts=facts)
    checks = physics_of(forged)
    assert [c for c in failed(checks) if c != "pictures"] == ["steps"]


def test_an_unfinished_log_is_not_checkable(tmp_path: Path) -> None:
    """What a killed process has left is said, and its rows are not read."""
    write_log(tmp_path, 3, ended=False)
    next(tmp_path.glob("*.log")).write_bytes(b"anything")
    [check] = physics_of(tmp_path)
    assert check.verdict is Verdict.NOT_CHECKABLE
    assert check.subject == "episode 3 of 0.7"


def test_a_damaged_file_is_a_failure_of_its_own(forged: Path) -> None:
    """The other episodes are still looked at."""
    path = episode(forged)
    path.write_bytes(path.read_bytes()[:900])
    checks = physics_of(forged)
    assert failed(checks) == ["file"]
    assert verdicts(checks)["pass"] == 9


def first_episode(directory: Path) -> TrajectoryReader:
    """Open the first episode."""
    return open_trajectory(episode(directory))
