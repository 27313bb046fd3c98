# SPDX-License-Identifier: Apache-2.0
"""Where work runs: processes of this machine, a Ray cluster, a Slurm cluster.

`work` says what an engine is, `choice` makes one from its name. `local`, `ray` and
`slurm` are engines; each keeps its jobs in a `job_book`, through `base_run`. On other
machines a `hosting.Host` does what the local engine does here. Slurm's hosts are handed
jobs as files, in a `job_folder`.
"""
