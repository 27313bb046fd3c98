# SPDX-License-Identifier: Apache-2.0
"""From recorded states to frames, in processes of their own."""
