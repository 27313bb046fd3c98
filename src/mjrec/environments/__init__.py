# SPDX-License-Identifier: Apache-2.0
"""From a name to an environment, and what is known about its frames."""
