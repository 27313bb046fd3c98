# SPDX-License-Identifier: Apache-2.0
"""Benchmarks that measure the cost of recording: `python -m benchmarks`."""
