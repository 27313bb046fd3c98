# SPDX-License-Identifier: Apache-2.0
"""The states of an MJCF file's environment; its pictures always follow from them."""

from __future__ import annotations

from typing import Any

from ..simulation.capture import Capture
from ..simulation.model_sources import authored_from_file
from .mjcf_environments import MjcfEnvironment
from .scenes import Scenes, generator_state, has_own_method, overriding_class
from .viewer_scene import ViewerScene


def mjcf_scenes(
    env: MjcfEnvironment,
    *,
    camera: Any = None,
    height: int | None = None,
    width: int | None = None,
) -> Scenes:
    """Return how the states of an MJCF file's environment are recorded.

    Args:
        env: the environment, without its wrappers.
        camera: a name or number, or an `MjvCamera`; None is the environment's.
        height: in pixels; None is the environment's.
        width: likewise.

    Raises:
        UnknownName: the model has no such camera.
        InvalidArgument: a camera number, or a size, that cannot be.
    """
    simulation = env.simulation
    scene = ViewerScene(
        simulation,
        camera=env.camera if camera is None else camera,
        height=env.height if height is None else height,
        width=env.width if width is None else width,
    )
    return Scenes(
        states=Capture(
            lambda: (simulation.model, simulation.data),
            view=scene,
            forget=scene.forget,
            at_picture=scene.at_picture,
            authored=lambda: authored_from_file(env.path),
        ),
        obstacle=_obstacle(env),
        environment={
            "framework": "mjcf",
            "id": env.spec.id if env.spec else None,
            # All there is to say stands in the file.
            "kwargs": {},
        },
        # Nothing in it is random.
        random_state=lambda: generator_state(env._np_random),
    )


def _obstacle(env: MjcfEnvironment) -> str | None:
    if type(env).render is MjcfEnvironment.render and not has_own_method(env, "render"):
        return None
    return f"the environment {overriding_class(type(env), 'render')} overrides render()"
