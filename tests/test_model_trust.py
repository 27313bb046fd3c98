# SPDX-License-Identifier: Apache-2.0
"""A compiled model is loaded if this user has stored it, or says so."""

from __future__ import annotations

import gzip
import hashlib
import os
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from full_disk import file_size_limit
from rides import Ride, record
from sound_files import stored

import mjrec
from mjrec import UnreadableFile, UntrustedModel, load_trajectory
from mjrec.commands import main
from mjrec.formats.spans import recordings_in_flight
from mjrec.rendering.engine_jobs import VideoWorker
from mjrec.simulation.model_store import load_model
from mjrec.simulation.model_trust import (
    TRUST_VARIABLE,
    directory_digest,
    is_stored,
    is_trusted,
    note_models,
    noting_models,
    stored_models,
    trusting_models,
)

DIGEST = hashlib.sha256(b"a model").hexdigest()
OTHER = hashlib.sha256(b"another model").hexdigest()
BY_ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")


@pytest.fixture(autouse=True)
def state_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user with a home, and a temporary directory that nobody else uses."""
    temporary = tmp_path / "tmp"
    temporary.mkdir(mode=0o1777)
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.delenv("MJREC_TRUST_MODELS", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home/state"))
    return tmp_path / "home/state"


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    path = tmp_path / "recordings"
    path.mkdir()
    return path


def become_another_user(patch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    patch.setenv("XDG_STATE_HOME", str(tmp_path / "elsewhere"))


def list_in(state_home: Path) -> Path:
    return state_home / "mjrec/models"


def fallback_in(tmp_path: Path) -> Path:
    return tmp_path / f"tmp/mjrec-{os.geteuid()}/models"


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


def digest_of(content: object) -> str:
    return hashlib.sha256(str(content).encode()).hexdigest()


# --- the list ------------------------------------------------------------------------


def test_the_list_is_the_users_alone(state_home: Path) -> None:
    """It is made with the first model, and names each once, in order."""
    note_models([DIGEST])
    note_models([OTHER, DIGEST])
    path = list_in(state_home)
    assert (mode_of(path), mode_of(path.parent)) == (0o600, 0o700)
    assert path.read_text() == f"{DIGEST}\n{OTHER}\n"
    assert is_stored(DIGEST)
    assert is_stored(OTHER)


def test_every_user_has_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What one has stored is a stranger's for the others."""
    note_models([DIGEST])
    become_another_user(monkeypatch, tmp_path)
    assert not is_stored(DIGEST)


def test_looking_makes_no_list(state_home: Path) -> None:
    """Nor does importing; whoever reads recordings leaves nothing behind."""
    assert not is_stored(DIGEST)
    note_models([])
    assert not state_home.exists()


@pytest.mark.parametrize("said", [None, 7, "", "x", "\udc80", [], DIGEST[:16], "\n"])
def test_nothing_else_is_stored(said: object) -> None:
    """Whatever a file says."""
    note_models([DIGEST])
    assert not is_stored(said)
    assert not is_stored(f"{DIGEST}\n")


def test_many_processes_lose_nothing(state_home: Path) -> None:
    """Of each other's lines, and none is torn."""
    program = (
        "import sys; from hashlib import sha256;"
        "from mjrec.simulation.model_trust import note_models;"
        "[note_models([sha256(f'{sys.argv[1]} {n}'.encode()).hexdigest()])"
        " for n in range(100)];"
        "assert 'mujoco' not in sys.modules"
    )
    names = "abcd"
    processes = [
        subprocess.Popen([sys.executable, "-c", program, name]) for name in names
    ]
    assert [process.wait() for process in processes] == [0] * 4
    expected = {digest_of(f"{name} {n}") for name in names for n in range(100)}
    lines = list_in(state_home).read_text().splitlines()
    assert (len(lines), set(lines)) == (400, expected)
    assert all(map(is_stored, expected))


def test_the_list_does_not_grow_for_ever(state_home: Path) -> None:
    """A task may compile a model for each episode; then the oldest are forgotten."""
    path = list_in(state_home)
    note_models([DIGEST])
    note_models(many := list(map(digest_of, range(131_071))))
    assert path.stat().st_size == 131_072 * 65
    assert is_stored(DIGEST)
    note_models([OTHER])
    kept = path.read_text().splitlines()
    assert (len(kept), kept[-1], set(kept) <= {OTHER, *many}) == (65_536, OTHER, True)
    assert mode_of(path) == 0o600
    assert is_stored(OTHER)
    assert not is_stored(DIGEST)
    note_models([DIGEST])
    assert path.stat().st_size == 65_537 * 65


def test_a_line_that_was_cut_off_spoils_no_other(state_home: Path) -> None:
    """A full disk takes a part of it."""
    note_models([DIGEST])
    path = list_in(state_home)
    with path.open("a") as file:
        file.write(OTHER[:30])
    note_models([third := digest_of(3)])
    assert path.read_text().splitlines() == [DIGEST, OTHER[:30], third]
    assert is_stored(third)
    assert not is_stored(OTHER)


def test_where_the_home_is_full_the_other_place_has_a_list(
    tmp_path: Path, state_home: Path
) -> None:
    """And the recording goes on."""
    note_models([DIGEST])
    with file_size_limit(70):
        note_models([OTHER])
    assert list_in(state_home).stat().st_size == 70
    assert fallback_in(tmp_path).read_text() == f"{OTHER}\n"
    assert is_stored(OTHER)


def test_without_variables_the_home_is_that_of_the_password_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a cron job; and a home that is only a name is not made."""
    user = type("User", (), {"pw_dir": str(tmp_path / "home")})
    monkeypatch.setattr("pwd.getpwuid", lambda uid: user)
    monkeypatch.setenv("XDG_STATE_HOME", "relative/is/ignored")
    for home in (None, "", "relative"):
        if home is None:
            monkeypatch.delenv("HOME")
        else:
            monkeypatch.setenv("HOME", home)
        note_models([digest_of(home)])
        assert is_stored(digest_of(home))
    assert not (tmp_path / "home").exists()
    (tmp_path / "home").mkdir()
    note_models([DIGEST])
    assert list_in(tmp_path / "home/.local/state").exists()


# --- other machines ------------------------------------------------------------------


def test_a_worker_elsewhere_loads_what_its_user_has_stored(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the models in the directory; its own home knows none of them."""
    facts = {**stored(directory), "xml": None}
    note_models([DIGEST])
    sent = stored_models([directory, tmp_path / "not there"])
    assert sent == [facts["sha256"]]
    become_another_user(monkeypatch, tmp_path)
    with pytest.raises(UntrustedModel):
        load_model(directory, facts)
    assert stored_models([directory]) == []
    VideoWorker({"models": sent}).close()
    assert load_model(directory, facts).ngeom == 1
    assert not is_stored(DIGEST)


def test_what_is_stored_in_a_block_is_reported(directory: Path) -> None:
    """Each block by itself, also what was on the list before."""
    note_models([OTHER])
    with noting_models() as first:
        facts = stored(directory)
    with noting_models() as second:
        stored(directory)
        note_models([OTHER])
    note_models([DIGEST])
    noted = [facts["sha256"], directory_digest(directory)]
    assert first == noted
    assert second == [*noted, OTHER]


# --- where there can be no list ------------------------------------------------------


def test_without_a_home_it_is_a_temporary_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Nothing is said; and it is still good when there is a home later."""
    monkeypatch.setenv("XDG_STATE_HOME", "/dev/null/state")
    note_models([DIGEST])
    path = fallback_in(tmp_path)
    assert (mode_of(path), mode_of(path.parent)) == (0o600, 0o700)
    assert is_stored(DIGEST)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "now"))
    note_models([OTHER])
    assert is_stored(DIGEST)
    assert is_stored(OTHER)
    assert not caplog.records


def open_to_others(place: Path, _: Path) -> None:
    place.mkdir(mode=0o755)
    place.chmod(0o755)


def linked(place: Path, elsewhere: Path) -> None:
    elsewhere.mkdir(mode=0o700)
    place.symlink_to(elsewhere)


def given_away(place: Path, _: Path) -> None:
    place.mkdir(mode=0o700)
    os.chown(place, 65534, -1)


@pytest.mark.parametrize(
    "prepare", [open_to_others, linked, pytest.param(given_away, marks=BY_ROOT)]
)
def test_a_temporary_directory_that_others_prepared_is_not_used(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    prepare: Any,
) -> None:
    """There is no list then, one warning that says why, and the recording goes on."""
    place = fallback_in(tmp_path).parent
    prepare(place, tmp_path / "theirs")
    monkeypatch.setenv("XDG_STATE_HOME", "/dev/null/state")
    note_models([DIGEST])
    note_models([OTHER])
    assert not is_stored(DIGEST)
    assert not list(place.iterdir())
    [warned] = caplog.messages
    assert str(place) in warned
    assert "MJREC_TRUST_MODELS=1" in warned


def readable(path: Path) -> None:
    path.chmod(0o640)


def in_an_open_directory(path: Path) -> None:
    path.parent.chmod(0o750)


def a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path, 0o600)


def a_link(path: Path) -> None:
    path.symlink_to(path.rename(path.parent.parent / "elsewhere"))


def somebody_elses(path: Path) -> None:
    os.chown(path, 65534, -1)


@pytest.mark.parametrize(
    "spoil",
    [
        *(readable, in_an_open_directory, a_pipe, a_link),
        pytest.param(somebody_elses, marks=BY_ROOT),
    ],
)
def test_a_list_that_others_may_have_written_is_not_used(
    state_home: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    spoil: Any,
) -> None:
    """It stays for its owner to decide; one warning says what to do."""
    note_models([DIGEST])
    path = list_in(state_home)
    spoil(path)
    left = path.lstat()
    assert not is_stored(DIGEST)
    note_models([OTHER])
    assert is_stored(OTHER)
    assert path.lstat().st_ino == left.st_ino
    assert fallback_in(tmp_path).exists()
    [warned] = caplog.messages
    assert str(path.parent) in warned
    assert "remove it" in warned


@BY_ROOT
def test_root_leaves_nothing_in_the_homes_of_others(
    state_home: Path, tmp_path: Path
) -> None:
    """With `sudo` and the user's HOME, the user could not write there any more."""
    state_home.mkdir(parents=True)
    os.chown(state_home, 65534, -1)
    note_models([DIGEST])
    assert is_stored(DIGEST)
    assert not list(state_home.iterdir())
    assert fallback_in(tmp_path).exists()


# --- models --------------------------------------------------------------------------


def forbid_compiled_models(patch: pytest.MonkeyPatch, directory: Path) -> None:
    """Fail where MuJoCo is given a compiled model of the directory, or its bytes."""
    load = mujoco.MjModel.from_binary_path

    def loaded(path: str, *assets: Any) -> Any:
        # The process that compiles sources gives its model in a file elsewhere.
        assert not assets
        assert not Path(path).is_relative_to(directory)
        return load(path)

    patch.setattr(mujoco.MjModel, "from_binary_path", loaded)


def tampered(directory: Path, facts: dict[str, Any]) -> dict[str, Any]:
    """Return what somebody says of a crafted model, all of it true."""
    content = bytearray(gzip.decompress((directory / facts["mjb"]).read_bytes()))
    content[-200:] = bytes(200)
    digest = hashlib.sha256(content).hexdigest()
    path = directory / f"openaigym.model.{digest[:16]}.mjb.gz"
    path.write_bytes(gzip.compress(bytes(content)))
    return {**facts, "mjb": path.name, "sha256": digest}


@pytest.mark.parametrize("said", [{}, {"sha256": None}, {"sha256": {"a": 1}}])
def test_mujoco_never_sees_what_nobody_vouches_for(
    directory: Path, monkeypatch: pytest.MonkeyPatch, said: dict[str, Any]
) -> None:
    """The error names the file and the ways out."""
    facts = {**stored(directory), "xml": None}
    forbid_compiled_models(monkeypatch, directory)
    crafted = {**tampered(directory, facts), **said}
    with pytest.raises(UntrustedModel, match="not written by this user") as error:
        load_model(directory, crafted)
    assert error.value.path == directory / crafted["mjb"]
    for way_out in ("--trust-models", "trust_models=True", "MJREC_TRUST_MODELS=1"):
        assert way_out in str(error.value)


def test_a_strangers_sources_are_compiled(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a process with limits; where that fails, the ways out are told too."""
    facts = stored(directory)
    become_another_user(monkeypatch, tmp_path)
    forbid_compiled_models(monkeypatch, directory)
    assert load_model(directory, facts).ngeom == 1
    (directory / facts["xml"]).write_bytes(b"no zip")
    with pytest.raises(UntrustedModel, match="not a zip file") as error:
        load_model(directory, facts)
    assert "--trust-models" in str(error.value)
    assert "move this one away" not in str(error.value)


def test_ones_own_model_is_loaded_as_it_was_compiled(directory: Path) -> None:
    """Sources or not."""
    facts = stored(directory)
    (directory / facts["xml"]).write_bytes(b"no zip")
    assert load_model(directory, facts).ngeom == 1


@pytest.mark.parametrize(
    ("said", "is_loaded"), [("1", True), ("0", False), ("", False)]
)
def test_trust_by_environment_variable(
    directory: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    said: str,
    is_loaded: bool,
) -> None:
    """For whatever loads a model; the hash is looked at all the same."""
    facts = {**stored(directory), "xml": None}
    become_another_user(monkeypatch, tmp_path)
    monkeypatch.setenv("MJREC_TRUST_MODELS", said)
    if not is_loaded:
        with pytest.raises(UntrustedModel, match="not written by this user"):
            load_model(directory, facts)
        return
    assert load_model(directory, facts).ngeom == 1
    (directory / facts["mjb"]).write_bytes(gzip.compress(bytes(facts["bytes"])))
    with pytest.raises(UnreadableFile, match="not what was recorded"):
        load_model(directory, facts)


def test_a_crafted_model_does_not_pass_for_a_listed_one(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its facts may name the hash of another."""
    facts = {**stored(directory), "xml": None}
    forbid_compiled_models(monkeypatch, directory)
    crafted = {**tampered(directory, facts), "sha256": facts["sha256"]}
    with pytest.raises(UnreadableFile, match="not what was recorded"):
        load_model(directory, crafted)


def test_a_model_that_cannot_be_listed_is_stored_all_the_same(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its sources are compiled, or it is trusted."""
    monkeypatch.setenv("XDG_STATE_HOME", "/dev/null/state")
    open_to_others(fallback_in(tmp_path).parent, tmp_path)
    facts = stored(directory)
    assert load_model(directory, facts).ngeom == 1
    assert load_model(directory, {**facts, "xml": None}, trust_models=True).ngeom == 1


# --- recordings ----------------------------------------------------------------------


@pytest.fixture
def theirs(directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ride:
    """A stranger's recording, of which the compiled model is all there is."""
    ride = record(directory)
    become_another_user(monkeypatch, tmp_path)
    return ride


def test_pictures_of_a_strangers_recording_need_a_word(theirs: Ride) -> None:
    """Of the trajectory, which goes to the workers too."""
    trajectory = load_trajectory(theirs.path)
    with pytest.raises(UntrustedModel, match="not written by this user"):
        trajectory.model()
    with pytest.raises(UntrustedModel, match="not written by this user"):
        next(mjrec.render(trajectory))
    trusted = load_trajectory(theirs.path, trust_models=True)
    assert trusted.model().ngeom == 3
    frames = list(mjrec.render(trusted))
    np.testing.assert_array_equal(frames, theirs.frames)


@pytest.mark.thorough
def test_the_command_takes_the_word(
    theirs: Ride, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without it, the reason says which; afterwards all is as before."""
    again = ["render", str(theirs.path), "--out", str(tmp_path / "again.mp4")]
    assert main(again) == 1
    assert "mjrec render --trust-models" in capsys.readouterr().out
    assert main([*again, "--trust-models"]) == 0
    assert (tmp_path / "again.mp4").exists()
    assert "MJREC_TRUST_MODELS" not in os.environ


def recorded(env: Any, directory: Path) -> list[Any]:
    """Record two steps, and return what the environment shows of them."""
    with mjrec.Monitor(env, directory, lambda _: True, workers=0) as monitor:
        monitor.reset(seed=0)
        shown = [monitor.render()]
        for _ in range(2):
            monitor.step(np.full(env.action_space.shape, 0.5))
            shown.append(monitor.render())
        monitor.close(wait=False)
    return shown


def test_sources_show_what_the_environment_showed(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With what was set by hand in the model, before the recording and in it."""
    env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array", width=64, height=48)
    model = env.unwrapped.model  # type: ignore[attr-defined]  # it has one
    model.vis.quality.shadowsize = 256
    model.geom_rgba[2] = (0, 1, 0, 1)
    model.geom_size[3, 0] *= 2
    shown = recorded(env, directory)
    become_another_user(monkeypatch, tmp_path)
    forbid_compiled_models(monkeypatch, directory)
    [path] = (recording.path for recording in recordings_in_flight(directory))
    np.testing.assert_array_equal(list(mjrec.render(path)), shown)
    again = load_trajectory(path).model()
    np.testing.assert_array_equal(again.geom_rgba, model.geom_rgba)
    np.testing.assert_array_equal(again.geom_size, model.geom_size)


@pytest.mark.thorough
@pytest.mark.dm_control
def test_composers_sources_show_what_the_task_showed(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are what composer has put together for the episode."""
    manipulation = pytest.importorskip("dm_control.manipulation")
    env = manipulation.load("reach_site_features", seed=2)
    size = {"height": 48, "width": 64}
    monitor = mjrec.Monitor(
        env, directory, lambda _: True, workers=0, env_id="dm_control/reach", **size
    )
    monitor.reset()
    shown = [env.physics.render(**size)]
    monitor.step(np.full(env.action_spec().shape, 0.1))
    shown.append(env.physics.render(**size))
    monitor.close(wait=False)
    become_another_user(monkeypatch, tmp_path)
    [path] = (recording.path for recording in recordings_in_flight(directory))
    np.testing.assert_array_equal(list(mjrec.render(path)), shown)


def test_models_are_trusted_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """By their hashes, in the block only; what was said before does not count there."""
    monkeypatch.setenv(TRUST_VARIABLE, "1")
    one, other = "a" * 64, "b" * 64
    with trusting_models([one]):
        assert is_trusted(one)
        assert not is_trusted(other)
        assert not is_trusted(None)
    assert is_trusted(other)
    with trusting_models([]):
        assert not is_trusted(one)
