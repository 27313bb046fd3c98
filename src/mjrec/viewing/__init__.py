# SPDX-License-Identifier: Apache-2.0
"""Recorded episodes in three dimensions, in a browser: replay pages, the live view."""
