# SPDX-License-Identifier: Apache-2.0
"""What the trackers have in common."""

import pytest
from other_python import run_python

import mjrec.trackers
from mjrec.errors import InvalidArgument


def test_import_loads_no_service():
    """Nor does importing each tracker."""
    answer = run_python(
        "import sys; from mjrec.trackers import *; "
        "print([m for m in ('tensorboard', 'wandb', 'google') if m in sys.modules])"
    )
    assert answer.stdout.split() == ["[]"]
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
    code = f"import sys\nsys.modules[{package!r}] = None\n"
    code += f"import mjrec.trackers as t\nt.{call}"
    said = run_python(code, cwd=tmp_path, status=1).stderr
    assert "mjrec.errors.MissingDependency" in said
    assert f"{package}, which is not installed. Run: pip install" in said
    assert f'"mjrec[{package}]"' in said
    assert list(tmp_path.iterdir()) == []
