# SPDX-License-Identifier: Apache-2.0
"""Reports on recordings: an offline web page, and film strips."""
