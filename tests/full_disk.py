# SPDX-License-Identifier: Apache-2.0
"""Simulate a full disk for any user on any machine."""

import resource
from contextlib import contextmanager


@contextmanager
def file_size_limit(size):
    """Stop this process and its children from writing files larger than `size`."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
