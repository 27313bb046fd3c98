# SPDX-License-Identifier: Apache-2.0
"""3D views of recorded episodes in a browser: replay pages and the live view."""
