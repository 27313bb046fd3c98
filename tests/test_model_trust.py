# SPDX-License-Identifier: Apache-2.0
"""Compiled models load only if this user stored them or trusts them."""

import gzip
import hashlib
import os
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from full_disk import file_size_limit
from rides import record
from sound_files import store_model

import mjrec
from mjrec import UnreadableFile, UntrustedModel, load_trajectory
from mjrec.commands import main
from mjrec.formats.spans import recordings_in_flight
from mjrec.rendering.finish import VideoWorker
from mjrec.simulation import model_trust
from mjrec.simulation.model_store import load_model
from mjrec.simulation.model_trust import (
    TRUST_VARIABLE,
    directory_digest,
    is_stored,
    note_models,
    noting_models,
    stored_models,
)

DIGEST = hashlib.sha256(b"a model").hexdigest()
OTHER = hashlib.sha256(b"another model").hexdigest()
BY_ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")


@pytest.fixture(autouse=True)
def trust_list(tmp_path, monkeypatch):
    """Give this test its own home and temporary directory; return the trust list."""
    temporary = tmp_path / "tmp"
    temporary.mkdir(mode=0o1777)
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.delenv(TRUST_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home/state"))
    return tmp_path / "home/state/mjrec/models"


@pytest.fixture
def fallback(tmp_path):
    """Return the path of the list that is used when the home is not writable."""
    return tmp_path / f"tmp/mjrec-{os.geteuid()}/models"


@pytest.fixture
def directory(tmp_path):
    path = tmp_path / "recordings"
    path.mkdir()
    return path


@pytest.fixture
def become_another_user(tmp_path, monkeypatch):
    elsewhere = str(tmp_path / "elsewhere")
    return lambda: monkeypatch.setenv("XDG_STATE_HOME", elsewhere)


def modes_of(path):
    """Return the permissions of a file and of its directory."""
    return [stat.S_IMODE(each.lstat().st_mode) for each in (path, path.parent)]


def digest_of(content):
    return hashlib.sha256(str(content).encode()).hexdigest()


def test_trust_list_is_private_to_its_user(trust_list, become_another_user):
    """The first model creates the list, which has each model once, in order."""
    assert not is_stored(DIGEST)
    note_models([])
    assert not trust_list.parent.exists()
    note_models([DIGEST])
    note_models([OTHER, DIGEST])
    assert modes_of(trust_list) == [0o600, 0o700]
    assert trust_list.read_text().split() == [DIGEST, OTHER]
    assert is_stored(DIGEST)
    for invalid in (None, 7, "", DIGEST[:16], f"{DIGEST}\n", "\n", "\udc80"):
        assert not is_stored(invalid)
    become_another_user()
    assert not is_stored(DIGEST)


def test_concurrent_writers_lose_no_line(trust_list):
    note_models([DIGEST])
    with trust_list.open("a") as file:
        file.write(OTHER[:30])
    program = (
        "import sys; from hashlib import sha256;"
        "from mjrec.simulation.model_trust import note_models;"
        "[note_models([sha256(f'{sys.argv[1]} {n}'.encode()).hexdigest()])"
        " for n in range(100)];"
        "assert 'mujoco' not in sys.modules"
    )
    command = [sys.executable, "-c", program]
    processes = [subprocess.Popen([*command, name]) for name in "abcd"]
    assert [process.wait() for process in processes] == [0] * 4
    expected = {digest_of(f"{name} {n}") for name in "abcd" for n in range(100)}
    lines = trust_list.read_text().split()
    assert set(lines) == {DIGEST, OTHER[:30], *expected}
    assert len(lines) == 402
    assert not is_stored(OTHER)


def test_trust_list_forgets_the_oldest_models(trust_list, monkeypatch):
    """The list must be limited because a task may compile a model per episode."""
    monkeypatch.setattr(model_trust, "_MOST_BYTES", 10 * 66)
    models = list(map(digest_of, range(35)))
    for model in models:
        note_models([model])
    files = [path.stat().st_size for path in trust_list.parent.iterdir()]
    assert sum(files) < 20 * 67
    assert all(map(is_stored, models[-10:]))
    assert not is_stored(models[0])


def test_unwritable_home_uses_the_fallback_list(
    tmp_path, fallback, monkeypatch, caplog
):
    """There is no warning, and models in the fallback list stay trusted."""
    note_models([DIGEST])
    with file_size_limit(70):
        note_models([OTHER])
    assert modes_of(fallback) == [0o600, 0o700]
    assert fallback.read_text().split() == [OTHER]
    with monkeypatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", "/dev/null/state")
        note_models([third := digest_of(3)])
    assert all(map(is_stored, [DIGEST, OTHER, third]))
    # A cron job has no variables, so the password file gives the home directory.
    user = type("User", (), {"pw_dir": str(tmp_path / "home")})
    monkeypatch.setattr("pwd.getpwuid", lambda uid: user)
    monkeypatch.setenv("XDG_STATE_HOME", "relative/is/ignored")
    monkeypatch.delenv("HOME")
    note_models([fourth := digest_of(4)])
    assert fourth in (tmp_path / "home/.local/state/mjrec/models").read_text()
    assert not caplog.records


@pytest.mark.parametrize(
    "tamper",
    [
        lambda path: path.unlink() or os.mkfifo(path, 0o600),
        lambda path: path.symlink_to(path.rename(path.parent.parent / "elsewhere")),
        lambda path: path.chmod(0o640),
        pytest.param(lambda path: os.chown(path, 65534, -1), marks=BY_ROOT),
    ],
    ids=["pipe", "link", "mode", "owner"],
)
def test_list_that_others_can_write_is_not_used(trust_list, fallback, caplog, tamper):
    """The file stays, and a warning says what to do."""
    note_models([DIGEST])
    tamper(trust_list)
    before = trust_list.lstat()
    assert not is_stored(DIGEST)
    note_models([OTHER])
    assert is_stored(OTHER)
    assert trust_list.lstat().st_ino == before.st_ino
    [warning] = caplog.messages
    assert str(trust_list.parent) in warning or "symbolic links" in warning
    assert "delete it" in warning
    # Without any list, models need explicit trust.
    tamper(fallback)
    note_models([digest_of(3)])
    assert not is_stored(digest_of(3))
    assert f"{TRUST_VARIABLE}=1" in caplog.messages[-1]


def test_remote_worker_loads_models_of_its_user(
    directory, tmp_path, become_another_user
):
    """The job names the stored models of its directory."""
    with noting_models() as noted:
        facts = {**store_model(directory), "xml": None}
    note_models([DIGEST])
    assert noted == [facts["sha256"], directory_digest(directory)]
    sent = stored_models([directory, tmp_path / "not there"])
    assert sent == [facts["sha256"]]
    become_another_user()
    with pytest.raises(UntrustedModel):
        load_model(directory, facts)
    assert stored_models([directory]) == []
    VideoWorker({"models": sent}).close()
    assert load_model(directory, facts).ngeom == 1
    assert not is_stored(DIGEST)


def forbid_compiled_models(patch, directory):
    """Fail if MuJoCo loads a compiled model from the directory."""
    load = mujoco.MjModel.from_binary_path

    def loaded(path, *assets):
        # Compiled sources come from a file elsewhere.
        assert not assets
        assert not Path(path).is_relative_to(directory)
        return load(path)

    patch.setattr(mujoco.MjModel, "from_binary_path", loaded)


@pytest.mark.parametrize("changes", [{}, {"sha256": None}, {"sha256": {"a": 1}}])
def test_untrusted_models_never_reach_mujoco(directory, monkeypatch, changes):
    """The error names the file and remedies; another model's hash does not help."""
    facts = {**store_model(directory), "xml": None}
    content = bytearray(gzip.decompress((directory / facts["mjb"]).read_bytes()))
    content[-200:] = bytes(200)
    digest = hashlib.sha256(content).hexdigest()
    path = directory / f"openaigym.model.{digest[:16]}.mjb.gz"
    path.write_bytes(gzip.compress(bytes(content)))
    crafted = {**facts, "mjb": path.name, "sha256": digest, **changes}
    forbid_compiled_models(monkeypatch, directory)
    with pytest.raises(UntrustedModel, match="not written by this user") as error:
        load_model(directory, crafted)
    assert error.value.path == path
    for way_out in ("--trust-models", "trust_models=True", "MJREC_TRUST_MODELS=1"):
        assert way_out in str(error.value)
    with pytest.raises(UnreadableFile, match="not the recorded model"):
        load_model(directory, {**crafted, "sha256": facts["sha256"]})


def test_argument_or_variable_grants_trust(directory, become_another_user, monkeypatch):
    """The hash is still checked, and the user's own models need no trust."""
    facts = {**store_model(directory), "xml": None}
    assert load_model(directory, facts).ngeom == 1
    become_another_user()
    for value in ("0", ""):
        monkeypatch.setenv(TRUST_VARIABLE, value)
        with pytest.raises(UntrustedModel, match="not written by this user"):
            load_model(directory, facts)
    assert load_model(directory, facts, trust_models=True).ngeom == 1
    monkeypatch.setenv(TRUST_VARIABLE, "1")
    assert load_model(directory, facts).ngeom == 1
    (directory / facts["mjb"]).write_bytes(gzip.compress(bytes(facts["bytes"])))
    with pytest.raises(UnreadableFile, match="not the recorded model"):
        load_model(directory, facts)


def test_rendering_a_foreign_recording_needs_trust(
    directory, become_another_user, tmp_path, capsys
):
    """An argument of the function or command grants trust, to workers as well."""
    theirs = record(directory)
    become_another_user()
    trajectory = load_trajectory(theirs.path)
    with pytest.raises(UntrustedModel, match="not written by this user"):
        trajectory.model()
    with pytest.raises(UntrustedModel, match="not written by this user"):
        next(mjrec.render(trajectory))
    trusted = load_trajectory(theirs.path, trust_models=True)
    assert trusted.model().ngeom == 3
    np.testing.assert_array_equal(list(mjrec.render(trusted)), theirs.frames)
    command = ["render", str(theirs.path), "--out", str(tmp_path / "again.mp4")]
    assert main(command) == 1
    assert "mjrec render --trust-models" in capsys.readouterr().out
    assert main([*command, "--trust-models"]) == 0
    assert TRUST_VARIABLE not in os.environ


def test_sources_give_the_same_frames(directory, become_another_user, monkeypatch):
    """Changes to the compiled model are applied again."""
    size = {"width": 64, "height": 48}
    env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array", **size)
    model = env.unwrapped.model
    model.vis.quality.shadowsize = 256
    model.geom_rgba[2] = (0, 1, 0, 1)
    model.geom_size[3, 0] *= 2
    with mjrec.Monitor(env, directory, lambda _: True, workers=0) as monitor:
        monitor.reset()
        live = [env.render()]
        for _ in range(2):
            monitor.step(np.full(6, 0.1))
            live.append(env.render())
        monitor.close(wait=False)
    become_another_user()
    forbid_compiled_models(monkeypatch, directory)
    [path] = (recording.path for recording in recordings_in_flight(directory))
    np.testing.assert_array_equal(list(mjrec.render(path)), live)
