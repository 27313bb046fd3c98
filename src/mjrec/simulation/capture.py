# SPDX-License-Identifier: Apache-2.0
"""The states of a MuJoCo simulation inside an environment, ready to be recorded."""

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
from .self_check import scene_difference
from .snapshot import SnapshotSource
from .states import STATE_SPEC, state_dtype, state_words
from .view import SceneView

T = TypeVar("T")


# Fields of a model that `snapshot_dtype` looks at, which environments leave alone.
_SETTLING_THE_KIND = (
    *("tendon_limited", "tendon_matid", "tendon_plasticadr"),
    "sensor_",
)


@dataclass(frozen=True, kw_only=True)
class EpisodeStart:
    """What is known of a simulation when an episode begins.

    Attributes:
        state: what a state consists of.
        snapshot: what frames are drawn from; None where `refusal` says why there are
            none.
        model: where the model is stored, for the facts of a trajectory.
        scene: how it is shown, likewise; None where there are no snapshots.
        model_fields: what is other than in the stored model.
        refusal: why no frame can be drawn from snapshots of this model; None where it
            can, which was checked.
        words: state and snapshot in `memory.WORDS`, from which rows can be gathered
            while `is_current`; None where each moment needs a closer look.
        is_current: tells that nothing but the state is other than at the capture
            before, which is usual: the memory then holds this moment, until the
            environment is called again. It keeps the words alive.
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
    """Takes down the states of a simulation, episode by episode. Needs no OpenGL.

    The simulation is only read. What does not change between captures is kept, so that
    a capture takes microseconds; what has changed is found by comparing memory.

    Args:
        simulation: returns the model and the data of this moment, MuJoCo's own or
            dm_control's. The model may be another one after a reset.
        view: returns how the scene is shown; asked when an episode begins. The camera
            and the option in it are watched: they may be the environment's own.
        at_frame: calls what it is given in the moment at which the environment would
            draw, and then puts everything back; None where any moment is as good.
        resetting: returns what to put around a reset.
        authored: returns what the model was made from, where that is known.
        obstacle: returns why the frame of this moment cannot be made from the state,
            or None.
        is_unmoved: tells, faster than the others do, that simulation and view are as
            when `view` was asked, and nothing stands in the way: no other is then
            called. What is in model, camera and option is looked at besides.
        forget: lets the view be again as if nothing had been shown.
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
        # Whether only the state has changed since the last capture, and what ends that.
        self._is_current: Callable[[], bool] = _never
        self._look_closely: Callable[[], None] = lambda: None
        # As `simulation` gave them last; they may be dm_control's wrappers.
        self._seen: tuple[Any, Any] = (None, None)

    def open(self, directory: Path) -> None:
        """Store models in `directory` from here on."""
        self._store = ModelStore(directory)
        self._stored = self._frames = None

    def begin_episode(self) -> EpisodeStart:
        """Return what is there now, just after a reset.

        A model that was not seen before is stored; of one that was, the fields that
        are other than then are returned.
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
        if self._is_unmoved is not None and refusal is None and not frames.scene:
            self._watch(stored.looks, self._is_unmoved)
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
        """Write the state of this moment into `out`, `(state_length,)`.

        Raises:
            PicturesDiffer: the environment has gone over to another model.
        """
        stored, frames = self._followed()
        mujoco.mj_getState(stored.model, frames.data, out, STATE_SPEC)

    def capture_snapshot(
        self, out: NDArray[np.uint64]
    ) -> Mapping[str, NDArray[Any]] | None:
        """Write what a frame of this moment is drawn from into `out`.

        Args:
            out: all of its words.

        Returns:
            Model and view fields that are other than at the capture before, or at the
            beginning of the episode; None, which is usual, where all are the same.

        Raises:
            PicturesDiffer: the frame of this moment cannot be made from a snapshot,
                which was possible when the episode began.
        """
        if self._frames is not None and self._is_current():
            # The usual case, in half the time of the others.
            self._frames.source.take(out)
            return None
        _, frames = self._followed()
        reason = self._refusal or self._obstacle()
        if reason is not None:
            raise _differs(reason)
        return self._at_moment(lambda: self._captured(frames, out))

    def changed_fields(self) -> Mapping[str, NDArray[Any]] | None:
        """Return what of the model is other than at the capture before."""
        changed = self._changed() or {}
        own = {k: v for k, v in changed.items() if not k.startswith(VIEW_PREFIXES)}
        return own or None

    def model_changed(self) -> None:
        """Note that anything in the model may be another; the next capture looks."""
        self._looks_at_everything = True
        self._look_closely()

    def forget_frames(self) -> None:
        """Let the next episode's frames depend on none that was made before.

        To be called between episodes. Cameras that are placed at the first frame, or
        that each frame moves, are as in a simulation that has just been made.
        """
        self._forget()
        self._frames = None
        if self._stored is not None:
            self._stored.scene = None

    def settle(self) -> None:
        """Wait until every model is stored, or could not be: `finish` says so."""
        if self._store is not None:
            self._store.settle()

    def finish(self) -> None:
        """Wait until every model is stored.

        Raises:
            FileNotWritten: one could not be.
        """
        if self._store is not None:
            self._store.finish()

    def close(self) -> None:
        """Let go of model and data; idempotent. What waits is still stored."""
        if self._store is not None:
            self._store.leave()
        self._look_closely()
        self._stored = self._frames = None
        self._seen = (None, None)

    def _stored_model(
        self, model: mujoco.MjModel
    ) -> tuple[_StoredModel, dict[str, NDArray[Any]]]:
        """Return the model as stored, and what of it is other than that now."""
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
        """Return what takes the episode's snapshots: if it can be, that of before."""
        stored.looks.follow(view)
        key = (
            *(data._address, id(view.camera), id(view.option), view.max_geom),
            *(view.fresh, view.height, view.width, view.label),
            stored.looks.view_bytes(),
            # Then a snapshot may need others, and nothing is equal to this.
            object() if any(n.startswith(_SETTLING_THE_KIND) for n in fields) else 0,
        )
        if self._frames is None or self._frames.key != key:
            self._frames = _Frames(stored, data, view, key)
        return self._frames

    def _watch(self, looks: Looks, is_unmoved: Callable[[], bool]) -> None:
        """Let `is_current` tell whether view and model are as at the last capture."""
        seen, present = [*looks.seen], [*looks.present]
        self._is_current = lambda: seen == present and is_unmoved()
        self._look_closely = seen.clear

    def _at_moment(self, do: Callable[[], T]) -> T:
        """Return what `do` returns in the moment when a frame would be drawn."""
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
                f"{', '.join(fixed)} of the model has changed in mid-episode, which "
                "changes what the model consists of"
            )
        return changed

    def _followed(self) -> tuple[_StoredModel, _Frames]:
        """Take note of other objects in mid-episode."""
        model, data = self._simulation()
        stored, frames = self._stored, self._frames
        if stored is None or frames is None:
            raise _not_begun()
        if model is not self._seen[0] or data is not self._seen[1]:
            if not stored.looks.is_of(raw_model(model)):
                raise _differs("the environment has gone over to another model")
            self._look_closely()
            frames = self._frames = _Frames(stored, raw_data(data), frames.view, None)
            self._seen = (model, data)
        return stored, frames


class _StoredModel:
    """A model that is stored, and what is known of it.

    Attributes:
        scene: where each frame leaves its two cameras; None before the first.
        sound: with which visual options (as bytes), and with which fields other than
            stored, a snapshot was found to suffice.
    """

    def __init__(self, model: mujoco.MjModel, facts: dict[str, Any]) -> None:
        self.model = model
        self.facts = facts
        self.looks = Looks(model)
        self.state = state_dtype(model)
        self.scene: mujoco.MjvScene | None = None
        self.sound: set[bytes | str] = set()


class _Frames:
    """Takes snapshots of one simulation in one view, and tells whether they suffice.

    Where a frame has an influence on the next one, it follows what each leaves behind:
    an infinite plane is drawn around the camera of the frame before, and a camera that
    tracks a body goes a fifth of the way to it in each frame. Positions are those that
    MuJoCo computes, without any drawing.

    Attributes:
        key: what it depends on.
        kind: of the snapshots.
        source: of the snapshots themselves.
        words: of a row, where it can be gathered.
        scene: has the cameras; None where no frame has an influence on the next.
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
        """Return the facts of the scene, and what the frame before left in it."""
        facts = {**self._facts}
        before = self._stored.scene
        if self.scene is not None and not self.view.fresh and before is not None:
            facts["previous_cameras"] = [c.pos.tolist() for c in before.camera]
        if is_tracking(self._camera):
            self._lookat = self._camera.lookat.tolist()
            facts["camera"] = {**facts["camera"], "lookat": self._lookat}
        return facts

    def is_sound(self, fields: Iterable[str]) -> bool:
        """Return whether a snapshot was found to suffice with these fields changed.

        That is checked of the first frame, and again of the first one that has a
        visual option, or a changed field of the model, that none before it had.
        """
        return self._stored.sound.issuperset(self._looks(fields))

    def objection(self, fields: Iterable[str], row: Any) -> str | None:
        """Say why frames of this moment cannot be drawn from snapshots.

        Args:
            fields: of model and option, that have changed.
            row: the snapshot of this moment.
        """
        stored, option = self._stored, self.view.option
        reason = needs_constraints(stored.model, option)
        if reason is not None:
            return reason
        needed = snapshot_dtype(stored.model, self.data, option).names or ()
        missing = {*needed} - {*(self.kind.names or ())}
        if missing:
            return (
                f"it now needs {', '.join(sorted(missing))} as well, which the "
                "recording of this episode was not begun with"
            )
        found = scene_difference(stored.model, self.data, row, self.view)
        if found is not None:
            return f"drawn from its snapshot the scene is another one: {found}"
        stored.sound.update(self._looks(fields))
        return None

    def drawn(
        self, changed: dict[str, NDArray[Any]] | None
    ) -> dict[str, NDArray[Any]] | None:
        """Let the cameras move as a frame moves them, and add that to what changed."""
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
        # Moved as frames move it; the environment's own stays where it is.
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
    return ClosedError("No episode is recorded: call begin_episode() first.")
