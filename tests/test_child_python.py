# SPDX-License-Identifier: Apache-2.0
"""Test messages between a child process and its parent."""

import subprocess
import sys

import pytest

PROGRAM = """
import os, pathlib, sys
from mjrec.child_python import Child
for stream in map(int, sys.argv[2]):
    os.close(stream)
with Child("mjrec.provenance", environ=os.environ) as child:
    child.send(places=[])
    messages = [*child.messages(60)]
    found = f"{messages} {child.how_it_ended()} {child.printed()}"
pathlib.Path(sys.argv[1]).write_text(found)
"""
# On some machines, `sitecustomize` prints text.
HELLO = "import os\nfor stream in (1, 2):\n    os.write(stream, b'hello ')\n"


@pytest.mark.parametrize(
    ("closed", "customized", "printed"), [("012", "", ""), ("", HELLO, "hello hello")]
)
def test_messages_arrive_despite_other_output(closed, customized, printed, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(customized)
    command = [sys.executable, "-c", PROGRAM, tmp_path / "outcome", closed]
    subprocess.run(command, check=True, env={"PYTHONPATH": str(tmp_path)})
    outcome = (tmp_path / "outcome").read_text()
    assert outcome == f"[{{}}] ended with status 0 {printed}"
