# SPDX-License-Identifier: Apache-2.0
"""How equal is equal enough: bit for bit on the same machine, less on another.

The last bit of a simulation depends on MuJoCo's version, on the C library and on what
the CPU can do. Where all three are the recording's, every number must be the recorded
one. Elsewhere each step is made from its recorded state, so that errors do not add up,
and is compared by `|x - y| / (1 + |x|)`. Between MuJoCo 3.17 and 4.0 that is 2e-12 for
most models, 1e-4 for contacts of meshes and 2.5e-3 for a height field.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from ...fingerprint import machine_fingerprint
from ...recorder.versions import versions

__all__ = ["Fit", "derived_fit", "framework_doubt", "state_fit"]

_SAME_MAJOR: Final = 1e-9
_OTHER_MAJOR: Final = 1e-2
# Velocities are differences divided by a time; rewards are made from them.
_DERIVED_FACTOR: Final = 1e3


@dataclass(frozen=True)
class Fit:
    """How far apart two numbers may be.

    Attributes:
        tolerance: of `|x - y| / (1 + |x|)`; 0 is bit for bit.
        why: why it is not, as a clause; "" where it is.
    """

    tolerance: float
    why: str = ""

    @property
    def is_exact(self) -> bool:
        """Whether every bit must be the same."""
        return self.tolerance == 0


def state_fit(facts: Mapping[str, Any]) -> Fit:
    """Return how far the states of a recording may be from those made again here."""
    ours, theirs = versions().get("mujoco", "none"), _version(facts, "mujoco")
    if theirs != ours:
        tolerance = _SAME_MAJOR if _major(theirs) == _major(ours) else _OTHER_MAJOR
        return Fit(tolerance, f"recorded with mujoco {theirs}, this is {ours}")
    machine = facts.get("machine")
    if not isinstance(machine, Mapping):
        return Fit(_SAME_MAJOR, "the recording does not say on which machine")
    differing = [
        name
        for name, value in machine_fingerprint().items()
        if machine.get(name) != value
    ]
    if differing:
        return Fit(
            _SAME_MAJOR,
            f"recorded on another machine, by its {', '.join(differing)}",
        )
    return Fit(0.0)


def derived_fit(facts: Mapping[str, Any]) -> Fit:
    """Return the same for what environments compute: beginnings, rewards.

    They depend on NumPy too, whose sums are made in another order in other versions.
    """
    states = state_fit(facts)
    if not states.is_exact:
        tolerance = min(_OTHER_MAJOR, _DERIVED_FACTOR * states.tolerance)
        return Fit(tolerance, states.why)
    ours, theirs = versions().get("numpy"), _version(facts, "numpy")
    if theirs != ours:
        tolerance = _DERIVED_FACTOR * _SAME_MAJOR
        return Fit(tolerance, f"recorded with numpy {theirs}, this is {ours}")
    return states


def framework_doubt(facts: Mapping[str, Any], framework: str) -> str:
    """Return why an environment of the same id may be another one here; "" if not."""
    package = {"gymnasium": "gymnasium", "dm_control": "dm-control"}.get(framework)
    if package is None:
        return ""
    ours, theirs = versions().get(package), _version(facts, package)
    if ours == theirs:
        return ""
    return (
        f"the recording was made with {package} {theirs}, and this is {ours}: "
        f"pip install {package}=={theirs}"
    )


def _version(facts: Mapping[str, Any], package: str) -> str:
    said = facts.get("versions")
    version = said.get(package) if isinstance(said, Mapping) else None
    return version[:40] if isinstance(version, str) else "of an unknown version"


def _major(version: str) -> str:
    return version.partition(".")[0]
