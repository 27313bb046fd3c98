# SPDX-License-Identifier: Apache-2.0
"""A report's HTML page, which opens from disk and needs no network.

Everything on the page may come from untrusted files. It is shown as text: escaped,
shortened if too long, with invisible characters spelled out. A content security policy
with the hashes of the page's own style and script prevents other code from running, and
allows only images and videos from disk.
"""

from __future__ import annotations

import base64
import hashlib
import math
import platform
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingDependency
from ..evaluation.statistics import PERCENTILE_BOOTSTRAP, Bootstrap, Interval
from ..evaluation.summaries import TaskSummary
from ..plain_text import counted, spelled_out
from .contents import ROLES, ReportContents, ReportTask, ReportVideo, outcomes
from .curves import SERIES, evaluation_curve, learning_curve, profile_curve
from .monitor_facts import SELECTION
from .page_text import NOTHING, address, decimals_for, interval_text, number, page_json

_LONGEST_NAME: Final = 120
_LONGEST_REASON: Final = 300
_LONGEST_COMMAND: Final = 8000

# Limits that keep the page fast in a browser: the number of rows in the episode table,
# which are only data until shown, and of players and figures, which are page elements.
_MOST_EPISODES: Final = 20_000
_MOST_PLAYERS: Final = 300
_MOST_FIGURES: Final = 120
_MOST_PROBLEMS: Final = 200

# See `contents.outcomes`.
_OUTCOMES: Final = ("", "terminated", "truncated", "terminated and truncated", "failed")
_SUCCESS: Final = {1: ", success", 0: ", no success", -1: ""}

_Pairs = Sequence[tuple[str, str]]


def page_of(contents: ReportContents) -> str:
    """Return a report's HTML page.

    The same contents yield the same HTML. If there are more than 20,000 episodes, the
    table contains only those with videos, those that failed, and each task's best and
    worst. A note says where to find the others.

    Raises:
        MissingDependency: Jinja2 is not installed.
    """
    environment = _environment()
    style, _, _ = environment.loader.get_source(environment, "report.css")
    script, _, _ = environment.loader.get_source(environment, "report.js")
    cards = _cards(contents)
    shown = {id(card["video"]) for card in cards}
    common, differing = _provenance(contents.tasks)
    how = contents.bootstrap
    methods = [_method(task.summary, how) for task in contents.tasks]
    usual = Counter(filter(None, methods)).most_common(1)
    intervals = usual[0][0] if usual else None
    count = sum(len(task.episodes) for task in contents.tasks)
    page: str = environment.get_template("report.html.j2").render(
        contents=contents,
        tasks=contents.tasks,
        made_with=f"mjrec {version('mjrec')}, Python {platform.python_version()}",
        version=version("mjrec"),
        style=style,
        script=script,
        style_hash=_hash(style),
        script_hash=_hash(script),
        most_problems=_MOST_PROBLEMS,
        bars=[_bar(task.summary) for task in contents.tasks],
        intervals=intervals,
        notes=_notes(contents.tasks, methods, intervals),
        percent=f"{how.confidence * 100:.4g}%",
        num_series=SERIES,
        method_of=lambda scores: _in_words(scores.interval_method, how),
        profile=_profile(contents),
        figures=list(_figures(contents.tasks)),
        most_figures=_MOST_FIGURES,
        cards=cards,
        roles=[role for role in ROLES if any(role in c["video"].roles for c in cards)],
        selection=_selection(contents.tasks),
        episodes=page_json(_episodes(contents, shown)),
        num_episodes=count,
        where_all=_where_all_are(contents.tasks) if count > _MOST_EPISODES else [],
        common=common,
        differing=differing,
    )
    return page + "\n"


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"sha256-{base64.b64encode(digest).decode()}"


@cache
def _environment() -> Any:
    try:
        # Imported here, because it is optional and only reports need it.
        import jinja2
    except ImportError as error:
        raise MissingDependency(
            "Jinja2", purpose="Writing a report", install="pip install 'mjrec[report]'"
        ) from error
    from markupsafe import Markup, escape

    def shown(value: Any) -> Any:
        """Return a template value, with untrusted strings made safe to show."""
        is_text = isinstance(value, str) and not isinstance(value, Markup)
        return spelled_out(value) if is_text else value

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("mjrec.reporting"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=shown,
    )
    environment.filters.update(
        name=lambda text: spelled_out(text, _LONGEST_NAME),
        # A name with optional line breaks after each `/`.
        broken=lambda text: escape(spelled_out(text, _LONGEST_NAME)).replace(
            "/", Markup("/<wbr>")
        ),
        command=lambda text: escape(spelled_out(text, _LONGEST_COMMAND)),
        # Not shortened: a `data:` URL contains a whole video.
        address=lambda path: escape(address(path)),
        number=number,
        interval=interval_text,
        share=lambda value: NOTHING if value is None else f"{value * 100:.0f}%",
        sorted_by=lambda v: "" if v is None or math.isnan(v) else repr(float(v)),
    )
    environment.globals.update(decimals_of=_decimals_of, counted=counted)
    return environment


def _decimals_of(task: ReportTask) -> int:
    return decimals_for((task.summary.minimum, task.summary.maximum))


# --- The summary ------------------------------------------------------------------


def _bar(summary: TaskSummary) -> dict[str, Any] | None:
    """Return a task's returns as percentages of its scale; None if it has no scale."""
    scale = summary.score_range
    mean, minimum, maximum = summary.mean, summary.minimum, summary.maximum
    if scale is None or not scale[0] < scale[1]:
        return None
    if mean is None or minimum is None or maximum is None:
        return None
    interval = summary.mean_interval or Interval(mean, mean)
    values = (minimum, maximum, interval.low, interval.high, mean)
    places = [100 * (value - scale[0]) / (scale[1] - scale[0]) for value in values]
    low, high, from_, to, middle = (min(100.0, max(0.0, place)) for place in places)
    return {
        "low": f"{low:.2f}",
        "spread": f"{high - low:.2f}",
        "from": f"{from_:.2f}",
        "interval": f"{max(to - from_, 0.8):.2f}",
        "mean": f"{middle:.2f}",
        "words": f"on a scale from {number(scale[0], 0)} to {number(scale[1], 0)}",
    }


def _method(summary: TaskSummary, how: Bootstrap) -> str | None:
    """Return the method for a task's intervals; None if there are none."""
    if summary.mean_interval is None and summary.iqm_interval is None:
        return None
    return _in_words(summary.interval_method or PERCENTILE_BOOTSTRAP, how)


def _in_words(method: str | None, how: Bootstrap) -> str | None:
    if method != PERCENTILE_BOOTSTRAP:
        return method
    resamples = counted(how.resamples, "resample")
    return f"{method} over episodes, {resamples}, seed {how.seed}"


def _notes(
    tasks: Iterable[ReportTask], methods: Iterable[str | None], usual: str | None
) -> dict[str, list[str]]:
    """Return notes about missing or different statistics, each with affected tasks."""
    notes: dict[str, list[str]] = {}
    for task, method in zip(tasks, methods, strict=True):
        if count := task.summary.not_finite:
            of = counted(task.summary.episodes, "return")
            what = "is not finite" if count == 1 else "are not finite"
            words = f"No figures for the returns: {number(count, 0)} of {of} {what}"
            notes.setdefault(words, []).append(task.name)
        if method not in (None, usual):
            words = f"Intervals by a different method, {method}"
            notes.setdefault(words, []).append(task.name)
    return notes


# --- Figures ----------------------------------------------------------------------


def _profile(contents: ReportContents) -> str:
    if all(each.profile is None for each in contents.across.values()):
        return ""
    # Names become part of the figure's description, so spell out invisible characters.
    across = {spelled_out(name): each for name, each in contents.across.items()}
    return profile_curve(across, key="profile")


def _figures(tasks: Sequence[ReportTask]) -> Iterator[tuple[str, str]]:
    """Yield each task's name and its figure."""
    for index, task in enumerate(tasks[:_MOST_FIGURES]):
        if np.isfinite(task.episodes["total_reward"]).any():
            draw = evaluation_curve if task.is_evaluation else learning_curve
            named = replace(task, name=spelled_out(task.name, _LONGEST_NAME))
            yield task.name, draw(named, key=f"figure-{index}")


# --- The gallery ------------------------------------------------------------------


def _cards(contents: ReportContents) -> list[dict[str, Any]]:
    """Return the cards for the displayed videos.

    The order is by task, then best, median, worst, and all others.
    """
    tasks = [i for i, task in enumerate(contents.tasks) for _ in task.videos]
    videos = contents.videos

    def place(index: int) -> tuple[int, int, int]:
        role = min(map(ROLES.index, videos[index].roles), default=len(ROLES))
        return tasks[index], role, index

    shown = sorted(range(len(videos)), key=lambda index: not videos[index].roles)
    return [
        _card(index, videos[index], tasks[index], contents)
        for index in sorted(shown[:_MOST_PLAYERS], key=place)
    ]


def _card(
    index: int, video: ReportVideo, number_of_task: int, contents: ReportContents
) -> dict[str, Any]:
    """Return the gallery card of a video, with the facts about its episode."""
    task, which, reward = contents.tasks[number_of_task], "", None
    facts: list[tuple[str, str]] = []
    if video.index is not None:
        episode = task.episodes[video.index]
        reward = float(episode["total_reward"])
        run = int(episode["seed"])
        where = f"run {task.runs[run]}" if task.runs else f"seed {run}"
        which = f"{where}, episode {episode['episode']}"
        outcome = _OUTCOMES[outcomes(task)[video.index]]
        success = _SUCCESS[int(episode["success"])]
        facts += [
            ("Episode", which),
            ("Length", counted(int(episode["length"]), "step")),
            ("Outcome", outcome and outcome + success),
        ]
    size = ""
    if video.width is not None and video.height is not None:
        size = f"{video.width} × {video.height}"  # noqa: RUF001  a sign for people
    plays = "" if video.seconds is None else f"{video.seconds:.1f} s"
    facts += [
        ("Camera", video.camera or ""),
        ("Video", ", ".join(filter(None, (size, plays)))),
    ]
    return {
        "number": index,
        "task": number_of_task,
        "task_name": task.name,
        "video": video,
        "label": ", ".join(filter(None, (task.name, which, video.camera))),
        "total_reward": number(reward, _decimals_of(task)),
        "facts": [(label, value) for label, value in facts if value],
        "failure": None if video.index is None else task.failures.get(video.index),
    }


def _selection(tasks: Iterable[ReportTask]) -> list[str]:
    """Return the rules that chose the episodes for videos, from the provenance."""
    said = (pair for task in tasks for pair in task.provenance)
    rules = (value for label, value in said if label == SELECTION)
    return list(dict.fromkeys(rules))[:10]


# --- The table of episodes --------------------------------------------------------


def _episodes(contents: ReportContents, shown: set[int]) -> dict[str, Any]:
    """Return the data for the table of episodes, as columns.

    Args:
        contents: the report's contents.
        shown: the `id()` of each video that has a card.
    """
    places = {
        id(video): f"#video-{i}"
        if id(video) in shown
        else video.file and address(video.file)
        for i, video in enumerate(contents.videos)
    }
    total = sum(len(task.episodes) for task in contents.tasks)
    most = None
    if total > _MOST_EPISODES:
        most = max(5, _MOST_EPISODES // (4 * len(contents.tasks)))
    tasks = []
    for task in contents.tasks:
        videos: dict[int, list[str]] = {}
        for video in task.videos:
            if video.index is not None and (place := places[id(video)]):
                videos.setdefault(video.index, []).append(place)
        tasks.append(_columns(task, _most_telling(task, videos, most), videos))
    return {"outcomes": _OUTCOMES, "tasks": tasks}


def _most_telling(
    task: ReportTask, videos: Mapping[int, object], most: int | None
) -> NDArray[np.intp]:
    """Return the indices of episodes that have videos, failed, or are best or worst.

    Args:
        task: the task.
        videos: the task's videos, keyed by episode index.
        most: maximum number of each kind; None means all episodes.
    """
    if most is None:
        return np.arange(len(task.episodes))
    returns = task.episodes["total_reward"]
    order = np.argsort(returns, kind="stable")[: np.isfinite(returns).sum()]
    with_videos = np.array(sorted(videos)[:most], np.intp)
    failed = np.array(sorted(task.failures)[:most], np.intp)
    return np.unique(np.concatenate((order[:most], order[-most:], with_videos, failed)))


def _columns(
    task: ReportTask, rows: NDArray[np.intp], videos: Mapping[int, list[str]]
) -> dict[str, Any]:
    decimals = _decimals_of(task)
    at = {int(row): i for i, row in enumerate(rows)}
    chosen = task.episodes[rows]
    return {
        "name": spelled_out(task.name, _LONGEST_NAME),
        "decimals": decimals,
        "runs": [spelled_out(run, _LONGEST_NAME) for run in task.runs] or None,
        "run": chosen["seed"].tolist(),
        "episode": chosen["episode"].tolist(),
        "length": chosen["length"].tolist(),
        "outcome": outcomes(task)[rows].tolist(),
        "success": chosen["success"].tolist(),
        "total_reward": _json_numbers(chosen["total_reward"], decimals),
        "failures": {
            at[i]: spelled_out(reason, _LONGEST_REASON)
            for i, reason in sorted(task.failures.items())
            if i in at
        },
        "videos": {at[i]: places for i, places in sorted(videos.items()) if i in at},
    }


def _json_numbers(values: NDArray[np.float64], decimals: int) -> list[float | None]:
    """Return numbers with two more decimals than displayed, for correct sorting.

    NaN and infinite numbers become None.
    """
    # Larger numbers have no decimals, and rounding would make them overflow.
    small = np.abs(values) < 1e15
    rounded = np.where(
        small, np.round(np.where(small, values, 0), decimals + 2), values
    )
    return [value if math.isfinite(value) else None for value in rounded.tolist()]


def _where_all_are(tasks: Iterable[ReportTask]) -> list[str]:
    """Return, for each directory, the file or call that provides all its episodes."""
    places = (
        f"{task.source.rstrip('/')}/results.csv"
        if task.is_evaluation
        else f"mjrec.load_results({task.source!r})"
        for task in tasks
    )
    return list(dict.fromkeys(places))[:20]


# --- Provenance -------------------------------------------------------------------


def _provenance(tasks: Sequence[ReportTask]) -> tuple[_Pairs, list[tuple[str, _Pairs]]]:
    """Return the pairs that all tasks share, and the other pairs keyed by task."""
    said = [list(task.provenance) for task in tasks]
    everywhere = set.intersection(*map(set, said)) if said else set()
    differing = [
        (task.name, [pair for pair in pairs if pair not in everywhere])
        for task, pairs in zip(tasks, said, strict=True)
    ]
    common = [pair for pair in said[0] if pair in everywhere] if said else []
    return common, [(name, pairs) for name, pairs in differing if pairs]
