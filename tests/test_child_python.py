# SPDX-License-Identifier: Apache-2.0
"""What a child and its parent send each other arrives, whatever is printed."""

import subprocess
import sys

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


def outcome(folder, *, closed):
    """Return what is sent, how the child ends and what it prints."""
    command = [sys.executable, "-c", PROGRAM, folder / "outcome", closed]
    subprocess.run(command, check=True, env={"PYTHONPATH": str(folder)})
    return (folder / "outcome").read_text()


def test_the_parent_may_have_no_standard_streams(tmp_path):
    """Their numbers are those of pipes then."""
    assert outcome(tmp_path, closed="012") == "[{}] ended with status 0 "


def test_what_is_printed_early_is_no_message(tmp_path):
    """As some machines' `sitecustomize` does, to either stream."""
    code = "import os\nfor stream in (1, 2):\n    os.write(stream, b'hello ')\n"
    (tmp_path / "sitecustomize.py").write_text(code)
    assert outcome(tmp_path, closed="") == "[{}] ended with status 0 hello hello"
