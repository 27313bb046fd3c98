# SPDX-License-Identifier: Apache-2.0
"""Creation of environments from names, and facts about their frames."""
