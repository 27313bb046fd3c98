# SPDX-License-Identifier: Apache-2.0
"""An engine from its name and what was said of it."""

from __future__ import annotations

import importlib
import weakref
from collections.abc import Mapping
from concurrent.futures import Executor

from ..errors import Error, InvalidArgument, MissingDependency, UnknownName
from .local import LocalEngine
from .ray import RayEngine
from .slurm import SlurmEngine, slurm_options

_DASK = "dask:"
ENGINES = ("local", "ray", "slurm", f"{_DASK}ADDRESS")


def given_engine(engine: Executor | str | None, workers: int | None) -> Executor | None:
    """Return the engine that a caller names or gives; None where there is none.

    Args:
        engine: an executor, or the name of one of ours.
        workers: how many it is to have, where it is a name.

    Raises:
        UnknownName: there is no engine of that name.
        InvalidArgument: `engine` is none, or `workers` is no number of workers, or
            contradicts an executor, which has its own.
        MissingDependency: what the engine needs is not installed.
    """
    if engine is None:
        return None
    if isinstance(engine, str):
        return engine_from(engine, workers=workers)
    if not isinstance(engine, Executor):
        raise InvalidArgument(
            "engine must be a concurrent.futures.Executor, such as "
            f"mjrec.LocalEngine(), or a name such as 'ray', got {engine!r}."
        )
    if workers is not None:
        raise InvalidArgument(
            f"workers={workers} and engine={engine!r} were given, but an engine has "
            "its own workers: give their number to the engine."
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
    """Return an engine.

    Args:
        name: `"local"`, `"ray"`, `"slurm"`, or `"dask:ADDRESS"`, where a Dask scheduler
            listens.
        workers: how many at most; None is what the engine takes by itself.
        address: of a Ray cluster, `"auto"` for the one that runs on this machine; None
            is the one that `RAY_ADDRESS` names, else one that is started for the run.
        gpus: how much of a GPU each worker gets.
        require_gpu: a worker that renders in software is an error.
        options: what belongs to one engine only, as texts: parameters of `SlurmEngine`.

    Raises:
        UnknownName: there is no such engine, or no such option.
        InvalidArgument: one of them cannot be, or belongs to another engine.
        MissingDependency: what the engine needs is not installed.
        Error: there is no Dask scheduler.
    """
    if name.startswith(_DASK):
        if workers is not None or address is not None or gpus or options:
            raise InvalidArgument(
                f"The workers of {name} are those that the Dask cluster has. Choose "
                "their number and resources when you start them."
            )
        return _dask(name.removeprefix(_DASK))
    if name not in ENGINES[:-1]:
        raise UnknownName("engine", name, ENGINES)
    if address is not None and name != "ray":
        raise InvalidArgument(
            f"The address {address} is for a Ray cluster, but the engine is {name}."
        )
    if options and name != "slurm":
        raise InvalidArgument(
            f"The engine {name} has no options of its own, got "
            f"{', '.join(sorted(options))}. Those of Slurm need --engine slurm."
        )
    if name == "ray":
        return RayEngine(workers, address=address, gpus=gpus, require_gpu=require_gpu)
    if name == "slurm":
        return SlurmEngine(
            workers, gpus=gpus, require_gpu=require_gpu, **slurm_options(options or {})
        )
    return LocalEngine(workers, gpus=gpus, require_gpu=require_gpu)


def _dask(address: str) -> Executor:
    try:
        distributed = importlib.import_module("distributed")
    except ModuleNotFoundError as error:
        if error.name != "distributed":
            raise
        raise MissingDependency(
            "distributed",
            purpose=f'engine="{_DASK}{address}"',
            install='pip install "dask[distributed]"',
        ) from error
    try:
        client = distributed.Client(address, set_as_default=False)
    except (OSError, ValueError) as error:
        raise Error(
            f"No Dask scheduler answers at {address}. `dask scheduler` starts one and "
            f"prints its address. Dask's error: {error}"
        ) from error
    # Each job is done, though another one looks the same.
    executor: Executor = client.get_executor(pure=False)
    weakref.finalize(executor, client.close)
    return executor
