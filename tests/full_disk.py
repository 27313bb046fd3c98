# SPDX-License-Identifier: Apache-2.0
"""A full disk, for any user and on any machine."""

import resource
from contextlib import contextmanager


@contextmanager
def file_size_limit(size):
    """Let nobody in this process, and none that it starts, write beyond `size`."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
