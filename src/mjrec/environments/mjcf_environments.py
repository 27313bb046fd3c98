# SPDX-License-Identifier: Apache-2.0
"""An MJCF file as a Gymnasium environment."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from ..errors import InvalidArgument, NoPictures
from ..frames import Frame, check_size
from ..simulation.cameras import camera_label, default_camera, resolve_camera
from ..simulation.capture import Capture
from ..simulation.mjcf import MjcfSimulation, load_mjcf
from ..simulation.model_sources import authored_from_file
from ..simulation.renderer import SceneRenderer
from .named_environment import EnvironmentOptions
from .scenes import Scenes, generator_state, render_override
from .viewer_scene import ViewerScene

_SIDE = 480


def make_mjcf(
    path: Path, options: EnvironmentOptions, model: Any = None
) -> gymnasium.Env[Any, Any]:
    """Create an environment from an MJCF file. Episodes end after `max_steps`.

    Args:
        path: the file.
        options: the options; `kwargs` must be empty, because the file defines
            everything else.
        model: the file's compiled model. If it is given, the file need not exist.

    Raises:
        UnreadableFile: MuJoCo rejects the file.
        UnknownName: the model has no such camera.
        InvalidArgument: the camera's number or an argument is invalid.
    """
    if options.kwargs:
        raise InvalidArgument(
            "An MJCF file accepts no other arguments, but these were given: "
            f"{dict(options.kwargs)}. The file itself defines the whole simulation."
        )
    environment = MjcfEnvironment(
        path,
        render_mode="rgb_array" if options.frames else None,
        camera=options.camera,
        model=model,
        **options.size,
    )
    limit = options.limit(None)
    return environment if limit is None else TimeLimit(environment, limit)


class MjcfEnvironment(gymnasium.Env[NDArray[np.float64], NDArray[np.float64]]):
    """An environment that simulates an MJCF model, driven by its controls.

    An observation is `[qpos, qvel, act]`, `(nq + nv + na,) float64`. An action is
    `ctrl`, `(nu,) float64`, within the actuators' ranges. MuJoCo clamps values outside
    the ranges, and a model without actuators takes actions of shape `(0,)`. A step
    advances the simulation to the next sixtieth of a second (see `MjcfSimulation`).
    Every reset restores the model's initial state regardless of the seed, because
    nothing here is random. Rewards are 0. An episode is terminated only if the
    simulation becomes unstable. In that case, `info["unstable"]` gives the reason, and
    the last frame and observation are from before that moment.

    `metadata["render_fps"]` is the frame rate, which is 60 unless the timestep is
    longer than 1/60 second. `control_timestep()` is one over the frame rate. The model
    and its data are `simulation.model` and `simulation.data`. They are not attributes
    of the environment itself, because the time between two frames, measured by the
    data's clock, may differ from the duration of a frame by up to one timestep.

    Args:
        path: the MJCF file.
        render_mode: `"rgb_array"`, or None for no frames and no OpenGL.
        camera: a name or number; None for the default, see
            `simulation.cameras.default_camera`.
        height: height of the frames in pixels.
        width: width of the frames in pixels.
        model: the file's compiled model; None to compile the file.

    Raises:
        UnreadableFile: MuJoCo rejects the file.
        UnknownName: the model has no such camera.
        InvalidArgument: the camera's number, the size or the render mode is invalid.

    Attributes:
        path: the MJCF file.
        camera: the camera that the frames show.
        height: height of the frames in pixels.
        width: width of the frames in pixels.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 60}  # noqa: RUF012  Gymnasium's own declaration

    def __init__(
        self,
        path: str | Path,
        *,
        render_mode: str | None = None,
        camera: str | int | None = None,
        height: int = _SIDE,
        width: int = _SIDE,
        model: Any = None,
    ) -> None:
        self._renderer: SceneRenderer | None = None
        if render_mode not in (None, "rgb_array"):
            raise InvalidArgument(
                f'render_mode must be "rgb_array" or None, not {render_mode!r}.'
            )
        self.render_mode = render_mode
        self.height, self.width = check_size(height, width)
        self.path = Path(path)
        model = load_mjcf(self.path) if model is None else model
        self.simulation = MjcfSimulation(model)
        self.camera = default_camera(model) if camera is None else camera
        resolve_camera(model, self.camera)
        rate = self.simulation.frame_rate
        fps = rate.numerator if rate.denominator == 1 else float(rate)
        self.metadata = {**self.metadata, "render_fps": fps}
        self.spec = _spec(self.path)
        self.observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (model.nq + model.nv + model.na,), np.float64
        )
        low, high = self.simulation.control_ranges().T
        self.action_space = gymnasium.spaces.Box(low, high, (model.nu,), np.float64)

    def control_timestep(self) -> float:
        """Return the duration of a frame in simulated seconds."""
        return float(1 / self.simulation.frame_rate)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Reset to the model's initial state; `options` are not used."""
        super().reset(seed=seed)
        self.simulation.reset()
        return self.simulation.state(), {}

    def step(
        self, action: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Simulate one frame.

        Raises:
            InvalidArgument: the action has the wrong shape, or is not finite.
        """
        trouble = self.simulation.advance(self._checked(action))
        info = {} if trouble is None else {"unstable": trouble}
        return self.simulation.state(), 0.0, trouble is not None, False, info

    def render(self) -> Frame:
        """Return the current frame, `(height, width, 3) uint8`.

        Raises:
            NoPictures: the render mode is None.
            GLError: no OpenGL backend works here.
        """
        if self.render_mode is None:
            raise NoPictures(
                'Create the environment with render_mode="rgb_array" to render it.'
            )
        if self._renderer is None:
            self._renderer = SceneRenderer(
                self.simulation.model,
                height=self.height,
                width=self.width,
                camera=self.camera,
            )
        return self._renderer.render(self.simulation.data)

    def frame_facts(self) -> dict[str, Any]:
        """Return the facts about the frames for a video's metadata."""
        facts = {"camera": camera_label(self.simulation.model, self.camera)}
        if self._renderer is None:
            return facts
        return {**facts, **self._renderer.gl_facts}

    def mjrec_scenes(
        self, *, camera: Any, height: int | None, width: int | None
    ) -> Scenes:
        """Return how to record the states from which frames can be drawn."""
        simulation = self.simulation
        scene = ViewerScene(
            simulation,
            camera=self.camera if camera is None else camera,
            height=self.height if height is None else height,
            width=self.width if width is None else width,
        )
        return Scenes(
            states=Capture(
                lambda: (simulation.model, simulation.data),
                view=scene,
                forget=scene.forget,
                at_frame=scene.at_frame,
                authored=lambda: authored_from_file(self.path),
            ),
            obstacle=render_override(
                "environment", self, [(__name__, "MjcfEnvironment.render")]
            ),
            environment={
                "framework": "mjcf",
                "id": self.spec.id if self.spec else None,
                # The file defines everything else.
                "kwargs": {
                    name: side
                    for name, side in (("height", self.height), ("width", self.width))
                    if side != _SIDE
                },
            },
            # Nothing here is random.
            random_state=lambda: generator_state(self._np_random),
        )

    def close(self) -> None:
        """Close the renderer. Idempotent."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _checked(self, action: Any) -> NDArray[np.float64]:
        ctrl = np.asarray(action, dtype=np.float64)
        shape = self.action_space.shape
        if ctrl.shape != shape or not np.isfinite(ctrl).all():
            raise InvalidArgument(
                "An action must be an array of finite numbers with the shape "
                f"{shape}, not {action!r}."
            )
        return ctrl


def _spec(path: Path) -> EnvSpec:
    """Return a spec with the environment's name in recordings: `mjcf/<file name>`.

    The spec is not registered, because no environment is created from a name in a
    recording.
    """
    # Replace characters that Gymnasium does not allow in ids.
    name = re.sub(r"[^\w.-]", "_", path.stem)
    return EnvSpec(
        id=f"mjcf/{name}",
        entry_point=f"{__name__}:{MjcfEnvironment.__name__}",
        kwargs={"path": str(path)},
    )
