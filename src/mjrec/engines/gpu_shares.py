# SPDX-License-Identifier: Apache-2.0
"""The number of workers, the GPUs for each worker, and the engines' packages."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import InvalidArgument, MissingDependency


@dataclass(frozen=True, kw_only=True)
class GpuShare:
    """Each worker's share of the GPUs.

    Attributes:
        each: number of GPUs per worker, which may be a fraction: with 0.25, four
            workers share a GPU. 0 means no GPU.
        required: whether a worker that renders in software is an error instead of a
            warning.

    Raises:
        InvalidArgument: `each` is not a number, is negative, or is more than 1 and not
            whole; or a GPU is required but `each` is 0.
    """

    each: float = 0.0
    required: bool = False

    def __post_init__(self) -> None:
        number = isinstance(self.each, int | float) and not isinstance(self.each, bool)
        if not (number and math.isfinite(self.each) and self.each >= 0):
            raise InvalidArgument(
                "gpus must be the number of GPUs per worker, such as 1, or 0.25 if "
                f"four share one, but it is {self.each!r}."
            )
        if self.each > 1 and self.each != int(self.each):
            raise InvalidArgument(
                "A worker gets part of one GPU or several whole GPUs, so gpus cannot "
                f"be {self.each:g}."
            )
        if self.required and not self.each:
            raise InvalidArgument(
                "A GPU is required (require_gpu, --require-gpu). Give each worker a "
                "share of a GPU, such as gpus=0.25 (--gpus 0.25)."
            )

    @property
    def asked_for(self) -> bool:
        """Whether workers get GPUs."""
        return self.each > 0

    @property
    def sharing(self) -> int:
        """Number of workers that share a GPU; 1 if no GPUs were requested."""
        return max(1, math.floor(1 / self.each + 1e-9)) if self.asked_for else 1

    def of(self, seat: int, gpus: Sequence[str]) -> str | None:
        """Return the GPUs for a worker, in the format of `CUDA_VISIBLE_DEVICES`.

        If there are more workers than shares, the assignment wraps around to the first
        GPU.

        Args:
            seat: the worker's number, from 0.
            gpus: the available GPUs, as in `CUDA_VISIBLE_DEVICES`.

        Returns:
            The GPUs, or None if there are none or none were requested.
        """
        if not (gpus and self.asked_for):
            return None
        count = max(1, int(self.each))
        first = seat // self.sharing * count
        return ",".join(
            dict.fromkeys(gpus[(first + n) % len(gpus)] for n in range(count))
        )


def check_worker_count(count: int | None, name: str = "workers") -> int | None:
    """Check that a number of workers is a whole number of at least 1, or None.

    Args:
        count: the number.
        name: the argument's name, for the error message.

    Returns:
        `count`, unchanged.

    Raises:
        InvalidArgument: `count` is anything else.
    """
    whole = isinstance(count, int) and not isinstance(count, bool)
    if count is not None and not (whole and count >= 1):
        raise InvalidArgument(
            f"{name} must be a whole number of at least 1, not {count!r}."
        )
    return count


def engine_package(package: str, engine: str, *, install: str) -> Any:
    """Import an engine's package, which is optional and slow to import.

    Raises:
        MissingDependency: the package is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        raise MissingDependency(
            package, purpose=f'engine="{engine}"', install=f'pip install "{install}"'
        ) from error
