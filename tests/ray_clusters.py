# SPDX-License-Identifier: Apache-2.0
"""Ray clusters of several nodes on this machine, for tests."""

import contextlib
import logging
import os

import pytest
import ray
from engine_runs import MARK, marked
from waiting import wait_until

SMALL_STORE = 80 << 20


@contextlib.contextmanager
def home_for_ray(home):
    """Let Ray start with an empty home, and check that it leaves nothing there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(home))
        patch.setenv(MARK, str(os.getpid()))
        patch.setenv("RAY_AUTH_TOKEN", "0" * 64)
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        patch.delenv("RAY_ADDRESS", raising=False)
        yield
    assert not ray.is_initialized()
    assert not list(home.iterdir())
    mark = os.getpid()
    wait_until(lambda: not marked(mark), seconds=30, told=lambda: marked(mark))


@contextlib.contextmanager
def own_ray(*, cpus):
    """Start a Ray cluster for this process."""
    ray.init(
        address="local",
        num_cpus=cpus,
        include_dashboard=False,
        object_store_memory=SMALL_STORE,
        logging_level=logging.ERROR,
    )
    try:
        yield ray
    finally:
        ray.shutdown()
