# SPDX-License-Identifier: Apache-2.0
"""Capture of states from the MuJoCo simulation inside an environment."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import ClosedError, PicturesDiffer
from .cameras import has_infinite_plane, is_tracking, raw_data, raw_model
from .captured_arrays import needs_constraints, snapshot_dtype
from .fields import VIEW_PREFIXES, is_settable
from .looks import Looks
from .model_sources import AuthoredModel
from .model_store import ModelStore
from .snapshot import SnapshotSource, scene_difference
from .states import STATE_SPEC, state_dtype, state_words
from .view import SceneView

T = TypeVar("T")


# Fields of a model that `snapshot_dtype` depends on. Environments rarely change them.
_SETTLING_THE_KIND = (
    *("tendon_limited", "tendon_matid", "tendon_plasticadr"),
    "sensor_",
)


@dataclass(frozen=True, kw_only=True)
class EpisodeStart:
    """The facts about a simulation at the start of an episode.

    Attributes:
        state: the dtype of a state.
        snapshot: the dtype of a snapshot, from which frames are drawn; None if
            `refusal` is set.
        model: the stored model's facts, for the trajectory.
        scene: the scene's facts, for the trajectory; None without snapshots.
        model_fields: the fields that differ from the stored model.
        refusal: the reason why snapshots of this model are not enough to draw frames;
            None if a check found that they are.
        words: the indices in `raw_memory.WORDS` for gathering rows of state and
            snapshot while `is_current` returns True; None if each capture must check
            for changes.
        is_current: a function that returns whether only the state has changed since the
            last capture, which is the usual case. The memory then contains the current
            state until the environment is called again. The function keeps the memory
            alive.
    """

    state: np.dtype[Any]
    snapshot: np.dtype[Any] | None
    model: Mapping[str, Any]
    scene: Mapping[str, Any] | None
    model_fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    refusal: str | None = None
    words: NDArray[np.intp] | None = None
    is_current: Callable[[], bool] = lambda: False


class Capture:
    """A recorder of a simulation's states, episode by episode.

    It needs no OpenGL, and only reads the simulation. Everything that does not change
    between captures is cached, so that a capture takes microseconds. Changes are found
    by comparing memory.

    Args:
        simulation: a function that returns the current model and data, which are
            MuJoCo's own or dm_control's. The model may be a different one after a
            reset.
        view: a function that returns the view of the scene, called when an episode
            begins. The view's camera and option may be the environment's own, so they
            are watched for changes.
        at_frame: a function that calls its argument at the moment when the environment
            would draw, and then restores the simulation; None if any moment will do.
        resetting: a function that returns a context manager for each reset.
        authored: a function that returns the model's sources, or None if unknown.
        obstacle: a function that returns the reason why the current frame cannot be
            drawn from the state, or None.
        is_unmoved: a fast check that the simulation and the view are as they were when
            `view` was called and that no obstacle exists. If it returns True, the other
            functions are not called, but the model, the camera and the option are still
            compared.
        forget: a function that resets the view as if nothing had been shown yet.
    """

    def __init__(
        self,
        simulation: Callable[[], tuple[Any, Any]],
        *,
        view: Callable[[], SceneView],
        at_frame: Callable[[Callable[[], None]], None] | None = None,
        resetting: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
        authored: Callable[[], AuthoredModel | None] = lambda: None,
        obstacle: Callable[[], str | None] = lambda: None,
        is_unmoved: Callable[[], bool] | None = None,
        forget: Callable[[], None] = lambda: None,
    ) -> None:
        self.resetting = resetting
        self._simulation = simulation
        self._view = view
        self._at_frame = at_frame or (lambda capture: capture())
        self._authored = authored
        self._obstacle = obstacle
        self._is_unmoved = is_unmoved
        self._forget = forget
        self._store: ModelStore | None = None
        self._stored: _StoredModel | None = None
        self._frames: _Frames | None = None
        self._refusal: str | None = None
        self._looks_at_everything = False
        # Returns whether only the state has changed since the last capture, until
        # `_look_closely` is called.
        self._is_current: Callable[[], bool] = _never
        self._look_closely: Callable[[], None] = lambda: None
        # The last result of `simulation`, which may consist of dm_control's wrappers.
        self._seen: tuple[Any, Any] = (None, None)

    def open(self, directory: Path) -> None:
        """Store models in `directory` from now on."""
        self._store = ModelStore(directory)
        self._stored = self._frames = None

    def begin_episode(self) -> EpisodeStart:
        """Return the facts about the simulation just after a reset.

        A new model is stored. For a known model, the fields that have changed since it
        was stored are included.
        """
        self._seen = self._simulation()
        data = raw_data(self._seen[1])
        stored, fields = self._stored_model(raw_model(self._seen[0]))
        self._looks_at_everything = False
        frames = self._frames_of(stored, data, self._view(), fields)
        refusal = self._refusal = self._obstacle()
        if refusal is None and not frames.is_sound(fields):
            refusal = self._refusal = self._at_moment(
                lambda: frames.objection(fields, frames.source.taken())
            )
        self._is_current = _never
        is_unmoved, looks = self._is_unmoved, stored.looks
        if is_unmoved is not None and refusal is None and not frames.scene:
            seen, present = [*looks.seen], [*looks.present]
            self._is_current = lambda: seen == present and is_unmoved()
            self._look_closely = seen.clear
        return EpisodeStart(
            state=stored.state,
            snapshot=frames.kind if refusal is None else None,
            model=stored.facts,
            scene=frames.facts() if refusal is None else None,
            model_fields=fields,
            refusal=refusal,
            words=None if self._is_current is _never else frames.words,
            is_current=self._is_current,
        )

    def capture_state(self, out: NDArray[np.float64]) -> None:
        """Write the current state into `out`, `(state_length,)`.

        Raises:
            PicturesDiffer: the environment has switched to another model.
        """
        stored, frames = self._followed()
        mujoco.mj_getState(stored.model, frames.data, out, STATE_SPEC)

    def capture_snapshot(
        self, out: NDArray[np.uint64]
    ) -> Mapping[str, NDArray[Any]] | None:
        """Write a snapshot, from which the current frame can be drawn, into `out`.

        Args:
            out: the words to write; all of them are set.

        Returns:
            Model and view fields that have changed since the last capture, or since
            the start of the episode; None, the usual case, if none have changed.

        Raises:
            PicturesDiffer: the current frame cannot be drawn from a snapshot, although
                this was possible when the episode began.
        """
        if self._frames is not None and self._is_current():
            # This usual case takes half as long as the others.
            self._frames.source.take(out)
            return None
        _, frames = self._followed()
        reason = self._refusal or self._obstacle()
        if reason is not None:
            raise _differs(reason)
        return self._at_moment(lambda: self._captured(frames, out))

    def changed_fields(self) -> Mapping[str, NDArray[Any]] | None:
        """Return the model's fields that have changed since the last capture."""
        changed = self._changed() or {}
        own = {k: v for k, v in changed.items() if not k.startswith(VIEW_PREFIXES)}
        return own or None

    def model_changed(self) -> None:
        """Make the next capture check the whole model for changes."""
        self._looks_at_everything = True
        self._look_closely()

    def forget_frames(self) -> None:
        """Make the next episode's frames independent of all previous frames.

        Call this between episodes. Cameras that are placed at the first frame, or that
        each frame moves, will start as in a new simulation.
        """
        self._forget()
        self._frames = None
        if self._stored is not None:
            self._stored.scene = None

    def settle(self) -> None:
        """Wait until no model is left to store; `finish` reports any failures."""
        if self._store is not None:
            self._store.settle()

    def finish(self) -> None:
        """Wait until every model is stored.

        Raises:
            FileNotWritten: a model could not be stored.
        """
        if self._store is not None:
            self._store.finish()

    def close(self) -> None:
        """Release the model and data. Idempotent. Queued models are still stored."""
        if self._store is not None:
            self._store.leave()
        self._look_closely()
        self._stored = self._frames = None
        self._seen = (None, None)

    def _stored_model(
        self, model: mujoco.MjModel
    ) -> tuple[_StoredModel, dict[str, NDArray[Any]]]:
        """Return the stored model, and the fields changed since it was stored."""
        if self._stored is not None and self._stored.looks.is_of(model):
            fields = self._stored.looks.since_stored()
            if all(map(is_settable, fields)):
                return self._stored, fields
        if self._store is None:
            raise ClosedError("Call open() with a directory before the first episode.")
        self._stored = _StoredModel(model, self._store.add(model, self._authored()))
        self._frames = None
        return self._stored, {}

    def _frames_of(
        self,
        stored: _StoredModel,
        data: mujoco.MjData,
        view: SceneView,
        fields: Iterable[str],
    ) -> _Frames:
        """Return the last snapshot source if it is still valid, otherwise a new one."""
        stored.looks.follow(view)
        key = (
            *(data._address, id(view.camera), id(view.option), view.max_geom),
            *(view.fresh, view.height, view.width, view.label),
            stored.looks.view_bytes(),
            # If one of these fields has changed, a snapshot may need other arrays. A
            # new object never compares equal.
            object() if any(n.startswith(_SETTLING_THE_KIND) for n in fields) else 0,
        )
        if self._frames is None or self._frames.key != key:
            self._frames = _Frames(stored, data, view, key)
        return self._frames

    def _at_moment(self, do: Callable[[], T]) -> T:
        """Call `do` when the environment would draw, and return its result."""
        results: list[T] = []
        self._at_frame(lambda: results.append(do()))
        return results[-1]

    def _captured(
        self, frames: _Frames, out: NDArray[np.uint64]
    ) -> dict[str, NDArray[Any]] | None:
        frames.source.take(out)
        changed = self._changed()
        fields = [name for name in changed or () if not name.startswith("camera.")]
        if fields and not frames.is_sound(fields):
            reason = frames.objection(fields, out.view(frames.kind)[0])
            if reason is not None:
                raise _differs(reason)
        return frames.drawn(changed)

    def _changed(self) -> dict[str, NDArray[Any]] | None:
        if self._stored is None:
            raise _not_begun()
        changed = self._stored.looks.changed(anything=self._looks_at_everything)
        self._looks_at_everything = False
        fixed = [name for name in changed or () if not is_settable(name)]
        if fixed:
            raise _differs(
                f"{', '.join(fixed)} of the model changed during the episode, and so "
                "did the model's structure"
            )
        return changed

    def _followed(self) -> tuple[_StoredModel, _Frames]:
        """Return the stored model and its frames, even if the objects have changed."""
        model, data = self._simulation()
        stored, frames = self._stored, self._frames
        if stored is None or frames is None:
            raise _not_begun()
        if model is not self._seen[0] or data is not self._seen[1]:
            if not stored.looks.is_of(raw_model(model)):
                raise _differs("the environment has switched to another model")
            self._look_closely()
            frames = self._frames = _Frames(stored, raw_data(data), frames.view, None)
            self._seen = (model, data)
        return stored, frames


class _StoredModel:
    """A stored model and facts about it.

    Attributes:
        scene: a scene with the two cameras as the last frame left them; None before the
            first frame.
        sound: the visual options (as bytes) and the changed fields for which a snapshot
            was found to suffice.
    """

    def __init__(self, model: mujoco.MjModel, facts: dict[str, Any]) -> None:
        self.model = model
        self.facts = facts
        self.looks = Looks(model)
        self.state = state_dtype(model)
        self.scene: mujoco.MjvScene | None = None
        self.sound: set[bytes | str] = set()


class _Frames:
    """A source of snapshots from one simulation in one view.

    It checks that the snapshots are enough to redraw the frames.

    If each frame influences the next one, it also keeps track of this influence: an
    infinite plane is drawn around the camera of the previous frame, and a camera that
    tracks a body moves a fifth of the way to it in each frame. MuJoCo computes these
    positions without drawing.

    Attributes:
        key: everything on which this object depends, for comparison.
        kind: the snapshots' dtype.
        source: the source of the snapshots.
        words: the indices of a row's words; None if a row cannot be gathered.
        scene: the scene with the cameras; None if no frame influences the next.
    """

    def __init__(
        self, stored: _StoredModel, data: mujoco.MjData, view: SceneView, key: object
    ) -> None:
        model = stored.model
        self.data, self.view, self.key = data, view, key
        self.kind = snapshot_dtype(model, data, view.option)
        self.source = SnapshotSource(model, data, self.kind)
        state = state_words(model, data)
        self.words: NDArray[np.intp] | None = None
        if state is not None and self.source.words is not None:
            self.words = np.concatenate([state, self.source.words])
        self._stored = stored
        self._facts = view.facts()
        self._follow_camera()
        self.scene: mujoco.MjvScene | None = None
        if is_tracking(view.camera) or (not view.fresh and has_infinite_plane(model)):
            self.scene = stored.scene or mujoco.MjvScene(model, maxgeom=1)

    def facts(self) -> dict[str, Any]:
        """Return the scene's facts, including the cameras after the last frame."""
        facts = {**self._facts}
        before = self._stored.scene
        if self.scene is not None and not self.view.fresh and before is not None:
            facts["previous_cameras"] = [c.pos.tolist() for c in before.camera]
        if is_tracking(self._camera):
            self._lookat = self._camera.lookat.tolist()
            facts["camera"] = {**facts["camera"], "lookat": self._lookat}
        return facts

    def is_sound(self, fields: Iterable[str]) -> bool:
        """Return whether a snapshot was found to suffice for these changed fields.

        This is checked for the first frame, and again for the first frame with a new
        visual option or a newly changed field of the model.
        """
        return self._stored.sound.issuperset(self._looks(fields))

    def objection(self, fields: Iterable[str], row: Any) -> str | None:
        """Return the reason why a snapshot does not suffice, or None if it does.

        Args:
            fields: names of the model's and the option's changed fields.
            row: the current snapshot.
        """
        stored, option = self._stored, self.view.option
        reason = needs_constraints(stored.model, option)
        if reason is not None:
            return reason
        needed = snapshot_dtype(stored.model, self.data, option).names or ()
        missing = {*needed} - {*(self.kind.names or ())}
        if missing:
            return (
                f"it now also needs {', '.join(sorted(missing))}, which the "
                "recording of this episode does not contain"
            )
        found = scene_difference(stored.model, self.data, row, self.view)
        if found is not None:
            return f"the scene drawn from its snapshot differs: {found}"
        stored.sound.update(self._looks(fields))
        return None

    def drawn(
        self, changed: dict[str, NDArray[Any]] | None
    ) -> dict[str, NDArray[Any]] | None:
        """Move the cameras as drawing would, and add their movement to the changes."""
        if any(name.startswith(VIEW_PREFIXES) for name in changed or ()):
            self._follow_camera()
        if self.scene is None:
            return changed
        lookat = self._camera.lookat
        if is_tracking(self._camera) and lookat.tolist() != self._lookat:
            self._lookat = lookat.tolist()
            changed = {**(changed or {}), "camera.lookat": lookat.copy()}
        model = self._stored.model
        mujoco.mjv_updateCamera(model, self.data, self._camera, self.scene)
        self._stored.scene = self.scene
        return changed

    def _looks(self, fields: Iterable[str]) -> list[bytes | str]:
        return [self._stored.looks.option_bytes(), *fields]

    def _follow_camera(self) -> None:
        # Frames move this copy. The environment's own camera stays unchanged.
        self._camera = copy.copy(self.view.camera)
        self._lookat = self._camera.lookat.tolist()


def _never() -> bool:
    return False


def _differs(reason: str) -> PicturesDiffer:
    return PicturesDiffer(
        f"This frame cannot be drawn from the recorded state: {reason}. Record live, "
        'with render="live".'
    )


def _not_begun() -> ClosedError:
    return ClosedError("No episode is being recorded. Call begin_episode() first.")
