# SPDX-License-Identifier: Apache-2.0
"""What may be asked of an environment that is made from its name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import InvalidArgument
from ..frames import check_size

DEFAULT_MAX_STEPS = 1000


@dataclass(frozen=True, kw_only=True)
class EnvironmentOptions:
    """How an environment is made.

    Attributes:
        camera: a camera's name or number; None is the model's tracking camera where
            there is one.
        height: of the pictures, in pixels; None is the environment's own.
        width: likewise.
        max_steps: ends an episode as truncated. Where the environment has a limit of
            its own, the smaller one wins; where it has none, None is 1000.
        pictures: whether the environment will be drawn.
        seed: of the run, for what an environment draws once, when it is made.
        kwargs: more arguments, in the form that the kind of environment takes.

    Raises:
        InvalidArgument: a value that cannot be.
    """

    camera: str | int | None = None
    height: int | None = None
    width: int | None = None
    max_steps: int | None = None
    pictures: bool = True
    seed: int = 0
    kwargs: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # The side that is not asked for is the environment's own, and fits.
        check_size(
            1 if self.height is None else self.height,
            1 if self.width is None else self.width,
        )
        steps = self.max_steps
        whole = isinstance(steps, int | np.integer) and not isinstance(steps, bool)
        if steps is not None and (not whole or steps < 1):
            raise InvalidArgument(
                f"max_steps must be a positive whole number, got {steps!r}."
            )

    @property
    def size(self) -> dict[str, int]:
        """The sides that are asked for, by name."""
        sides = {"height": self.height, "width": self.width}
        return {name: side for name, side in sides.items() if side is not None}

    def limit(self, own: float | None) -> int:
        """Return the number of steps after which an episode ends.

        Args:
            own: the limit that the environment has by itself; None or infinity if it
                has none.
        """
        limits = [limit for limit in (own, self.max_steps) if limit is not None]
        smallest = min(limits, default=np.inf)
        return DEFAULT_MAX_STEPS if smallest == np.inf else int(smallest)
