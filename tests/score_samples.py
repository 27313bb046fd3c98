# SPDX-License-Identifier: Apache-2.0
"""Scores of which another library's figures are known."""

from __future__ import annotations

import numpy as np

from mjrec.evaluation.statistics import Samples

# Ten runs of six tasks; the figures below are what rliable 1.2.0 says of them.
X = {
    "a": [0.43, 0.65, 0.13, 0.56, 0.11, 0.05, 0.35, 0.49, 0.39, 0.22],
    "b": [0.29, 0.55, 0.41, 0.67, 0.79, 0.42, 0.32, 0.22, 0.51, 0.42],
    "c": [0.24, 0.16, 0.32, 0.55, 0.5, 0.77, 0.46, 0.46, 0.34, 0.39],
    "d": [0.41, 0.36, 0.19, 0.23, 0.49, 0.66, 0.22, 0.33, 0.18, 0.21],
    "e": [0.42, 0.67, 0.7, 0.36, 0.3, 0.27, 0.19, 0.59, 0.86, 0.15],
    "f": [0.15, 0.2, 0.07, 0.44, 0.52, 0.44, 0.5, 0.57, 0.39, 0.09],
}
Y = {
    "a": [0.36, 0.61, 0.54, 0.35, 0.61, 0.78, 0.53, 0.63, 0.62, 0.33],
    "b": [0.44, 0.29, 0.56, 0.42, 0.15, 0.84, 0.28, 0.58, 0.42, 0.35],
    "c": [0.24, 0.37, 0.7, 0.69, 0.42, 0.17, 0.75, 0.14, 0.41, 0.67],
    "d": [0.19, 0.52, 0.33, 0.76, 0.42, 0.38, 0.42, 0.79, 0.5, 0.54],
    "e": [0.5, 0.31, 0.46, 0.72, 0.51, 0.5, 0.21, 0.51, 0.31, 0.23],
    "f": [0.74, 0.59, 0.47, 0.19, 0.72, 0.71, 0.14, 0.67, 0.66, 0.49],
}
TENTHS = np.linspace(0, 1, 11)


def samples(values: dict[str, list[float]]) -> Samples:
    """Return each task's scores as an array."""
    return {task: np.array(numbers) for task, numbers in values.items()}
