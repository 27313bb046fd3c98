# SPDX-License-Identifier: Apache-2.0
"""Evaluating policies on episodes of many tasks, with statistics."""
