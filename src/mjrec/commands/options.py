# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, and their parsing."""

from __future__ import annotations

import re
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import tyro

from ..engines.choice import engine_from
from ..errors import InvalidArgument
from ..frames import check_size
from ..json_text import has_nan, loads
from ..rendering.jobs import PlainCamera, plain_camera
from .help_text import flowing_help

AsJson: TypeAlias = Annotated[bool, tyro.conf.arg(name="json")]

_LOCAL = "local"


def size_of(text: str | None) -> tuple[int | None, int | None]:
    """Return `(height, width)` for WIDTHxHEIGHT; `(None, None)` for None.

    Raises:
        InvalidArgument: `text` is not a valid size.
    """
    if text is None:
        return None, None
    match = re.fullmatch(r"(\d+)x(\d+)", text.strip(), re.ASCII | re.IGNORECASE)
    if match is None:
        raise InvalidArgument(
            f"--size must be WIDTHxHEIGHT in pixels, such as 640x480, got {text!r}."
        )
    return check_size(int(match[2]), int(match[1]))


def camera_of(text: str | None) -> PlainCamera | None:
    """Return a camera: a number, a name, or fields of an `MjvCamera` from JSON.

    Raises:
        InvalidArgument: the JSON or the value of a field is invalid.
        UnknownName: there is no such field.
    """
    if text is None:
        return None
    if text.lstrip().startswith("{"):
        return plain_camera(kwargs_of(text, "--camera"))
    return int(text) if re.fullmatch(r"-?\d+", text, re.ASCII) else text


def kwargs_of(text: str, option: str = "--env-kwargs") -> dict[str, Any]:
    """Return the keyword arguments in an option's value.

    Raises:
        InvalidArgument: `text` is not a JSON object, repeats a key, or contains NaN.
    """
    wrong = f"{option} must be a JSON object"
    try:
        kwargs = loads(text)
    except ValueError as error:
        raise InvalidArgument(f"{wrong}, got {text!r}: {error}.") from None
    if not isinstance(kwargs, dict):
        raise InvalidArgument(f"{wrong}, got {text!r}.")
    for name, value in kwargs.items():
        if has_nan(value):
            raise InvalidArgument(
                f"{wrong}, but {name!r} contains NaN, which JSON cannot represent."
            )
    return kwargs


@flowing_help
@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """Options for where the work runs.

    Attributes:
        engine: local (processes on this machine), ray, slurm, or dask:ADDRESS (a
            scheduler's address). All machines must see the directory under the same
            path.
        gpus: fraction of a GPU per worker; with 0.25, four workers share one.
        require_gpu: fail if a worker would render in software.
        address: the Ray cluster's address: HOST:PORT, or auto for the one on this
            machine. Default: RAY_ADDRESS, otherwise a cluster started for this
            command.
        engine_option: KEY=VALUE, an engine-specific option, such as partition=gpu for
            Slurm. May be repeated.
    """

    engine: str | None = None
    gpus: float | None = None
    require_gpu: bool = False
    address: str | None = None
    engine_option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()

    def chosen(self, workers: int | None) -> Executor | None:
        """Return the requested engine, or None if no engine option is set.

        Args:
            workers: the engine's number of workers.

        Raises:
            InvalidArgument: options contradict each other, or belong to a different
                engine.
            UnknownName: the engine has no option with that name.
            MissingDependency: a package that the engine needs is not installed.
        """
        if self == NO_ENGINE:
            return None
        return engine_from(
            self.engine or _LOCAL,
            workers=workers,
            address=self.address,
            gpus=self.gpus or 0.0,
            require_gpu=self.require_gpu,
            options=_options_of(self.engine_option),
        )


def _options_of(given: Sequence[str]) -> dict[str, str]:
    options: dict[str, str] = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not (key and equals):
            raise InvalidArgument(
                "--engine-option must be KEY=VALUE, such as partition=gpu, "
                f"got {text!r}."
            )
        if key in options:
            raise InvalidArgument(f"--engine-option {key} was given twice.")
        options[key] = value
    return options


# The default: no engine option is set.
NO_ENGINE = EngineOptions()
Engine: TypeAlias = Annotated[
    tyro.conf.OmitArgPrefixes[EngineOptions], tyro.conf.arg(name="engine")
]
