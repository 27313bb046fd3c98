# SPDX-License-Identifier: Apache-2.0
"""Evidence: a run packed into one file by its author, and checked by a stranger."""
