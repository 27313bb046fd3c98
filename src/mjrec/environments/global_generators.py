# SPDX-License-Identifier: Apache-2.0
"""The random generators that a whole process shares."""

from __future__ import annotations

import random
import sys

import numpy as np


def seed_global_generators(seed: int) -> None:
    """Seed Python's, NumPy's and, where it is loaded, PyTorch's generators.

    Policies draw from them (`numpy.random.uniform`, dropout) without knowing of any
    seed. For processes of our own only: in a user's they are the user's.

    Args:
        seed: from 0 to 2**32 - 1.
    """
    random.seed(seed)
    np.random.seed(seed)
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(seed)
