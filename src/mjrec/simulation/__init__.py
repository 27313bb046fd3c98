# SPDX-License-Identifier: Apache-2.0
"""The modules that import mujoco."""
