# SPDX-License-Identifier: Apache-2.0
"""The states of a MuJoCo simulation inside an environment, ready to be recorded."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import ClosedError, PicturesDiffer
from ..formats.trajectory import RowLayout
from .authored_model import AuthoredModel
from .cameras import raw_data, raw_model
from .gathering import can_be_gathered, words_of
from .integration_state import STATE_SPEC, state_components
from .model_fields import is_settable
from .model_memory import ModelMemory
from .model_store import ModelStore
from .picture_states import (
    CheckedPictures,
    KeptCameras,
    PictureStates,
    moves_cameras,
)
from .scene_view import SceneView, ViewMemory
from .state_memory import has_state_memory, state_memory
from .state_source import EpisodeStart, MomentMemory

T = TypeVar("T")


class EpisodeStates:
    """Implements `StateSource` for a MuJoCo simulation. Needs no OpenGL.

    The simulation is only read. What does not change between captures is kept, so that
    a capture takes microseconds; what has changed is found by comparing memory.

    Args:
        simulation: returns the model and the data of this moment, MuJoCo's own or
            dm_control's. The model may be another one after a reset.
        view: returns how the scene is shown; asked when an episode begins. The camera
            and the option in it are watched: they may be the environment's own.
        at_picture: calls what it is given in the moment at which the environment would
            draw, and then puts everything back; None where any moment is as good.
        resetting: returns what to put around a reset.
        authored: returns what the model was made from, where that is known.
        obstacle: returns why the picture of this moment cannot be made from the state,
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
        at_picture: Callable[[Callable[[], None]], None] | None = None,
        resetting: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
        authored: Callable[[], AuthoredModel | None] | None = None,
        obstacle: Callable[[], str | None] | None = None,
        is_unmoved: Callable[[], bool] | None = None,
        forget: Callable[[], None] = lambda: None,
    ) -> None:
        self._simulation = simulation
        self._view = view
        self._at_picture = at_picture
        self._resetting = resetting
        self._authored = authored
        self._obstacle = obstacle
        self._is_unmoved = is_unmoved
        self._forget = forget
        self._store: ModelStore | None = None
        self._stored: _StoredModel | None = None
        self._pictures: PictureStates | None = None
        self._refusal: str | None = None
        self._look_at_everything = False
        self._quick: _QuickCapture | None = None
        # As `simulation` gave them last; they may be dm_control's wrappers.
        self._seen: tuple[Any, Any] = (None, None)

    def open(self, directory: Path) -> None:
        """Store models in `directory` from here on."""
        self._store = ModelStore(directory)
        self._stored = self._pictures = None

    def resetting(self) -> AbstractContextManager[None]:
        """Return what to put around the reset of the environment."""
        return self._resetting()

    def begin_episode(self) -> EpisodeStart:
        """Return what is there now, just after a reset.

        A model that was not seen before is stored; of one that was, the fields that
        are other than then are returned.
        """
        self._seen = self._simulation()
        model, data = raw_model(self._seen[0]), raw_data(self._seen[1])
        stored, fields = self._stored_model(model)
        stored.follow(data)
        self._look_at_everything = False
        pictures = self._episode_pictures(stored, fields)
        self._refusal = self._reason_against(pictures, fields)
        refused = self._refusal is not None
        self._quick = None
        if self._is_unmoved is not None and pictures.stand_alone and not refused:
            self._quick = _QuickCapture(self._is_unmoved, stored, pictures)
        return EpisodeStart(
            state=stored.components,
            snapshot=RowLayout() if refused else pictures.layout,
            model=stored.facts,
            scene=None if refused else pictures.facts(),
            model_fields=fields,
            refusal=self._refusal,
            memory=None if self._quick is None else self._quick.memory(),
        )

    def capture_state(self, out: NDArray[np.float64]) -> None:
        """Write the state of this moment into `out`, `(state_length,)`.

        Raises:
            PicturesDiffer: the environment has gone over to another model.
        """
        model, data = self._simulation()
        if model is not self._seen[0] or data is not self._seen[1]:
            self._go_over_to(model, data)
        if self._stored is None:
            raise _not_begun()
        self._stored.read_state(out)

    def capture_snapshot(
        self, out: NDArray[np.uint8]
    ) -> Mapping[str, NDArray[Any]] | None:
        """Write what a picture of this moment is made from into `out`.

        Returns:
            Model and view fields that are other than at the capture before; None,
            which is usual, where all are the same.

        Raises:
            PicturesDiffer: the picture of this moment cannot be made from a snapshot,
                which was possible when the episode began.
        """
        quick = self._quick
        if quick is not None and quick.is_current():
            # The usual case, in half the time of the others.
            quick.take(out)
            return None
        model, data = self._simulation()
        if model is not self._seen[0] or data is not self._seen[1]:
            self._go_over_to(model, data)
        stored, pictures = self._stored, self._pictures
        if stored is None or pictures is None:
            raise _not_begun()
        if self._refusal is not None:
            raise _differs(self._refusal)
        if self._obstacle is not None and (reason := self._obstacle()) is not None:
            raise _differs(reason)
        if self._at_picture is None:
            return self._captured(stored, pictures, out)
        return _called_in(
            self._at_picture, lambda: self._captured(stored, pictures, out)
        )

    def changed_fields(self) -> Mapping[str, NDArray[Any]] | None:
        """Return the fields of the model that are other than at the capture before."""
        stored = self._stored
        if stored is None:
            raise _not_begun()
        return self._changed_fields(stored)

    def model_changed(self) -> None:
        """Note that anything in the model may be another; the next capture looks."""
        self._look_at_everything = True
        self._end_quick_capture()

    def forget_pictures(self) -> None:
        """Let the next episode's first picture be the first of all."""
        self._forget()
        self._pictures = None
        if self._stored is not None:
            self._stored.forget_pictures()

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
        self._stored = self._pictures = self._quick = None
        self._seen = (None, None)

    def _stored_model(
        self, model: mujoco.MjModel
    ) -> tuple[_StoredModel, dict[str, NDArray[Any]]]:
        """Return the model as stored, and what of it is other than that now."""
        if self._stored is not None and self._stored.memory.is_of(model):
            fields = self._stored.memory.changed_from_stored()
            if all(is_settable(name) for name in fields):
                return self._stored, fields
        if self._store is None:
            raise ClosedError("Call open() with a directory before the first episode.")
        authored = self._authored() if self._authored is not None else None
        facts = self._store.add(model, authored)
        self._stored, self._pictures = _StoredModel(model, facts), None
        return self._stored, {}

    def _episode_pictures(
        self, stored: _StoredModel, fields: Mapping[str, Any]
    ) -> PictureStates:
        view = self._view()
        pictures = self._pictures
        if pictures is None or not pictures.goes_on(stored.data, view, fields):
            pictures = self._pictures = stored.pictures(view, fields)
        return pictures

    def _reason_against(
        self, pictures: PictureStates, fields: Mapping[str, Any]
    ) -> str | None:
        reason = self._obstacle() if self._obstacle is not None else None
        if reason is not None:
            return reason
        if self._at_picture is None or pictures.is_sound(fields):
            return pictures.refusal(fields)
        return _called_in(self._at_picture, lambda: pictures.refusal(fields))

    def _captured(
        self, stored: _StoredModel, pictures: PictureStates, out: NDArray[np.uint8]
    ) -> dict[str, NDArray[Any]] | None:
        of_view = pictures.take(out)
        of_model = self._changed_fields(stored)
        if of_view is None and of_model is None:
            return None
        changed = {**(of_model or {}), **(of_view or {})}
        reason = pictures.objection(out, changed)
        if reason is not None:
            raise _differs(reason)
        return changed

    def _changed_fields(self, stored: _StoredModel) -> dict[str, NDArray[Any]] | None:
        if self._look_at_everything:
            self._look_at_everything = False
            changed = stored.memory.anything_changed()
        else:
            changed = stored.memory.changed()
        if changed is not None:
            _check_settable(changed)
        return changed

    def _end_quick_capture(self) -> None:
        """Look closely from here on, whoever has been told of the memory."""
        if self._quick is not None:
            self._quick.end()
            self._quick = None

    def _go_over_to(self, model: Any, data: Any) -> None:
        """Take note of other objects in mid-episode."""
        stored, pictures = self._stored, self._pictures
        if stored is None or pictures is None:
            raise _not_begun()
        if not stored.memory.is_of(raw_model(model)):
            raise _differs("the environment has gone over to another model")
        stored.follow(raw_data(data))
        self._end_quick_capture()
        self._pictures = stored.pictures(pictures.view, watched=pictures.watched)
        self._seen = (model, data)


class _StoredModel:
    """A model that is stored, and what is known of it.

    Args:
        model: the model.
        facts: where it is stored.

    Attributes:
        data: the data whose states are recorded.
    """

    data: mujoco.MjData

    def __init__(self, model: mujoco.MjModel, facts: dict[str, Any]) -> None:
        self.memory = ModelMemory(model)
        self.facts = facts
        self.components = state_components(model)
        self._model = model
        self._checked = CheckedPictures()
        self._kept: KeptCameras | None = None
        self._has_state_memory = has_state_memory(model)
        # Of `gathering.WORDS`; None where a state has to be asked for.
        self.state_words: NDArray[np.intp] | None = None
        self._followed: int | None = None

    def follow(self, data: mujoco.MjData) -> None:
        """Record the states of `data` from here on."""
        self.data = data
        if self._has_state_memory and data._address != self._followed:
            # It is kept alive, so that no other can have its address.
            self._followed = data._address
            arrays = state_memory(self._model, data)
            is_gathered = can_be_gathered(arrays)
            self.state_words = words_of(arrays) if is_gathered else None

    def read_state(self, out: NDArray[np.float64]) -> None:
        """Write the state into `out`."""
        mujoco.mj_getState(self._model, self.data, out, STATE_SPEC)

    def pictures(
        self,
        view: SceneView,
        changed_fields: Iterable[str] = (),
        *,
        watched: ViewMemory | None = None,
    ) -> PictureStates:
        """Return what takes snapshots of the data.

        Args:
            view: how the scene is shown.
            changed_fields: of the model, other than in the stored one.
            watched: the view as it was at the snapshot before, if there was one.
        """
        return PictureStates(
            self._model,
            self.data,
            view,
            changed_fields,
            kept=self._kept_cameras(view),
            checked=self._checked,
            watched=watched,
        )

    def forget_pictures(self) -> None:
        """Forget what pictures have left in the scene; of `pictures` make others."""
        self._kept = None

    def _kept_cameras(self, view: SceneView) -> KeptCameras | None:
        if self._kept is None and moves_cameras(self._model, view):
            self._kept = KeptCameras(self._model)
        return self._kept


class _QuickCapture:
    """Takes snapshots of an episode for as long as only its state changes.

    Attributes:
        take: writes a snapshot.
    """

    def __init__(
        self,
        is_unmoved: Callable[[], bool],
        stored: _StoredModel,
        pictures: PictureStates,
    ) -> None:
        self._is_unmoved = is_unmoved
        self._seen = [*stored.memory.seen, *pictures.watched.seen]
        self._present = [*stored.memory.present, *pictures.watched.present]
        self._state_words = stored.state_words
        self._source = pictures.source
        self.take = pictures.source.take

    def is_current(self) -> bool:
        """Tell whether view and model are as they were at the capture before."""
        # Not `self._is_unmoved()`: calling an attribute takes CPython twice as long.
        is_unmoved = self._is_unmoved
        return self._seen == self._present and is_unmoved()

    def end(self) -> None:
        """A closer look is needed from here on."""
        self._seen.clear()

    def memory(self) -> MomentMemory | None:
        """Return what somebody else can gather rows from."""
        state, source = self._state_words, self._source
        if state is None or source.words is None or not source.is_plain:
            return None
        words = np.concatenate([state, source.words])
        return MomentMemory(words=words, owners=source, is_current=self.is_current)


def _called_in(around: Callable[[Callable[[], None]], None], do: Callable[[], T]) -> T:
    """Return what `do` returns when `around` calls it."""
    results: list[T] = []
    around(lambda: results.append(do()))
    return results[-1]


def _check_settable(changed: Iterable[str]) -> None:
    names = [name for name in changed if not is_settable(name)]
    if names:
        raise _differs(
            f"{', '.join(names)} of the model has changed in mid-episode, which "
            "changes what the model consists of"
        )


def _differs(reason: str) -> PicturesDiffer:
    return PicturesDiffer(
        f"The picture of this moment cannot be made from the recorded state: {reason}. "
        'Record the environment\'s own pictures with render="live".'
    )


def _not_begun() -> ClosedError:
    return ClosedError("No episode is recorded: call begin_episode() first.")
