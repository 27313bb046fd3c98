# SPDX-License-Identifier: Apache-2.0
"""Engines that run jobs: local processes, a Ray cluster, Slurm, or any executor.

`jobs` submits jobs to an executor and monitors them. `worker` does a job in a child
process that runs `child`. `local`, `ray` and `slurm` are executors, and `choice`
creates an executor from a name.
"""
