# SPDX-License-Identifier: Apache-2.0
"""Policies in files.

=================  ==================================================================
`.zip`             what `model.save()` of Stable-Baselines3 wrote. It acts as
                   `predict` does: without noise, within the bounds of its actions, a
                   recurrent one with its state
`.pt` `.pth`       TorchScript, of `torch.jit.save`: gets a float32 tensor of the shape
`.torchscript`     (1, n), and the first row of what it returns is the action
`.pt2`             likewise, of `torch.export.save`
`.onnx`            likewise, run by onnxruntime on the CPU
=================  ==================================================================

An observation of several parts is put end to end where the file takes one array.
Reading a model.zip, or TorchScript, runs what is in it: they are for files that you
trust.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingDependency, PolicyError, UnknownName


def file_of_policy(text: str) -> Path | None:
    """Return the file that a policy's name is; None for a name of another kind.

    Raises:
        UnknownName: it is that of a file, and there is none.
    """
    path = Path(text).expanduser()
    if path.suffix not in _READERS:
        return None
    if not path.is_file():
        folder = path.parent
        raise UnknownName(
            "file with a policy",
            text,
            sorted(str(p) for p in folder.glob("*") if p.suffix in _READERS),
            hint=f"Looked in {folder.absolute()}.",
        )
    return path


def policy_in_file(path: Path, environment: Any, **kwargs: Any) -> Any:
    """Return the policy that a file holds: a function, or something with `predict`.

    Args:
        path: as `file_of_policy` gave it.
        environment: that is to be acted in.
        **kwargs: `device`, of a model.zip or TorchScript: `"cpu"` if not given.

    Raises:
        MissingDependency: what reads such a file is not installed.
        PolicyError: it holds something else.
    """
    return _READERS[path.suffix](path, environment, **kwargs)


class _Model:
    """A policy of Stable-Baselines3, as the part of an algorithm that acts."""

    def __init__(self, policy: Any) -> None:
        self._policy = policy

    def predict(
        self, observation: Any, state: Any, episode_start: Any, deterministic: bool
    ) -> Any:
        """Return the action, and the state that comes next."""
        space = self._policy.observation_space
        given: Any
        if hasattr(space, "spaces"):
            parts = space.spaces.items()
            given = {n: np.asarray(observation[n], part.dtype) for n, part in parts}
        elif isinstance(observation, Mapping):
            given = _row(observation).astype(space.dtype)
        else:
            given = np.asarray(observation, space.dtype)
        return self._policy.predict(given, state, episode_start, deterministic)


def _stable_baselines3(path: Path, _environment: Any, *, device: str = "cpu") -> _Model:
    saving = _library("stable_baselines3.common.save_util", path)
    # What only learning uses may be functions that another Python has pickled.
    of_learning = {"learning_rate": 0.0, "lr_schedule": None, "clip_range": None}
    data, weights, _ = saving.load_from_zip_file(
        path, device=device, custom_objects=of_learning
    )
    if not data or "policy_class" not in data:
        raise PolicyError(
            f"The policy {path} is no model of Stable-Baselines3: write one with "
            "model.save()."
        )
    arguments = {k: v for k, v in data["policy_kwargs"].items() if k != "device"}
    if data.get("use_sde"):
        arguments["use_sde"] = True
    policy = data["policy_class"](
        data["observation_space"], data["action_space"], lambda _: 0.0, **arguments
    )
    policy.load_state_dict(weights["policy"])
    policy.to(device).set_training_mode(False)
    return _Model(policy)


def _torch(
    path: Path, environment: Any, *, device: str = "cpu"
) -> Callable[[Any], Any]:
    torch = _library("torch", path)
    try:
        if path.suffix == ".pt2":
            module = torch.export.load(path).module().to(device)
        else:
            module = torch.jit.load(path, map_location=device).eval()
    except RuntimeError as error:
        raise PolicyError(
            f"The policy {path} holds no network: write it with torch.jit.trace("
            "network, observation).save(path), or torch.export.save. Weights alone do "
            "not say which network they are of."
        ) from error

    def outputs(row: NDArray[np.float32]) -> Any:
        with torch.no_grad():
            return module(torch.from_numpy(row).to(device)).cpu().numpy()

    return _network(outputs, environment)


def _onnx(path: Path, environment: Any) -> Callable[[Any], Any]:
    onnxruntime = _library("onnxruntime", path)
    session = onnxruntime.InferenceSession(
        str(path), providers=["CPUExecutionProvider"]
    )
    name = session.get_inputs()[0].name
    return _network(lambda row: session.run(None, {name: row})[0], environment)


def _network(
    outputs: Callable[[NDArray[np.float32]], Any], environment: Any
) -> Callable[[Any], Any]:
    """Return what acts as a network says whose outputs have a row for each input."""
    # Not at the top: it loads Gymnasium.
    from .actions import action_space

    space: Any = action_space(environment)

    def choose(observation: Any) -> Any:
        action = outputs(_row(observation)[np.newaxis])[0]
        is_box = hasattr(space, "low") and action.shape == space.shape
        return np.clip(action, space.low, space.high) if is_box else action

    return choose


def _row(observation: Any) -> NDArray[np.float32]:
    """Return the numbers of an observation, end to end."""
    parts = observation.values() if isinstance(observation, Mapping) else [observation]
    return np.concatenate([np.ravel(part) for part in parts]).astype(np.float32)


def _library(name: str, path: Path) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        package = name.partition(".")[0].replace("_", "-")
        raise MissingDependency(
            package,
            purpose=f"Reading the policy {path}",
            install=f'pip install "mjrec[{package.replace("runtime", "")}]"',
        ) from error


_READERS: Mapping[str, Callable[..., Any]] = {
    ".zip": _stable_baselines3,
    **dict.fromkeys((".pt", ".pth", ".torchscript", ".pt2"), _torch),
    ".onnx": _onnx,
}
