# SPDX-License-Identifier: Apache-2.0
"""Where jobs run: processes of this machine, a Ray cluster, Slurm, any executor.

`jobs` hands jobs to an executor and follows them; `worker` does one in a child process,
which runs `child`. `local`, `ray` and `slurm` are executors; `choice` makes one from a
name.
"""
