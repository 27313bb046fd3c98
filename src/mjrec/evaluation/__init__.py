# SPDX-License-Identifier: Apache-2.0
"""Evaluating policies: episodes of many tasks, and their statistics."""
