# SPDX-License-Identifier: Apache-2.0
"""The drawing speed of one worker, compared with a bare `mujoco.Renderer`."""

from __future__ import annotations

import functools
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mjrec
from mjrec.formats.json_fields import to_json
from mjrec.rendering.jobs import View

from .children import call
from .results import Reference, Result, at_least
from .rounds import Say, take_turns
from .setups import MONITOR, UNENDING, Setup, random_actions

TITLE = "Rendering: frames per second in one process; same model, size and states"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        environments: names of the environments whose states are drawn.
        rounds: number of rounds.
        frames: number of frames that each variant draws in a round.
        size: height and width of the frames.
    """

    environments: tuple[str, ...] = ("HalfCheetah-v5", "Humanoid-v5")
    rounds: int = 5
    frames: int = 150
    size: tuple[int, int] = (480, 480)


FULL = Settings()
QUICK = Settings(environments=("HalfCheetah-v5",), rounds=3, frames=60)


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return a result line for each environment and drawing method."""
    return [
        result
        for env_id in settings.environments
        for result in _measure_environment(env_id, settings, say)
    ]


def record_states(setup: dict[str, Any], frames: int, directory: str) -> str:
    """Record an episode in `directory` and return the path of its trajectory."""
    environment = Setup(**setup)
    env = environment.open(directory)
    env.reset(seed=0)
    for action in random_actions(env, frames - 1):
        env.step(action)
    environment.close(env)
    [path] = Path(directory).glob("*.h5")
    return str(path)


def draw_bare(trajectory: str, height: int, width: int) -> dict[str, float]:
    """Draw the states with a `mujoco.Renderer` in a loop."""
    # Imported here because mujoco reads the backend when it is imported, and the parent
    # process chooses the backend after this module is imported.
    import mujoco

    recording = mjrec.load_trajectory(trajectory)
    model = recording.model()
    model.vis.global_.offheight = max(height, model.vis.global_.offheight)
    model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
    data = mujoco.MjData(model)
    camera = _camera(recording.facts["scene"]["camera"])
    start = time.perf_counter()
    with mujoco.Renderer(model, height, width) as renderer:

        def draw(step: int) -> None:
            recording.set_state(data, step)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            renderer.render()

        return _timed(map(draw, recording.frame_steps), start)


def draw_through_render(trajectory: str, height: int, width: int) -> dict[str, float]:
    """Draw the same states with `mjrec.render` and one worker."""
    start = time.perf_counter()
    frames = mjrec.render(trajectory, height=height, width=width, workers=1)
    return _timed(frames, start)


def draw_as_worker(trajectory: str, height: int, width: int) -> dict[str, float]:
    """Draw the same states in this process, with the code that a worker uses."""
    # Imported here for the same reason as in `draw_bare`.
    from mjrec.rendering.worker import open_drawing
    from mjrec.simulation.renderer import Canvas

    start = time.perf_counter()
    view = to_json(View(height=height, width=width))
    drawing = open_drawing({"trajectory": trajectory, "view": view}, Canvas())
    count = _frame_count(trajectory)
    return _timed((drawing.draw(index) for index in range(count)), start)


_BARE, _RENDER, _WORKER = "mujoco.Renderer", "mjrec.render(workers=1)", "worker alone"
_WAYS: Mapping[str, Callable[..., dict[str, float]]] = {
    _BARE: draw_bare,
    _RENDER: draw_through_render,
    _WORKER: draw_as_worker,
}


def _frame_count(trajectory: str) -> int:
    return len(mjrec.load_trajectory(trajectory).frame_steps)


def _camera(facts: Mapping[str, Any]) -> Any:
    """Return the camera that the recording uses."""
    import mujoco

    camera = mujoco.MjvCamera()
    for name, value in facts.items():
        if name == "lookat":
            camera.lookat[:] = value
        else:
            setattr(camera, name, value)
    return camera


def _timed(frames: Iterable[object], start: float) -> dict[str, float]:
    """Return the rate after the first frame, and the seconds until that frame."""
    frames = iter(frames)
    next(frames)
    first = time.perf_counter()
    count = sum(1 for _ in frames)
    end = time.perf_counter()
    return {"rate": count / (end - first), "first": first - start}


def _measure_environment(env_id: str, settings: Settings, say: Say) -> list[Result]:
    height, width = settings.size
    make = {
        **UNENDING.get(env_id, {}),
        "height": height,
        "width": width,
        # More steps than are taken, so that the episode ends with the recording.
        "max_episode_steps": 10 * settings.frames,
    }
    setup = Setup(env_id=env_id, recorder=MONITOR, make=make, options={"workers": 0})
    with tempfile.TemporaryDirectory() as directory:
        say(f"{env_id}: recording")
        trajectory = call(
            record_states,
            setup=setup.as_json(),
            frames=settings.frames,
            directory=directory,
        )
        samples = take_turns(
            {
                (env_id, name): functools.partial(
                    call, draw, trajectory=trajectory, height=height, width=width
                )
                for name, draw in _WAYS.items()
            },
            rounds=settings.rounds,
            say=say,
        )
    bare = Reference(_BARE, _rates(samples[env_id, _BARE]))
    return [_result(env_id, name, samples[env_id, name], bare) for name in _WAYS]


def _result(
    env_id: str, name: str, samples: list[dict[str, float]], bare: Reference
) -> Result:
    first = statistics.median(sample["first"] for sample in samples)
    return Result(
        subject=env_id,
        variant=name,
        unit="frames/s",
        samples=_rates(samples),
        reference=None if name == _BARE else bare,
        promise=at_least(0.9) if name == _RENDER else None,
        note=f"first frame after {first:.2f} s (not counted)",
    )


def _rates(samples: list[dict[str, float]]) -> tuple[float, ...]:
    return tuple(sample["rate"] for sample in samples)
