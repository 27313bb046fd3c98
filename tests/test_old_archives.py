# SPDX-License-Identifier: Apache-2.0
"""Archives of every version of the format stay verifiable.

`data/evidence/version-<n>.zip` was packed by the mjrec that wrote that version, on some
machine: here physics and pixels are held to the tolerances, or, where MuJoCo and CPU
happen to be the same, to every bit.
"""

from __future__ import annotations

from pathlib import Path

import pytest

import mjrec
from mjrec.evidence.layout import FORMAT_VERSION
from mjrec.evidence.verification import Verdict

ARCHIVES = sorted((Path(__file__).parent / "data" / "evidence").glob("*.zip"))


def test_there_is_one_of_every_version() -> None:
    """Whoever raises the number packs one more."""
    names = [archive.stem for archive in ARCHIVES]
    assert names == [f"version-{n}" for n in range(1, FORMAT_VERSION + 1)]


@pytest.mark.parametrize("archive", ARCHIVES, ids=lambda path: path.stem)
def test_old_archive_is_verified(archive: Path) -> None:
    """Nothing fails; of files and statistics everything passes."""
    found = mjrec.verify(archive)
    assert found.failures == ()
    shallow = [check for check in found.checks if check.level in ("files", "stats")]
    assert {check.verdict for check in shallow} == {Verdict.PASS}
    proved = {check.level.value for check in found.checks if check.verdict == "pass"}
    assert proved == {"files", "stats", "physics", "pixels"}
