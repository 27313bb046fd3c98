# SPDX-License-Identifier: Apache-2.0
"""Matrices of which the default run tries a few cases, and `scripts/test --all` all."""

import pytest
from _pytest.mark import ParameterSet


def parametrize(names, cases, *, default=1, part=pytest.mark.thorough, **options):
    """Do what `pytest.mark.parametrize` does, and mark what only `--all` runs.

    `default` is how many of the first cases the default run tries, or which; `part` is
    the marker of the others.
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
