# SPDX-License-Identifier: Apache-2.0
"""The recorder: told reset, step and close; knows no framework."""
