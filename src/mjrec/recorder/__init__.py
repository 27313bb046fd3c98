# SPDX-License-Identifier: Apache-2.0
"""The recorder, which follows the reset, step and close calls of any framework."""
