# SPDX-License-Identifier: Apache-2.0
"""Work in jobs of a Slurm cluster."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

from .gpu_shares import GpuShare
from .local import check_worker_count
from .work import Run, Work

__all__ = ["SlurmEngine"]


class SlurmEngine:
    """Runs work in jobs of a Slurm cluster."""

    def __init__(
        self,
        workers: int | None = None,
        *,
        gpus: float = 0.0,
        require_gpu: bool = False,
    ) -> None:
        self.workers = check_worker_count(workers)
        self.share = GpuShare(each=gpus, required=require_gpu)

    @classmethod
    def from_texts(
        cls,
        options: Mapping[str, str],
        *,
        workers: int | None = None,
        gpus: float = 0.0,
        require_gpu: bool = False,
    ) -> Self:
        """Return an engine from options as the command line has them."""
        return cls(workers, gpus=gpus, require_gpu=require_gpu)

    def begin(self, work: Work) -> Run:
        """Begin a run. Workers are started when there are jobs."""
        raise NotImplementedError
