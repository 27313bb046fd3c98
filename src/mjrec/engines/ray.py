# SPDX-License-Identifier: Apache-2.0
"""Work in tasks of a Ray cluster."""

from __future__ import annotations

from .gpu_shares import GpuShare
from .local import check_worker_count
from .work import Run, Work

__all__ = ["RayEngine"]


class RayEngine:
    """Runs work in tasks of a Ray cluster."""

    def __init__(
        self,
        workers: int | None = None,
        *,
        address: str | None = None,
        gpus: float = 0.0,
        require_gpu: bool = False,
    ) -> None:
        self.workers = check_worker_count(workers)
        self.address = address
        self.share = GpuShare(each=gpus, required=require_gpu)

    def begin(self, work: Work) -> Run:
        """Begin a run. Workers are started when there are jobs."""
        raise NotImplementedError
