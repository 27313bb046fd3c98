# SPDX-License-Identifier: Apache-2.0
"""Measurements of what recording costs: `python -m benchmarks`."""
