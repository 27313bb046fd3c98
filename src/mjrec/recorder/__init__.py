# SPDX-License-Identifier: Apache-2.0
"""The recorder: follows reset, step and close of any framework."""
