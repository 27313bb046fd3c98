# SPDX-License-Identifier: Apache-2.0
"""From a monitor directory to one file that says what it is."""
