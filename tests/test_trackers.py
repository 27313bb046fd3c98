# SPDX-License-Identifier: Apache-2.0
"""What the trackers have in common."""

import pytest
from other_python import run_python

import mjrec.trackers
from mjrec.errors import InvalidArgument

# As if a package were not installed; everything else is there.
LACK = """
import sys

class Lack:
    def find_spec(self, name, path=None, target=None):
        if name == {package!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Lack())
"""


def run(code, cwd):
    return run_python(code, cwd=cwd, status=None)


def test_import_loads_no_service(tmp_path):
    """Nor does importing each tracker."""
    answer = run(
        "import sys; from mjrec.trackers import *; "
        "print([m for m in ('tensorboard', 'wandb', 'google') if m in sys.modules])",
        tmp_path,
    )
    assert answer.stdout.split() == ["[]"], answer.stderr
    with pytest.raises(AttributeError, match="no attribute 'Neptune'"):
        _ = mjrec.trackers.Neptune
    with pytest.raises(InvalidArgument, match="not a run and project, tags"):
        mjrec.trackers.WandbTracker(object(), project="p", tags=["a"])


@pytest.mark.parametrize(
    ("package", "call"),
    [
        ("tensorboard", "TensorBoardTracker('logs')"),
        ("wandb", "WandbTracker(mode='offline')"),
    ],
)
def test_missing_package_is_named_with_the_way_out(package, call, tmp_path):
    """By the constructor, before anything is written."""
    answer = run(
        LACK.format(package=package) + f"import mjrec.trackers as t\nt.{call}", tmp_path
    )
    assert "mjrec.errors.MissingDependency" in answer.stderr
    assert (
        f'{package}, which is not installed. Run: pip install "mjrec[{package}]"'
        in (answer.stderr)
    )
    assert list(tmp_path.iterdir()) == []
