# SPDX-License-Identifier: Apache-2.0
"""How many workers there are, and what each gets of GPUs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ..errors import InvalidArgument


@dataclass(frozen=True, kw_only=True)
class GpuShare:
    """What each worker of an engine gets of a GPU.

    Attributes:
        each: how many GPUs, in parts: with 0.25 four workers share one; 0 is none.
        required: a worker that renders in software all the same is an error, and not
            only a warning.

    Raises:
        InvalidArgument: `each` is negative, no number, or more than 1 and not whole; or
            a GPU is required and none asked for.
    """

    each: float = 0.0
    required: bool = False

    def __post_init__(self) -> None:
        number = isinstance(self.each, int | float) and not isinstance(self.each, bool)
        if not (number and math.isfinite(self.each) and self.each >= 0):
            raise InvalidArgument(
                "gpus is the number of GPUs per worker, such as 1, or 0.25 if four "
                f"share one, got {self.each!r}."
            )
        if self.each > 1 and self.each != int(self.each):
            raise InvalidArgument(
                "A worker gets part of one GPU or several whole ones: gpus cannot be "
                f"{self.each:g}."
            )
        if self.required and not self.each:
            raise InvalidArgument(
                "A GPU is required (require_gpu, --require-gpu): say how much of one "
                "each worker gets, such as gpus=0.25 (--gpus 0.25)."
            )

    @property
    def asked_for(self) -> bool:
        """Whether workers get any."""
        return self.each > 0

    @property
    def sharing(self) -> int:
        """How many workers share a GPU; 1 where none was asked for."""
        return max(1, math.floor(1 / self.each + 1e-9)) if self.asked_for else 1

    def of(self, seat: int, gpus: Sequence[str]) -> str | None:
        """Return which GPUs a worker gets, as `CUDA_VISIBLE_DEVICES` names them.

        Where the workers are more than the GPUs have parts, they go round again.

        Args:
            seat: the worker's number, from 0 on.
            gpus: those that there are, as in `CUDA_VISIBLE_DEVICES`.

        Returns:
            None where there are none, or none were asked for.
        """
        if not (gpus and self.asked_for):
            return None
        count = max(1, int(self.each))
        first = seat // self.sharing * count
        return ",".join(
            dict.fromkeys(gpus[(first + n) % len(gpus)] for n in range(count))
        )


def check_worker_count(count: int | None, name: str = "workers") -> int | None:
    """Return a number of at least 1, or None.

    Raises:
        InvalidArgument: it is something else.
    """
    whole = isinstance(count, int) and not isinstance(count, bool)
    if count is not None and not (whole and count >= 1):
        raise InvalidArgument(
            f"{name} must be a whole number of at least 1, got {count!r}."
        )
    return count
