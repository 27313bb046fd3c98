# SPDX-License-Identifier: Apache-2.0
"""What a child and its parent send each other arrives, whatever is printed."""

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
    said = [*child.messages(60)]
    found = f"{said} {child.how_it_ended()} {child.printed()}"
pathlib.Path(sys.argv[1]).write_text(found)
"""
# As some machines' `sitecustomize` prints.
HELLO = "import os\nfor stream in (1, 2):\n    os.write(stream, b'hello ')\n"


@pytest.mark.parametrize(
    ("closed", "customized", "printed"), [("012", "", ""), ("", HELLO, "hello hello")]
)
def test_messages_arrive(closed, customized, printed, tmp_path):
    """Where the parent has no standard streams, and where a child prints early."""
    (tmp_path / "sitecustomize.py").write_text(customized)
    command = [sys.executable, "-c", PROGRAM, tmp_path / "outcome", closed]
    subprocess.run(command, check=True, env={"PYTHONPATH": str(tmp_path)})
    said = (tmp_path / "outcome").read_text()
    assert said == f"[{{}}] ended with status 0 {printed}"
