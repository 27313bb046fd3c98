# SPDX-License-Identifier: Apache-2.0
"""The file formats: how each kind of file is named, written and read."""
