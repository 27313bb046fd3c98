# SPDX-License-Identifier: Apache-2.0
"""Run a few cases of a matrix by default, and all of them with `scripts/test --all`."""

import pytest
from _pytest.mark import ParameterSet


def parametrize(names, cases, *, default=1, part=pytest.mark.thorough, **options):
    """Parametrize a test, and mark the cases that only `--all` runs.

    `default` is the number of leading cases to run by default, or a list of cases;
    `part` is the marker for the others.
    """
    cases = list(cases)
    if cases and not isinstance(default, int) and all(c not in default for c in cases):
        raise ValueError(f"the default run would try none of {cases[:5]} ...")
    several = isinstance(names, tuple) or "," in names
    marked = []
    for number, case in enumerate(cases):
        if number < default if isinstance(default, int) else case in default:
            marked.append(case)
        elif isinstance(case, ParameterSet):
            marked.append(case._replace(marks=[*case.marks, part]))
        else:
            marked.append(pytest.param(*(case if several else [case]), marks=part))
    return pytest.mark.parametrize(names, marked, **options)
