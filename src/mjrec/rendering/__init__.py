# SPDX-License-Identifier: Apache-2.0
"""From recorded states to pictures, in processes of their own."""
