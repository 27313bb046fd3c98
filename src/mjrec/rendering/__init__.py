# SPDX-License-Identifier: Apache-2.0
"""Rendering of recorded states, in separate processes."""
