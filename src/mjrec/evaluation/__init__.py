# SPDX-License-Identifier: Apache-2.0
"""Evaluating policies: so many episodes of so many tasks, and what comes of them."""
