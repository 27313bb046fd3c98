# SPDX-License-Identifier: Apache-2.0
"""Policies on their way to the workers: as a text, or as an object's bytes."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any

from ..errors import PolicyError


@dataclass(frozen=True)
class SentPolicy:
    """A policy that can be sent.

    Attributes:
        name: what was given as a text, or what the object is called.
        payload: the object's bytes; None for a text.
    """

    name: str
    payload: bytes | None = None

    @property
    def is_object(self) -> bool:
        """Whether it is an object."""
        return self.payload is not None


def sent_policy(policy: Any) -> SentPolicy:
    """Return a policy as it is sent.

    Args:
        policy: a text as in `mjrec record`; or a function, something with `predict`,
            or a class that is built with each environment.

    Raises:
        PolicyError: it can be no policy, or cannot be pickled.
    """
    if isinstance(policy, str):
        return SentPolicy(policy)
    if not (callable(policy) or callable(getattr(policy, "predict", None))):
        raise PolicyError(
            f"The policy {policy!r:.200} neither can be called nor has predict(). Give "
            "such an object, a class that is built with the environment, or a text: "
            "random, zero, module:name or module:name()."
        )
    return SentPolicy(_name_of(policy), _pickled(policy))


def _name_of(policy: Any) -> str:
    named = policy if hasattr(policy, "__qualname__") else type(policy)
    module = inspect.getmodule(named)
    name = str(named.__qualname__)
    return name if module is None else f"{module.__name__}:{name}"


def _pickled(policy: Any) -> bytes:
    # Not at the top: it is gymnasium's, which is only needed where things are run.
    # What is pickled goes through our own pipe, to processes of ours.
    import cloudpickle  # type: ignore[import-untyped]  # it has no types

    try:
        payload: bytes = cloudpickle.dumps(policy)
    except Exception as error:
        raise PolicyError(
            f"The policy {_name_of(policy)} cannot be sent to the processes that run "
            f"it: {type(error).__name__}: {error}. Give its name instead, "
            "policy='module:name': each process then imports it, and builds a class "
            "with its environment."
        ) from error
    return payload
