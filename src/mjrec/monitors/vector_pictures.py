# SPDX-License-Identifier: Apache-2.0
"""The pictures of a vector environment: of each sub-environment, and of all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..errors import InvalidArgument
from ..frames import Frame, check_frame, grid_frame, grid_shape
from ..recorder.subject import EpisodePictures

if TYPE_CHECKING:
    import gymnasium

_RGB_ARRAY = "rgb_array"


class VectorFrames:
    """What a vector environment's `render()` gives, asked once for each moment.

    Args:
        env: the vector environment.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> None:
        self._env = env
        self._frames: Sequence[Any] | None = None

    @property
    def render_mode(self) -> str | None:
        """The vector environment's render mode."""
        return self._env.render_mode

    def forget(self) -> None:
        """Take note that the environment has gone on."""
        self._frames = None

    def of(self, index: int) -> Any:
        """Return the picture of a sub-environment now, or the list of its pictures.

        Raises:
            InvalidArgument: there is not one for each sub-environment.
        """
        if self._frames is None:
            self._frames = self._drawn()
        return self._frames[index]

    def _drawn(self) -> Sequence[Any]:
        frames: Any = self._env.render()
        count = self._env.num_envs
        if not hasattr(frames, "__len__") or len(frames) != count:
            there = f"{len(frames)}" if hasattr(frames, "__len__") else repr(frames)
            raise InvalidArgument(
                f"render() of {type(self._env.unwrapped).__name__} must give a picture "
                f"for each of its {count} sub-environments, and gave {there}. Record "
                "without videos (video_callable=False), or put Monitor around each "
                "environment, inside the functions that make them."
            )
        return frames  # type: ignore[no-any-return]  # a sequence, as was seen


class OutsidePictures:
    """The pictures of one sub-environment, among those of all.

    Args:
        frames: of the vector environment.
        index: which sub-environment.
    """

    def __init__(self, frames: VectorFrames, index: int) -> None:
        self._frames = frames
        self._index = index

    @property
    def render_mode(self) -> str | None:
        """The vector environment's render mode."""
        return self._frames.render_mode

    def render(self) -> Any:
        """Return the picture of this moment, or the list of those since the last."""
        return self._frames.of(self._index)

    def facts(self) -> dict[str, Any]:
        """Return what the metadata of a video says about its pictures."""
        return {"pictures": "env.render", "quality": "full"}


class TilePictures:
    """The pictures of several sources, side by side.

    Args:
        sources: of the pictures, one for each sub-environment.

    Attributes:
        sources: the same.
        count: how many there are.
        shape: rows and columns of the grid.
    """

    def __init__(self, sources: Sequence[EpisodePictures]) -> None:
        self.sources = sources
        self.count = len(sources)
        self.shape = grid_shape(self.count)

    @property
    def render_mode(self) -> str | None:
        """`rgb_array` where all sources have it; None else."""
        modes = {source.render_mode for source in self.sources}
        return _RGB_ARRAY if modes == {_RGB_ARRAY} else None

    def render(self) -> Frame:
        """Return the picture of this moment.

        Raises:
            InvalidArgument: the pictures are not of one size, or one is none.
        """
        return grid_frame([check_frame(source.render()) for source in self.sources])

    def facts(self) -> dict[str, Any]:
        """Return what the metadata of a video says about its pictures."""
        rows, columns = self.shape
        return {
            **self.sources[0].facts(),
            "tiled": True,
            "rows": rows,
            "columns": columns,
        }
