# SPDX-License-Identifier: Apache-2.0
"""What a confined process can see, write and reach."""

from pathlib import Path

import pytest

from mjrec.confined import confine
from mjrec.sandbox import Sandbox

PROBE = """
import os, socket
from pathlib import Path
from mjrec.sandbox import enter

request, say = enter()

def tried(do):
    try:
        do()
    except OSError:
        return False
    return True

say(
    **{name: tried(lambda: os.listdir(path)) for name, path in request.items()},
    written=tried(lambda: Path("new").write_text("")),
    written_elsewhere=tried(lambda: Path(request["readable"], "new").write_text("")),
    network=tried(lambda: socket.create_connection(("127.0.0.1", 9), 1)),
    home=os.environ["HOME"],
    token="SECRET_TOKEN" in os.environ,
    gl=os.environ.get("MUJOCO_GL"),
)
"""


@pytest.fixture
def seen(tmp_path, monkeypatch):
    """Return what a confined process says that it can do."""
    folders = {name: tmp_path / name for name in ("readable", "other", "place")}
    for folder in (*folders.values(), tmp_path / "modules"):
        folder.mkdir()
    (tmp_path / "modules" / "probe_of_mjrec_tests.py").write_text(PROBE)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    monkeypatch.setenv("SECRET_TOKEN", "1")
    monkeypatch.setenv("MUJOCO_GL", "egl")
    request = {name: str(folder) for name, folder in folders.items()}
    with Sandbox(
        "probe_of_mjrec_tests",
        request,
        place=folders["place"],
        readable=[folders["readable"]],
    ) as sandbox:
        said = next(sandbox.answers(60))
        assert said is not None, sandbox.last_words()
        return {**said, "own": str(folders["place"])}


def test_a_confined_process_sees_what_it_is_given(seen):
    """No other file, home or token; what drawing needs is there."""
    assert seen["home"] == seen["own"]
    assert not seen["token"]
    assert seen["gl"] == "egl"
    assert (seen["place"], seen["readable"], seen["written"]) == (True, True, True)
    assert not seen["network"]
    if has_landlock():
        assert not seen["other"]
        assert not seen["written_elsewhere"]


def has_landlock():
    """Return whether this kernel has it."""
    path = Path("/sys/kernel/security/lsm")
    return not path.exists() or "landlock" in path.read_text()


def test_confining_needs_no_library():
    """It begins before anything is imported that could start a thread."""
    assert confine.__module__ == "mjrec.confined"
    text = Path(str(confine.__code__.co_filename)).read_text()
    assert "from ." not in text
    assert "numpy" not in text
