# SPDX-License-Identifier: Apache-2.0
"""Whether results bear the name of the environment that was made.

Results are read by their name, `env_id`, and an environment is made again by the `id`
that the recorder saw itself. An author may give a name of their own; the name of
another environment that everybody knows says something that is not so.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ...environments.made_again import (
    NotMadeAgain,
    is_installed_name,
    made_with,
    recorded_environment,
)
from ..verification import Check, Level, Verdict

_CLAIM = "the name that the results bear is that of the environment that was made"
_WORST_FIRST = (Verdict.FAIL, Verdict.NOT_CHECKABLE, Verdict.PASS)


class EnvironmentNames:
    """Gathers what episodes say, and speaks of each recording once."""

    def __init__(self) -> None:
        self._found: dict[str, dict[tuple[Verdict, str], None]] = {}

    def add(self, infix: str, facts: Mapping[str, Any]) -> None:
        """Look at the facts of an episode of a recording."""
        self._found.setdefault(infix, {})[_judged(facts)] = None

    def checks(self) -> Iterator[Check]:
        """Yield a check for each recording: the worst that was found."""
        for infix, found in self._found.items():
            verdict, reason = min(found, key=lambda pair: _WORST_FIRST.index(pair[0]))
            yield Check(
                level=Level.PHYSICS,
                claim=_CLAIM,
                subject=f"recording {infix}",
                verdict=verdict,
                reason=reason,
            )


def _judged(facts: Mapping[str, Any]) -> tuple[Verdict, str]:
    name = facts.get("env_id")
    try:
        recorded = recorded_environment(facts)
    except NotMadeAgain as error:
        return Verdict.NOT_CHECKABLE, f"it is called {name!r:.100}, and {error}"
    how = made_with(recorded)
    said = f"{recorded.id:.100}{', ' * bool(how)}{how}"
    if name == recorded.id:
        return Verdict.PASS, said
    if isinstance(name, str) and is_installed_name(name):
        return Verdict.FAIL, (
            f"it is called {name!r:.100}, which is the name of another environment, "
            f"and was made as {said}"
        )
    return Verdict.NOT_CHECKABLE, (
        f"it is called {name!r:.100}, and was made as {said}; an author may call it so "
        "(env_id=)"
    )
