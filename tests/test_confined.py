# SPDX-License-Identifier: Apache-2.0

from pathlib import Path

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


def test_confined_process_reaches_only_its_files(tmp_path, monkeypatch):
    """The process sees no token, network or real home, but can still render."""
    folders = {name: tmp_path / name for name in ("readable", "other", "place")}
    for folder in (*folders.values(), tmp_path / "modules"):
        folder.mkdir()
    (tmp_path / "modules" / "probe_of_mjrec_tests.py").write_text(PROBE)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    monkeypatch.setenv("SECRET_TOKEN", "1")
    monkeypatch.setenv("MUJOCO_GL", "egl")
    request = {name: str(folder) for name, folder in folders.items()}
    given = {"place": folders["place"], "readable": [folders["readable"]]}
    with Sandbox("probe_of_mjrec_tests", request, **given) as sandbox:
        seen = next(sandbox.answers(60))
        assert seen is not None, sandbox.last_words()
    assert (seen["home"], seen["gl"]) == (str(folders["place"]), "egl")
    assert (seen["place"], seen["readable"], seen["written"]) == (True, True, True)
    assert (seen["token"], seen["network"]) == (False, False)
    modules = Path("/sys/kernel/security/lsm")
    if not modules.exists() or "landlock" in modules.read_text():
        assert (seen["other"], seen["written_elsewhere"]) == (False, False)


def test_confining_imports_nothing_that_could_start_a_thread():
    text = Path(confine.__code__.co_filename).read_text()
    assert "from ." not in text
    assert "numpy" not in text
