# SPDX-License-Identifier: Apache-2.0
"""The live view: a local, read-only web server that shows a run in progress.

It reads the journal and row logs like any other reader, at a low priority and without
disturbing the monitor. A page polls for new states. After each response, it waits
several times as long as the response took.
"""

from __future__ import annotations

import contextlib
import hashlib
import html
import os
import secrets
import threading
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from ..errors import Error, InvalidArgument
from ..formats.locks import is_locked
from ..formats.monitor_directory import (
    episode_of,
    infix_of,
    lock_name,
    recording_directories,
)
from ..json_text import dumps
from ..results import iter_episodes
from ..simulation.trajectories import Trajectory, load_trajectory
from .episodes import recorded_episodes
from .geometry import linear
from .motion import FIXED_FIELDS, Shape, Stage
from .replay import (
    are_finite,
    ending_of,
    log_notes,
    motion_chunk,
    replay_page,
    title_of,
)

_ADDRESS = "127.0.0.1"
# Limits of one response; a page requests the rest later.
_MOST_STATES = 500
_MOST_EPISODES = 200
_MOST_POINTS = 1000


@dataclass
class _Shown:
    """The episode that was requested most recently, and the next state of its stage."""

    path: Path
    stage: Stage
    scene: str
    next: int = 0

    @property
    def scene_id(self) -> str:
        """An id shared by all episodes that the same page can show."""
        return _digest(self.scene.encode(), *map(str.encode, self.stage.passing))


class LiveView:
    """A web server that shows a directory's episodes to browsers on this machine.

    ::

        with LiveView("recordings/run1") as view:
            print(view.url)
            view.serve()  # until Ctrl-C, or `close` in another thread

    Args:
        directory: a directory with one or more monitors.
        port: the port to listen on; 0 for any free port.
        trust_models: see `load_trajectory`.

    Attributes:
        url: the page's URL. It includes a token; requests without it are refused.

    Raises:
        InvalidArgument: the directory does not exist, or the port cannot be used.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        port: int = 0,
        trust_models: bool = False,
    ) -> None:
        path = Path(directory)
        if not path.is_dir():
            raise InvalidArgument(f"The directory {path} does not exist.")
        self._token = secrets.token_urlsafe(24)
        self._directory = path
        self._trust_models = trust_models
        self._shown: _Shown | None = None
        self._logged: set[str] = set()
        # A page needs a node for whatever appears in any state, such as each segment
        # of a tendon, so all stages of a scene share what has been seen.
        self._passing: dict[str, dict[str, Shape]] = {}
        # Only one thread at a time may use MuJoCo's objects.
        self._lock = threading.Lock()
        try:
            self._server = ThreadingHTTPServer((_ADDRESS, port), self._handler())
        except (OSError, OverflowError) as error:
            raise InvalidArgument(
                f"Port {port} cannot be used ({error.args[-1]}). Omit the port to use "
                "any free port."
            ) from error
        self._server.daemon_threads = True
        self._has_served = False
        at = f"http://{_ADDRESS}:{self._server.server_port}"
        self.url = f"{at}/?token={self._token}"

    def serve(self) -> None:
        """Answer requests until `close` is called or Ctrl-C is pressed."""
        self._has_served = True
        self._server.serve_forever(poll_interval=0.1)

    def close(self) -> None:
        """Stop answering requests. Idempotent."""
        if self._has_served:
            # If `serve` was never called, `shutdown` would wait forever.
            self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        view = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                address = urlsplit(self.path)
                asked = {k: v[-1] for k, v in parse_qs(address.query).items()}
                token = asked.get("token", "").encode()
                if not secrets.compare_digest(token, view._token.encode()):
                    self.send_error(HTTPStatus.FORBIDDEN)
                    return
                kind = "text/html" if address.path == "/" else "application/json"
                try:
                    body = view._answer(address.path, asked)
                except (KeyError, ValueError):
                    self.send_error(HTTPStatus.NOT_FOUND)
                    return
                except (Error, OSError) as error:
                    # A file may disappear while it is being read; the page retries.
                    kind, body = "application/json", dumps({"error": str(error)})
                content = body.encode()
                self.send_response(HTTPStatus.OK)
                self.send_header("Content-Type", f"{kind}; charset=utf-8")
                self.send_header("Content-Length", str(len(content)))
                self.send_header("Cache-Control", "no-store")
                self.send_header("Referrer-Policy", "no-referrer")
                with contextlib.suppress(ConnectionError):
                    # The browser may have disconnected in the meantime.
                    self.end_headers()
                    self.wfile.write(content)

            def log_message(self, format: str, *args: Any) -> None:
                # Nothing is logged, because request URLs contain the token.
                pass

        return Handler

    def _answer(self, page: str, asked: dict[str, str]) -> str:
        """Return the response to a page's request.

        Raises:
            KeyError: the page or episode does not exist.
        """
        with self._lock:
            match page:
                case "/":
                    return self._page(asked.get("episode"))
                case "/episodes":
                    return dumps(self._episodes())
                case "/motion":
                    first = int(asked.get("from", "0"))
                    return dumps(self._motion(asked["episode"], first))
        raise KeyError(page)

    def _page(self, name: str | None) -> str:
        known = self._known()
        path = None if name is None else known[name]
        try:
            if not known:
                raise InvalidArgument("No episode has been recorded yet.")
            path = path or [*known.values()][-1]
            trajectory, shown = self._load(path)
        except Error as error:
            # An episode that has just begun has no state yet.
            return _WAITING.format(html.escape(str(error)))
        motion = shown.stage.motion(trajectory, np.arange(1))
        scene = shown.scene_id
        live = {"live": True, "episode": self._name(path), "scene": scene}
        return replay_page(trajectory, shown.stage, motion, additions=live)

    def _episodes(self) -> dict[str, Any]:
        ended = {}
        returns = []
        for place in recording_directories(self._directory):
            for episode in iter_episodes(place):
                returns.append(episode.reward)
                if episode.trajectory is not None:
                    ended[episode.trajectory] = episode
        paths = recorded_episodes(self._directory)
        are_of_one = len({infix_of(path.name) for path in paths}) <= 1
        listed = []
        for path in paths[-_MOST_EPISODES:]:
            number = str(episode_of(path.name))
            label = number if are_of_one else f"{infix_of(path.name)} {number}"
            entry: dict[str, Any] = {"name": self._name(path), "label": label}
            if (over := ended.get(path)) is not None:
                entry |= {"length": over.length, "return": over.reward}
            else:
                entry["running"] = _is_running(path)
            listed.append(entry)
        stride = max(1, -(-len(returns) // _MOST_POINTS))
        curve = returns[::stride]
        return {"episodes": listed, "count": len(returns), "returns": curve}

    def _motion(self, name: str, first: int) -> dict[str, Any]:
        trajectory, shown = self._load(self._known()[name], first)
        last = min(len(trajectory.states), first + _MOST_STATES)
        is_going_on = not trajectory.complete and _is_running(trajectory.path)
        told: dict[str, Any] = {
            "steps": len(trajectory),
            "next": max(first, last),
            "hasMore": last < len(trajectory.states),
            "title": title_of(trajectory),
            "ending": "" if is_going_on else ending_of(trajectory),
            "rgba": {s.name: linear(s.rgba) for s in shown.stage.shapes},
        }
        shown.next = max(first, last)
        steps = np.arange(first, last)
        steps = steps[are_finite(trajectory.states[first:last])]
        if len(steps):
            motion = shown.stage.motion(trajectory, steps)
            told["start"] = motion.target[0].tolist()
            told["chunk"] = motion_chunk(motion, keep_all=True)
        notes = [n for n in shown.stage.notes if n not in self._logged]
        log_notes(trajectory.path, notes)
        self._logged.update(notes)
        return {**told, "scene": shown.scene_id}

    def _name(self, path: Path) -> str:
        return str(path.relative_to(self._directory))

    def _known(self) -> dict[str, Path]:
        return {self._name(path): path for path in recorded_episodes(self._directory)}

    def _load(self, path: Path, first: int = 0) -> tuple[Trajectory, _Shown]:
        """Return a trajectory, and a stage for its states starting at `first`."""
        trajectory, shown = load_trajectory(path, trust_models=self._trust_models), None
        if self._shown is not None and self._shown.path == path:
            # A stage can only move forward through the states.
            shown = self._shown if 0 < self._shown.next <= first else None
        if shown is None:
            stage = Stage(trajectory)
            scene = _scene(trajectory, stage)
            stage.passing = self._passing.setdefault(scene, stage.passing)
            shown = _Shown(path, stage, scene)
        shown.next = first + 1
        self._shown = shown
        return trajectory, shown


def _scene(trajectory: Trajectory, stage: Stage) -> str:
    """Return an id of what a new stage shows in all states of its episode."""
    shapes = [(s.name, s.geom_type) for s in (*stage.shapes, *stage.soft)]
    facts = dumps([sorted(trajectory.facts["model"].items()), shapes])
    sizes = (getattr(stage.model, name).tobytes() for name in FIXED_FIELDS)
    return _digest(facts.encode(), *sizes)


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]


def _is_running(path: Path) -> bool:
    """Return whether the monitor that records an unfinished episode is still open."""
    return is_locked(path.parent / lock_name(infix_of(path.name) or ""))


_WAITING = (
    '<!doctype html><html lang="en"><head><meta charset="utf-8">'
    '<meta http-equiv="refresh" content="2"><title>mjrec view</title></head><body>'
    "<p>{} This page reloads every two seconds.</p>"
    "</body></html>"
)
