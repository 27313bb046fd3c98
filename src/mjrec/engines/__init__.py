# SPDX-License-Identifier: Apache-2.0
"""Where work runs: processes of this machine, or others.

`work` says what an engine is; each other module is one.
"""
