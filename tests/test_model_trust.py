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
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from rides import Ride, record
from sound_files import stored

import mjrec
from mjrec import UnreadableFile, UntrustedModel, load_trajectory
from mjrec.commands import main
from mjrec.formats.spans import recordings_in_flight
from mjrec.simulation.model_store import load_model
from mjrec.simulation.model_trust import (
    TRUST_VARIABLE,
    environ_with_key,
    is_sealed,
    is_trusted,
    seal_of,
    trusting_models,
)
from mjrec.surroundings import Surroundings

DIGEST = hashlib.sha256(b"a model").hexdigest()
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


def key_in(state_home: Path) -> Path:
    return state_home / "mjrec/model-key"


def fallback_in(tmp_path: Path) -> Path:
    return tmp_path / f"tmp/mjrec-{os.geteuid()}/model-key"


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


# --- the key -------------------------------------------------------------------------


def test_the_key_is_the_users_alone(state_home: Path) -> None:
    """It is made at the first seal, and is the same at the next."""
    first = seal_of(DIGEST)
    key = key_in(state_home)
    assert (mode_of(key), mode_of(key.parent)) == (0o600, 0o700)
    assert [path.name for path in key.parent.iterdir()] == ["model-key"]
    assert key.stat().st_size == 32
    assert seal_of(DIGEST) == first
    assert is_sealed(first, DIGEST)


def test_every_user_has_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A seal says who, and of what."""
    seal = seal_of(DIGEST)
    assert not is_sealed(seal, DIGEST[::-1])
    become_another_user(monkeypatch, tmp_path)
    assert seal_of(DIGEST) != seal
    assert not is_sealed(seal, DIGEST)


def test_looking_makes_no_key(state_home: Path) -> None:
    """Nor does importing; whoever reads recordings leaves nothing behind."""
    assert not is_sealed(DIGEST, DIGEST)
    assert not state_home.exists()


@pytest.mark.parametrize("seal", [None, 7, "", "x", "\udc80", "é", [], "0" * 64])
def test_anything_else_is_no_seal(seal: object) -> None:
    """Whatever a file says."""
    seal_of(DIGEST)
    assert not is_sealed(seal, DIGEST)
    assert not is_sealed(seal_of(DIGEST), seal)


def test_many_at_once_make_one_key(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of them has found that there is none, and has one to give."""
    count = 8
    together = threading.Barrier(count)
    link = os.link

    def at_once(*arguments: Any) -> None:
        together.wait(30)
        link(*arguments)

    monkeypatch.setattr(os, "link", at_once)
    with ThreadPoolExecutor(count) as pool:
        seals = set(pool.map(seal_of, [DIGEST] * count))
    assert len(seals) == 1
    assert is_sealed(seals.pop(), DIGEST)


def test_other_processes_of_the_user_have_the_same() -> None:
    """Which is how a model gets from a simulation to its workers."""
    program = (
        "import sys; from mjrec.simulation.model_trust import seal_of;"
        f"sys.stdout.write(seal_of({DIGEST!r})); assert 'mujoco' not in sys.modules"
    )
    command = [sys.executable, "-c", program]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(2)]
    said = {process.communicate()[0].decode() for process in processes}
    assert said == {seal_of(DIGEST)}


def test_workers_elsewhere_seal_as_the_user_who_sent_them(
    state_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their machine's home is another one; its own seals are good there, too."""
    here = seal_of(DIGEST)
    given = environ_with_key()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "node"))
    own = seal_of(DIGEST)
    assert own != here
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    assert seal_of(DIGEST) == here
    assert is_sealed(here, DIGEST)
    assert is_sealed(own, DIGEST)
    assert environ_with_key() == given
    # Which would be in every recording.
    around = Surroundings(tmp_path).found(wait=True)
    assert around is not None
    assert "XDG_STATE_HOME" not in around["variables"]
    assert not around["variables"].keys() & given.keys()


@pytest.mark.parametrize("said", ["", "no hex", "00"])
def test_what_is_no_key_is_not_used(said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The user's own is."""
    own = seal_of(DIGEST)
    [name] = environ_with_key()
    monkeypatch.setenv(name, said)
    assert seal_of(DIGEST) == own


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
        assert is_sealed(seal_of(DIGEST), DIGEST)
    assert not (tmp_path / "home").exists()
    (tmp_path / "home").mkdir()
    seal_of(DIGEST)
    assert key_in(tmp_path / "home/.local/state").exists()


# --- where there can be no key -------------------------------------------------------


def test_without_a_home_it_is_a_temporary_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Nothing is said; and its seals are good also when there is a home later."""
    monkeypatch.setenv("XDG_STATE_HOME", "/dev/null/state")
    seal = seal_of(DIGEST)
    key = fallback_in(tmp_path)
    assert (mode_of(key), mode_of(key.parent)) == (0o600, 0o700)
    assert seal == seal_of(DIGEST)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "now"))
    assert seal_of(DIGEST) != seal
    assert is_sealed(seal, DIGEST)
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
    """There is no seal then, one warning that says why, and the recording goes on."""
    place = fallback_in(tmp_path).parent
    prepare(place, tmp_path / "theirs")
    monkeypatch.setenv("XDG_STATE_HOME", "/dev/null/state")
    assert seal_of(DIGEST) is None
    assert seal_of(DIGEST) is None
    assert not list(place.iterdir())
    [warned] = caplog.messages
    assert str(place) in warned
    assert "MJREC_TRUST_MODELS=1" in warned


def readable(key: Path) -> None:
    key.chmod(0o640)


def in_an_open_directory(key: Path) -> None:
    key.parent.chmod(0o750)


def cut_off(key: Path) -> None:
    os.truncate(key, 31)


def a_pipe(key: Path) -> None:
    key.unlink()
    os.mkfifo(key, 0o600)


def somebody_elses(key: Path) -> None:
    os.chown(key, 65534, -1)


@pytest.mark.parametrize(
    "spoil",
    [
        *(readable, in_an_open_directory, cut_off, a_pipe),
        pytest.param(somebody_elses, marks=BY_ROOT),
    ],
)
def test_a_key_that_others_may_know_is_not_used(
    state_home: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    spoil: Any,
) -> None:
    """It stays for its owner to decide; one warning says what to do."""
    before = seal_of(DIGEST)
    key = key_in(state_home)
    spoil(key)
    left = key.lstat()
    assert not is_sealed(before, DIGEST)
    meanwhile = seal_of(DIGEST)
    assert is_sealed(meanwhile, DIGEST)
    assert key.lstat().st_ino == left.st_ino
    assert fallback_in(tmp_path).exists()
    [warned] = caplog.messages
    assert str(key.parent) in warned
    assert "remove it" in warned


def test_a_key_is_no_link(state_home: Path, tmp_path: Path) -> None:
    """It could lead to a file whose content somebody knows."""
    known = tmp_path / "known"
    known.write_bytes(bytes(32))
    known.chmod(0o600)
    key_in(state_home).parent.mkdir(mode=0o700, parents=True)
    key_in(state_home).symlink_to(known)
    seal_of(DIGEST)
    assert fallback_in(tmp_path).exists()


@BY_ROOT
def test_root_leaves_nothing_in_the_homes_of_others(
    state_home: Path, tmp_path: Path
) -> None:
    """With `sudo` and the user's HOME, the user could not write there any more."""
    state_home.mkdir(parents=True)
    os.chown(state_home, 65534, -1)
    assert is_sealed(seal_of(DIGEST), DIGEST)
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


@pytest.mark.parametrize("seal", ["missing", "null", "of another", "nonsense"])
def test_mujoco_never_sees_what_nobody_vouches_for(
    directory: Path, monkeypatch: pytest.MonkeyPatch, seal: str
) -> None:
    """The error names the file and the ways out."""
    facts = {**stored(directory), "xml": None}
    forbid_compiled_models(monkeypatch, directory)
    crafted = tampered(directory, facts)
    others = {"null": None, "of another": facts["seal"], "nonsense": {"a": 1}}
    if seal == "missing":
        del crafted["seal"]
    else:
        crafted["seal"] = others[seal]
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
    with pytest.raises(UntrustedModel, match="it is no zip file") as error:
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


def test_a_model_without_a_seal_is_stored_all_the_same(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where there can be no key at all."""
    monkeypatch.setenv("XDG_STATE_HOME", "/dev/null/state")
    open_to_others(fallback_in(tmp_path).parent, tmp_path)
    facts = stored(directory)
    assert facts["seal"] is None
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
