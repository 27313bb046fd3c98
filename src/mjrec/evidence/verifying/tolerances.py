# SPDX-License-Identifier: Apache-2.0
"""How equal is equal enough: bit for bit on the same machine, less on another.

The last bit of a simulation depends on MuJoCo's version, on the C library and on what
the CPU can do. Where all three are the recording's, every number must be the recorded
one. Elsewhere each step is made from its recorded state, so that errors do not add up,
and is compared by `|x - y| / (1 + |x|)`:

- up to 1e-9 passes. Between MuJoCo 3.17 and 4.0, and with and without the CPU's FMA,
  models whose bodies touch as spheres, capsules and planes do differ by 2e-12;
- up to 1e-2 nobody can tell, where contacts are found by iterating (those of boxes,
  cylinders, ellipsoids, meshes and height fields jump from one point to another: 2e-7
  without FMA, 2.5e-3 between versions), or where the major version is another, which
  may compute otherwise on purpose (4.0 turns free bodies otherwise where a model
  integrates by RK4, by any amount: 0.1 in Gymnasium's Ant);
- all else fails.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from ...machine import machine_fingerprint
from ...provenance import versions
from ...simulation.replay import has_jumping_contacts, turns_by_rk4

_TOLERANCE: Final = 1e-9
_LIMIT: Final = 1e-2
# Velocities are differences divided by a time; rewards are made from them.
_DERIVED_FACTOR: Final = 1e3


@dataclass(frozen=True)
class Fit:
    """How far apart two numbers may be, by `|x - y| / (1 + |x|)`.

    Attributes:
        tolerance: up to which they pass; 0 is bit for bit.
        limit: up to which nobody can tell.
        why: why they need not be the same bit for bit, as a clause; "" if they do.
        why_unsure: why nobody can tell.
        is_other_major: MuJoCo's major version is another.
    """

    tolerance: float
    limit: float = 0.0
    why: str = ""
    why_unsure: str = ""
    is_other_major: bool = False

    @property
    def is_exact(self) -> bool:
        """Whether every bit must be the same."""
        return self.tolerance == 0

    def of_model(self, model: Any) -> Fit:
        """Return the same for what a model does."""
        if self.is_other_major:
            # MuJoCo 4.0 mended it; the bodies of Gymnasium's Ant turn otherwise since.
            return replace(self, limit=np.inf) if turns_by_rk4(model) else self
        if self.is_exact or not has_jumping_contacts(model):
            return self
        reason = "contacts of boxes, cylinders, ellipsoids or meshes may jump"
        return replace(self, limit=_LIMIT, why_unsure=reason)


def state_fit(facts: Mapping[str, Any]) -> Fit:
    """Return how far the states of a recording may be from those made again here."""
    ours, theirs = versions().get("mujoco", "none"), _version(facts, "mujoco")
    if theirs != ours:
        why = f"recorded with mujoco {theirs}, this is {ours}"
        if _major(theirs) == _major(ours):
            return _near(why)
        unsure = (
            "another major version may compute otherwise (pip install "
            f"mujoco=={theirs})"
        )
        return Fit(_TOLERANCE, _LIMIT, why, unsure, is_other_major=True)
    machine = facts.get("machine")
    if not isinstance(machine, Mapping):
        return _near("the recording does not say on which machine")
    own = machine_fingerprint().items()
    differing = [name for name, value in own if machine.get(name) != value]
    if differing:
        return _near(f"recorded on another machine, by its {', '.join(differing)}")
    return Fit(0.0)


def derived_fit(facts: Mapping[str, Any]) -> Fit:
    """Return the same for what environments compute: beginnings, rewards.

    They depend on NumPy too, whose sums are made in another order in other versions.
    """
    fit = state_fit(facts)
    if fit.is_exact:
        ours, theirs = versions().get("numpy"), _version(facts, "numpy")
        if theirs == ours:
            return fit
        fit = _near(f"recorded with numpy {theirs}, this is {ours}")
    tolerance = _DERIVED_FACTOR * fit.tolerance
    return replace(fit, tolerance=tolerance, limit=max(fit.limit, tolerance))


def _near(why: str) -> Fit:
    return Fit(_TOLERANCE, _TOLERANCE, why)


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
