# SPDX-License-Identifier: Apache-2.0
"""Functions that create an engine from its name and options."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from concurrent.futures import Executor

from ..errors import Error, InvalidArgument, UnknownName, optional_module
from .local import LocalEngine
from .ray import RayEngine
from .slurm import SlurmEngine, slurm_options

_DASK = "dask:"
_SECONDS_TO_REACH = 10.0
ENGINES = ("local", "ray", "slurm", f"{_DASK}ADDRESS")


def given_engine(engine: Executor | str | None, workers: int | None) -> Executor | None:
    """Return the engine that a caller passed or named, or None.

    Args:
        engine: an executor, or the name of an engine.
        workers: number of workers, if `engine` is a name.

    Raises:
        UnknownName: no engine has that name.
        InvalidArgument: `engine` is neither an executor nor a name, `workers` is not a
            valid number, or `workers` is given although `engine` is an executor, which
            has its own workers.
        MissingDependency: a package that the engine needs is not installed.
    """
    if engine is None:
        return None
    if isinstance(engine, str):
        return engine_from(engine, workers=workers)
    if not isinstance(engine, Executor):
        raise InvalidArgument(
            "engine must be a concurrent.futures.Executor, such as "
            f"mjrec.LocalEngine(), or a name such as 'ray', not {engine!r}."
        )
    if workers is not None:
        raise InvalidArgument(
            f"workers={workers} and engine={engine!r} were given, but an engine has "
            "its own workers. Pass their number to the engine."
        )
    return engine


def engine_from(
    name: str,
    *,
    workers: int | None = None,
    address: str | None = None,
    gpus: float = 0.0,
    require_gpu: bool = False,
    options: Mapping[str, str] | None = None,
) -> Executor:
    """Create an engine.

    Args:
        name: `"local"`, `"ray"`, `"slurm"`, or `"dask:ADDRESS"` with the address of a
            Dask scheduler.
        workers: maximum number of workers; None uses the engine's default.
        address: address of a Ray cluster, or `"auto"` for the cluster running on this
            machine. If None, the cluster named by `RAY_ADDRESS` is used. If that
            variable is also unset, Ray is started for the run.
        gpus: number of GPUs for each worker, which may be a fraction.
        require_gpu: whether a worker that renders in software is an error.
        options: engine-specific options, as strings. Only Slurm has options, which are
            the parameters of `SlurmEngine`.

    Raises:
        UnknownName: the engine or an option does not exist.
        InvalidArgument: an argument is invalid, or is for a different engine.
        MissingDependency: a package that the engine needs is not installed.
        Error: the Dask scheduler does not answer.
    """
    if name.startswith(_DASK):
        if workers is not None or address is not None or gpus or options:
            raise InvalidArgument(
                f"The workers of {name} belong to the Dask cluster. Choose their "
                "number and resources when you start them."
            )
        return _dask(name.removeprefix(_DASK))
    if name not in ENGINES[:-1]:
        raise UnknownName("engine", name, ENGINES)
    if address is not None and name != "ray":
        raise InvalidArgument(
            f"The address {address} is for a Ray cluster (--engine ray), but the "
            f"engine is {name}."
        )
    if options and name != "slurm":
        raise InvalidArgument(
            f"The engine {name} has no options of its own, but these were given: "
            f"{', '.join(sorted(options))}. Slurm's options require --engine slurm."
        )
    if name == "ray":
        return RayEngine(workers, address=address, gpus=gpus, require_gpu=require_gpu)
    own = slurm_options(options or {}) if name == "slurm" else {}
    engine = SlurmEngine if name == "slurm" else LocalEngine
    return engine(workers, gpus=gpus, require_gpu=require_gpu, **own)


def _dask(address: str) -> Executor:
    distributed = optional_module(
        "distributed",
        purpose=f'engine="{_DASK}{address}"',
        install="dask[distributed]",
    )
    try:
        client = distributed.Client(
            address, set_as_default=False, timeout=_SECONDS_TO_REACH
        )
    except (OSError, ValueError) as error:
        raise Error(
            f"No Dask scheduler answers at {address}. `dask scheduler` starts one and "
            f"prints its address. Dask's error: {error}"
        ) from error
    # Do not merge identical jobs, because every job must run.
    executor: Executor = client.get_executor(pure=False)
    weakref.finalize(executor, client.close)
    return executor
