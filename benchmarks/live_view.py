# SPDX-License-Identifier: Apache-2.0
"""Step times with and without a viewer: `python -m benchmarks.live_view`.

A monitor records HalfCheetah-v5. In every other round, a separate `mjrec view` process
serves the directory, and a client process requests new states and the list of episodes
without pausing. A real page pauses for four times as long as an answer took.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

import gymnasium
import numpy as np

import mjrec

from .setups import random_actions
from .step_times import times

STEPS = 40_000
ROUNDS = 5
GOAL = 0.95


@contextlib.contextmanager
def viewer(directory: str, answers: list[int]) -> Iterator[None]:
    """Serve a directory to a client that sends requests, for the duration of a block.

    Appends the number of answered pairs of requests to `answers`.
    """
    view = [sys.executable, "-m", "mjrec", "view", directory]
    with subprocess.Popen(view, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        url = server.stdout.readline().strip()
        page = [sys.executable, "-m", "benchmarks.live_view", url]
        with subprocess.Popen(page, stdout=subprocess.PIPE, text=True) as asking:
            assert asking.stdout is not None
            # Wait for the first answer, because the server loads the model for it.
            asking.stdout.readline()
            yield
            asking.kill()
            answers.append(len(asking.stdout.readlines()))
        server.kill()


def ask(url: str) -> None:
    """Request the episode list and the newest states repeatedly until killed."""
    address = urlsplit(url)
    token = parse_qs(address.query)["token"][0]
    known: dict[str, int] = {}
    while True:
        listed = answer(address.netloc, "/episodes", token)
        name = str(listed["episodes"][-1]["name"])
        first = known.get(name, 0)
        options = {"episode": name, "from": str(first)}
        told = answer(address.netloc, "/motion", token, **options)
        known[name] = first + told.get("chunk", {}).get("count", 0)
        print(name, known[name], flush=True)


def answer(host: str, page: str, token: str, **options: str) -> dict[str, Any]:
    """Send a request to the server and return the JSON answer."""
    query = urlencode({"token": token, **options})
    with urllib.request.urlopen(f"http://{host}{page}?{query}") as told:
        found: dict[str, Any] = json.loads(told.read())
    return found


def main() -> None:
    """Measure in alternating rounds and print the quantiles of all step times."""
    env = gymnasium.make("HalfCheetah-v5")
    actions = random_actions(env, STEPS)
    alone: list[int] = []
    viewed: list[int] = []
    answers: list[int] = []
    seconds = {"alone": 0.0, "viewed": 0.0}
    with tempfile.TemporaryDirectory() as folder:
        monitor = mjrec.Monitor(
            *(env, Path(folder) / "run", lambda episode: True),
            workers=0,
            allow_early_reset=True,
        )
        for _ in range(ROUNDS):
            began = time.perf_counter()
            alone += times(monitor, actions)[0]
            seconds["alone"] += time.perf_counter() - began
            with viewer(str(Path(folder) / "run"), answers):
                began = time.perf_counter()
                viewed += times(monitor, actions)[0]
                seconds["viewed"] += time.perf_counter() - began
        monitor.close(wait=False)
    for quantile in (5, 25, 50, 75):
        without, with_one = (np.percentile(t, quantile) / 1e3 for t in (alone, viewed))
        print(f"{quantile:3}% {without:8.1f}us {with_one:8.1f}us", end="   ")
        print(f"{without / with_one:.3f} of the speed (goal {GOAL})")
    ratio = seconds["alone"] / seconds["viewed"]
    print(f"whole rounds {ratio:.3f} of the speed; answered pairs: {answers}")


if __name__ == "__main__":
    ask(sys.argv[1]) if len(sys.argv) > 1 else main()
