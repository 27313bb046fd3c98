# SPDX-License-Identifier: Apache-2.0
"""The file formats: names, writers and readers for each kind of file."""
