# SPDX-License-Identifier: Apache-2.0
"""Policies in files.

=================  ==================================================================
`.zip`             written by `model.save()` of Stable-Baselines3. It acts as in
                   `predict`: without noise, within the action bounds, and with its
                   state if recurrent
`.pt` `.pth`       TorchScript, written by `torch.jit.save`: takes a float32 tensor of
`.torchscript`     shape (1, n); the first row of its output is the action
`.pt2`             the same, written by `torch.export.save`
`.onnx`            the same, run by onnxruntime on the CPU
=================  ==================================================================

An observation with several parts is concatenated if the file expects one array. Reading
a model.zip or TorchScript file runs its code, so read only trusted files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PolicyError, UnknownName, optional_module


def file_of_policy(text: str) -> Path | None:
    """Return the file that a policy name refers to, or None if it is not a file name.

    Raises:
        UnknownName: the name is a file name, but the file does not exist.
    """
    path = Path(text).expanduser()
    if path.suffix not in _READERS:
        return None
    if not path.is_file():
        folder = path.parent
        raise UnknownName(
            "policy file",
            text,
            sorted(str(p) for p in folder.glob("*") if p.suffix in _READERS),
            hint=f"Looked in {folder.absolute()}.",
        )
    return path


def policy_in_file(path: Path, environment: Any, **kwargs: Any) -> Any:
    """Return the policy in a file: a function, or an object with `predict`.

    Args:
        path: the file; see `file_of_policy`.
        environment: the environment to act in.
        **kwargs: `device`, for a model.zip or TorchScript; `"cpu"` by default.

    Raises:
        MissingDependency: the package that reads this type of file is missing.
        PolicyError: the file does not contain a policy.
    """
    return _READERS[path.suffix](path, environment, **kwargs)


class _Model:
    """The policy of a Stable-Baselines3 algorithm, without the code for learning."""

    def __init__(self, policy: Any) -> None:
        self._policy = policy

    def predict(
        self, observation: Any, state: Any, episode_start: Any, deterministic: bool
    ) -> Any:
        """Return the action and the next state."""
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
    saving = _library("stable_baselines3.common.save_util", path, "stable-baselines3")
    # Arguments for learning may be functions that another Python version pickled.
    of_learning = {"learning_rate": 0.0, "lr_schedule": None, "clip_range": None}
    data, weights, _ = saving.load_from_zip_file(
        path, device=device, custom_objects=of_learning
    )
    if not data or "policy_class" not in data:
        raise PolicyError(
            f"The policy {path} is not a Stable-Baselines3 model. Save one with "
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
    torch = _library("torch", path, "torch")
    try:
        if path.suffix == ".pt2":
            module = torch.export.load(path).module().to(device)
        else:
            module = torch.jit.load(path, map_location=device).eval()
    except RuntimeError as error:
        raise PolicyError(
            f"The policy {path} does not contain a network. Save one with "
            "torch.jit.trace(network, observation).save(path), or torch.export.save: "
            "weights alone do not define a network."
        ) from error

    def outputs(row: NDArray[np.float32]) -> Any:
        with torch.no_grad():
            return module(torch.from_numpy(row).to(device)).cpu().numpy()

    return _network(outputs, environment)


def _onnx(path: Path, environment: Any) -> Callable[[Any], Any]:
    onnxruntime = _library("onnxruntime", path, "onnx")
    session = onnxruntime.InferenceSession(
        str(path), providers=["CPUExecutionProvider"]
    )
    name = session.get_inputs()[0].name
    return _network(lambda row: session.run(None, {name: row})[0], environment)


def _network(
    outputs: Callable[[NDArray[np.float32]], Any], environment: Any
) -> Callable[[Any], Any]:
    """Return a policy that uses a network to map observation rows to action rows."""
    # Not imported at the top, because it loads Gymnasium.
    from .actions import action_space

    space: Any = action_space(environment)

    def choose(observation: Any) -> Any:
        action = outputs(_row(observation)[np.newaxis])[0]
        is_box = hasattr(space, "low") and action.shape == space.shape
        return np.clip(action, space.low, space.high) if is_box else action

    return choose


def _row(observation: Any) -> NDArray[np.float32]:
    """Return all numbers in an observation as one row."""
    parts = observation.values() if isinstance(observation, Mapping) else [observation]
    return np.concatenate([np.ravel(part) for part in parts]).astype(np.float32)


def _library(name: str, path: Path, extra: str) -> Any:
    purpose = f"Reading the policy {path}"
    return optional_module(name, purpose=purpose, install=f"mjrec[{extra}]")


_READERS: Mapping[str, Callable[..., Any]] = {
    ".zip": _stable_baselines3,
    **dict.fromkeys((".pt", ".pth", ".torchscript", ".pt2"), _torch),
    ".onnx": _onnx,
}
