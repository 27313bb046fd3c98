# SPDX-License-Identifier: Apache-2.0
"""Handlers of jobs for workers that are spread over a cluster."""

import os
import time
from pathlib import Path

from odd_jobs import OddJobs


class ClusterJobs(OddJobs):
    """Odd jobs, and such as ask where they are."""

    def gpus(self, arguments):
        return {"gpus": os.environ.get("CUDA_VISIBLE_DEVICES")}

    def hold_till(self, arguments):
        """Go on until there is a file `go`; a line says each time that it begins."""
        begun = Path(arguments["begun"])
        with begun.open("a") as file:
            file.write(f"{os.getpid()}\n")
        while not begun.with_name("go").exists():
            time.sleep(0.05)
        return {}


def make(settings):
    return ClusterJobs(settings)
