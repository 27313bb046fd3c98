# SPDX-License-Identifier: Apache-2.0
"""Evaluation of policies on many tasks, with statistics."""
