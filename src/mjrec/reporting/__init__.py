# SPDX-License-Identifier: Apache-2.0
"""Showing recordings: a page that opens from the disk, and film strips."""
