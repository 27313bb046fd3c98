# SPDX-License-Identifier: Apache-2.0
"""The page of a report: one HTML text that opens from the disk and needs no network.

All that it shows may come from files of strangers. It is shown as text: escaped, cut
where it is long, and with what nobody sees (control characters, marks that turn the
direction of writing) spelled out. A content security policy with the hashes of the
page's own style and script lets nothing else run, and nothing be loaded but pictures
and videos from the disk.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingDependency
from ..evaluation.statistics import PERCENTILE_BOOTSTRAP, Bootstrap, Interval
from ..evaluation.summaries import AcrossTasks, TaskSummary
from .contents import EpisodeColumns, ReportContents, ReportTask, ReportVideo, Verdict
from .curves import SERIES, evaluation_curve, learning_curve, profile_curve
from .numbers import NOTHING, decimals_for, number, whole_number

_TEMPLATES: Final = Path(__file__).parent / "templates"

# Of a text that is a name, a reason, or a command line.
_LONGEST_NAME: Final = 120
_LONGEST_TEXT: Final = 1000
_LONGEST_COMMAND: Final = 8000

# What a browser opens at once: rows of the table of episodes, which are numbers until
# they are shown, and players and figures, which are elements of the page.
_MOST_EPISODES: Final = 20_000
_MOST_PLAYERS: Final = 300
_MOST_FIGURES: Final = 120
_MOST_PROBLEMS: Final = 200

# Spaces between figures, which are no stranger's trick, and the ends of lines.
_SEEN: Final = "\n\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}"

_ROLES: Final = ("best", "median", "worst")
_OUTCOMES: Final = (
    "",
    "terminated",
    "truncated",
    "terminated and truncated",
    "failed",
)
_SELECTION: Final = "selection"


def page_of(contents: ReportContents, *, curves: bool = True) -> str:
    """Return the page of a report.

    The same contents give the same text. Where there are more than 20,000 episodes, the
    page's table holds those with videos, those that failed, and each task's best and
    worst, and says where all of them are.

    Args:
        contents: what it shows.
        curves: whether figures are drawn, which needs matplotlib.

    Raises:
        MissingDependency: there is no Jinja2, or no matplotlib.
    """
    style, script = _text_of("report.css"), _text_of("report.js")
    rendered: str = _template().render(
        **_page(contents, curves=curves),
        style=_Own(style),
        script=_Own(script),
        style_hash=_Own(_hash(style)),
        script_hash=_Own(_hash(script)),
    )
    return rendered + "\n"


class _Own(str):
    """Markup that this module has made itself."""

    __slots__ = ()

    def __html__(self) -> str:
        return self


class _Url(str):
    """An address that this module has encoded, however long it is."""

    __slots__ = ()


@cache
def _text_of(name: str) -> str:
    return (_TEMPLATES / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"sha256-{base64.b64encode(digest).decode()}"


@cache
def _template() -> Any:
    try:
        # Here, because it is an extra: nothing else of the package needs it.
        import jinja2
    except ImportError as error:
        raise MissingDependency(
            "Jinja2",
            purpose="Writing a report",
            install="pip install 'mjrec[report]'",
        ) from error
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_shown,
    )
    environment.filters["name"] = lambda text: _spelled_out(text, _LONGEST_NAME)
    environment.filters["broken"] = _broken
    environment.filters["grouped"] = whole_number
    environment.filters["command"] = lambda text: _spelled_out(text, _LONGEST_COMMAND)
    return environment.get_template("report.html.j2")


class _Cut(str):
    """A text that is to be escaped, and has been cut."""

    __slots__ = ()


def _shown(value: Any) -> Any:
    """Return what a template is to show, with texts of strangers as they may stand."""
    if not isinstance(value, str) or isinstance(value, (_Cut, _Url)):
        return value
    if hasattr(value, "__html__"):  # our own, or what a macro has escaped
        return value
    return _spelled_out(value, _LONGEST_TEXT)


def _spelled_out(text: str, longest: int) -> _Cut:
    """Return a text with what nobody sees spelled out, and cut where it is long."""
    if len(text) > longest:
        text = text[:longest] + "…"
    if text.isprintable():
        return _Cut(text)
    return _Cut("".join(c if _is_seen(c) else f"\\u{ord(c):04x}" for c in text))


def _broken(name: str) -> _Own:
    """Return a name that may go on in the next line after each `/`."""
    return _Own(escape(_spelled_out(name, _LONGEST_NAME)).replace("/", "/<wbr>"))


def _is_seen(character: str) -> bool:
    return character.isprintable() or character in _SEEN


def _page(contents: ReportContents, *, curves: bool) -> dict[str, Any]:
    """Return what the template shows."""
    cards, players = _cards(contents)
    tasks = contents.tasks
    common, differing = _provenance(tasks)
    return {
        "title": contents.title,
        "version": version("mjrec"),
        "subtitle": _subtitle(contents),
        "problems": list(contents.problems[:_MOST_PROBLEMS]),
        "problems_left_out": len(contents.problems[_MOST_PROBLEMS:]),
        "verdicts": [_verdict(verdict) for verdict in contents.verdicts],
        "rows": [_row(task.summary, task.name) for task in tasks],
        "has_bars": any(_scale(task.summary) for task in tasks),
        "has_success_intervals": any(task.summary.success_interval for task in tasks),
        "has_successes": any(task.summary.success_known for task in tasks),
        "has_warnings": any(task.summary.warnings for task in tasks),
        "intervals": _words_of(_usual_method(contents), contents.bootstrap),
        "notes": list(_notes(contents)),
        "percent": f"{contents.bootstrap.confidence * 100:.4g}\N{NO-BREAK SPACE}%",
        "across": [
            _across(name, told, i, contents)
            for i, (name, told) in enumerate(contents.across.items())
        ],
        "profile": _profile(contents) if curves else None,
        "figures": list(_figures(tasks)) if curves else [],
        "words_of_figures": [
            _WORDS_OF_FIGURES[kind]
            for kind in (True, False)
            if any(task.is_evaluation is kind for task in tasks)
        ],
        "figures_left_out": len(tasks[_MOST_FIGURES:]) if curves else 0,
        "cards": cards,
        "players_left_out": len(contents.videos) - players,
        "roles": [role for role in _ROLES if any(role in c.roles for c in cards)],
        "tasks_with_videos": _tasks_with_videos(contents, cards),
        "selection": _selection(tasks),
        "episodes": _own_json(_episodes(contents, cards)),
        "num_episodes": whole_number(_count(tasks)),
        "not_all": _count(tasks) > _MOST_EPISODES,
        "where_all": _where_all_are(tasks),
        "task_names": [task.name for task in tasks],
        "common": common,
        "differing": differing,
        "made_with": [(name, str(v)) for name, v in contents.made_with.items()],
    }


def _count(tasks: Iterable[ReportTask]) -> int:
    return sum(len(task.episodes.episode) for task in tasks)


def _plural(count: int, what: str) -> str:
    return f"{whole_number(count)} {what}{'' if count == 1 else 's'}"


def _subtitle(contents: ReportContents) -> str:
    tasks = contents.tasks
    parts = [_plural(len(tasks), "task"), _plural(_count(tasks), "episode")]
    if failed := sum(task.summary.failed for task in tasks):
        parts.append(f"{failed} of them failed")
    parts.append(_plural(len(contents.videos), "video"))
    return ", ".join(parts)


# --- The summary ------------------------------------------------------------------


class _Figure(NamedTuple):
    """A number, as it is shown and as it is sorted by."""

    text: str
    value: str
    interval: str = ""


class _Bar(NamedTuple):
    """Returns on their scale, in percent of it."""

    low: str
    spread: str
    from_: str
    interval: str
    mean: str
    words: str


class _Row(NamedTuple):
    """A task's line in the summary."""

    name: str
    mean: _Figure
    std: _Figure
    iqm: _Figure
    median: _Figure
    minimum: _Figure
    maximum: _Figure
    success: _Figure
    episodes: int
    runs: int
    failed: int
    warnings: str
    num_warnings: int
    bar: _Bar | None


def _row(summary: TaskSummary, name: str) -> _Row:
    decimals = decimals_for((summary.minimum, summary.maximum))
    share = summary.success_rate

    def figure(value: float | None, interval: Interval | None = None) -> _Figure:
        return _Figure(
            number(value, decimals), _sorted_by(value), _interval(interval, decimals)
        )

    return _Row(
        name=name,
        mean=figure(summary.mean, summary.mean_interval),
        std=figure(summary.std),
        iqm=figure(summary.iqm, summary.iqm_interval),
        median=figure(summary.median),
        minimum=figure(summary.minimum),
        maximum=figure(summary.maximum),
        success=_Figure(
            NOTHING if share is None else _percent(share),
            _sorted_by(share),
            _success_interval(summary),
        ),
        episodes=summary.episodes,
        runs=summary.runs,
        failed=summary.failed,
        warnings=", ".join(f"{kind} {n}" for kind, n in summary.warnings.items()),
        num_warnings=sum(summary.warnings.values()),
        bar=_bar(summary, decimals),
    )


def _sorted_by(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else repr(float(value))


def _interval(interval: Interval | None, decimals: int) -> str:
    if interval is None:
        return ""
    return f"{number(interval.low, decimals)} to {number(interval.high, decimals)}"


def _percent(share: float) -> str:
    return f"{share * 100:.0f}\N{NO-BREAK SPACE}%"


def _success_interval(summary: TaskSummary) -> str:
    interval = summary.success_interval
    if interval is None:
        return ""
    return f"{interval.low * 100:.0f} to {_percent(interval.high)}"


def _scale(summary: TaskSummary) -> tuple[float, float] | None:
    """Return the scale of a task whose returns can be drawn on one."""
    scale = summary.score_range
    if scale is None or summary.mean is None or not scale[0] < scale[1]:
        return None
    return scale


def _bar(summary: TaskSummary, decimals: int) -> _Bar | None:
    scale = _scale(summary)
    if scale is None or summary.minimum is None or summary.maximum is None:
        return None
    assert summary.mean is not None

    def place(value: float) -> float:
        return min(100.0, max(0.0, 100 * (value - scale[0]) / (scale[1] - scale[0])))

    interval = summary.mean_interval or Interval(summary.mean, summary.mean)
    low, high = place(summary.minimum), place(summary.maximum)
    from_, to = place(interval.low), place(interval.high)
    return _Bar(
        low=f"{low:.2f}",
        spread=f"{high - low:.2f}",
        from_=f"{from_:.2f}",
        interval=f"{max(to - from_, 0.8):.2f}",
        mean=f"{place(summary.mean):.2f}",
        words=f"on a scale from {number(scale[0], 0)} to {number(scale[1], 0)}",
    )


def _usual_method(contents: ReportContents) -> str | None:
    """Return how most tasks' intervals were made; None where there are none."""
    methods = [_method(task.summary) for task in contents.tasks]
    counted = Counter(method for method in methods if method is not None)
    return max(counted, key=counted.__getitem__, default=None)


def _method(summary: TaskSummary) -> str | None:
    if summary.mean_interval is None and summary.iqm_interval is None:
        return None
    return summary.interval_method or PERCENTILE_BOOTSTRAP


def _words_of(method: str | None, bootstrap: Bootstrap) -> str | None:
    """Return how intervals were made, with what that method depends on."""
    if method != PERCENTILE_BOOTSTRAP:
        return method
    resamples = f"{whole_number(bootstrap.resamples)} resamples"
    return f"{method} over episodes, {resamples}, seed {bootstrap.seed}"


class _Note(NamedTuple):
    """What is to be said of the figures of some tasks."""

    words: str
    tasks: Sequence[str]


def _notes(contents: ReportContents) -> Iterator[_Note]:
    """Yield why figures are missing, and where intervals were made in another way."""
    for task in contents.tasks:
        if count := task.summary.not_finite:
            of = _plural(task.summary.episodes, "return")
            what = "is no finite number" if count == 1 else "are no finite numbers"
            yield _Note(
                f"No figures of the returns: {whole_number(count)} of {of} {what}",
                [task.name],
            )
    usual = _usual_method(contents)
    others: dict[str, list[str]] = {}
    for task in contents.tasks:
        method = _method(task.summary)
        if method is not None and method != usual:
            others.setdefault(method, []).append(task.name)
    for method, names in others.items():
        words = _words_of(method, contents.bootstrap)
        yield _Note(f"Intervals by another method, {words}", names)


# --- All tasks together, and figures ----------------------------------------------


class _Across(NamedTuple):
    """What is said of all tasks of one evaluation."""

    name: str
    series: int
    tiles: Sequence[tuple[str, str, str]]
    left_out: Sequence[tuple[str, str]]
    method: str | None


def _across(
    name: str, told: AcrossTasks, index: int, contents: ReportContents
) -> _Across:
    tiles = [
        ("Interquartile mean", _score(told.iqm), _interval(told.iqm_interval, 3)),
        (
            "Optimality gap",
            _score(told.optimality_gap),
            _interval(told.optimality_gap_interval, 3),
        ),
        ("Median of tasks", _score(told.median), ""),
        ("Mean of tasks", _score(told.mean), ""),
        ("Tasks", str(len(told.tasks)), ""),
    ]
    is_usual = told.interval_method == _usual_method(contents)
    method = _words_of(told.interval_method, contents.bootstrap)
    return _Across(
        name,
        index % SERIES,
        tiles,
        list(told.left_out.items()),
        None if is_usual else method,
    )


def _score(value: float | None) -> str:
    return number(value, 3)


def _profile(contents: ReportContents) -> _Own | None:
    if all(told.profile is None for told in contents.across.values()):
        return None
    return _Own(profile_curve(contents.across, key="profile"))


def _figures(tasks: Sequence[ReportTask]) -> Iterator[tuple[str, _Own]]:
    """Yield each task's name and its figure."""
    for index, task in enumerate(tasks[:_MOST_FIGURES]):
        if not np.isfinite(task.episodes.total_reward).any():
            continue
        draw = evaluation_curve if task.is_evaluation else learning_curve
        # The description is part of the figure, and what it says is no markup.
        named = _with_name(task, _spelled_out(task.name, _LONGEST_NAME))
        yield task.name, _Own(draw(named, key=f"figure-{index}"))


_WORDS_OF_FIGURES: Final = {
    True: "Evaluations: each dot is an episode, each short line a seed's mean, and "
    "the long one the mean of all with its interval. On the right, the share of "
    "episodes that reach a return.",
    False: "Recordings: the mean of episodes in a row, and the range of the middle "
    "80\N{NO-BREAK SPACE}% of them; where episodes are few, each is a dot.",
}


def _with_name(task: ReportTask, name: str) -> ReportTask:
    return ReportTask(
        name=name,
        source=task.source,
        is_evaluation=task.is_evaluation,
        summary=task.summary,
        episodes=task.episodes,
    )


# --- The gallery ------------------------------------------------------------------


class _Card(NamedTuple):
    """A video, as the gallery shows it."""

    number: int
    task: int
    task_name: str
    roles: Sequence[str]
    is_video: bool
    is_embedded: bool
    url: _Url | None
    poster: _Url | None
    width: int | None
    height: int | None
    name: str
    label: str
    total_reward: str
    facts: Sequence[tuple[str, str]]
    sha256: str | None
    command: str | None
    notes: Sequence[str]
    failure: str | None


def _cards(contents: ReportContents) -> tuple[list[_Card], int]:
    """Return the cards of the videos that are shown, and how many those are.

    For each task the best comes first, then the median, the worst, and the others.
    """
    videos = list(enumerate(contents.videos))
    if len(videos) > _MOST_PLAYERS:
        videos = sorted(videos, key=lambda pair: not pair[1].roles)[:_MOST_PLAYERS]
    videos.sort(key=lambda pair: (pair[1].task, _place_of_roles(pair[1]), pair[0]))
    cards = [_card(i, video, contents.tasks[video.task]) for i, video in videos]
    return cards, len(cards)


def _place_of_roles(video: ReportVideo) -> int:
    known = [_ROLES.index(role) for role in video.roles if role in _ROLES]
    return min(known, default=len(_ROLES))


def _card(index: int, video: ReportVideo, task: ReportTask) -> _Card:
    columns, at = task.episodes, video.index
    decimals = decimals_for((task.summary.minimum, task.summary.maximum))
    reward = None if at is None else float(columns.total_reward[at])
    which = "" if at is None else _which(task, at)
    url = _url(video.file, "video") if video.file else None
    return _Card(
        number=index,
        task=video.task,
        task_name=task.name,
        roles=[role for role in _ROLES if role in video.roles],
        is_video=not video.file.endswith(".json"),
        is_embedded=url is not None and url.startswith("data:"),
        url=url,
        poster=None if video.poster is None else _url(video.poster, "image"),
        width=video.width,
        height=video.height,
        name=video.name,
        label=", ".join(filter(None, (task.name, which, video.camera))),
        total_reward=number(reward, decimals),
        facts=list(_facts(video, task)),
        sha256=video.sha256,
        command=video.command,
        notes=[_readable(note) for note in video.notes],
        failure=None if at is None else columns.failures.get(at),
    )


def _which(task: ReportTask, index: int) -> str:
    columns = task.episodes
    run = int(columns.run[index])
    where = f"seed {run}" if columns.runs is None else f"run {columns.runs[run]}"
    return f"{where}, episode {int(columns.episode[index])}"


def _facts(video: ReportVideo, task: ReportTask) -> Iterator[tuple[str, str]]:
    """Yield what is to be known of a video, beside its return."""
    columns, at = task.episodes, video.index
    if at is not None:
        yield "Episode", _which(task, at)
        yield "Length", _plural(int(columns.length[at]), "step")
        if outcome := _OUTCOMES[int(columns.outcome[at])]:
            yield "Outcome", outcome + _success_words(int(columns.success[at]))
    if video.camera is not None:
        yield "Camera", video.camera
    size = ""
    if video.width is not None and video.height is not None:
        size = f"{video.width} × {video.height}"  # noqa: RUF001  a sign for people
    plays = "" if video.seconds is None else f"{video.seconds:.1f} s"
    if told := ", ".join(filter(None, (size, plays))):
        yield "Video", told


def _success_words(success: int) -> str:
    return {1: ", success", 0: ", no success"}.get(success, "")


_DATA: Final = re.compile(r"data:(video|image)/[a-z0-9.+-]+;base64,[A-Za-z0-9+/=]*")


def _url(path: str, kind: str) -> _Url:
    """Return the address of a file beside the page, whatever its name looks like."""
    if path.startswith(f"data:{kind}/") and _DATA.fullmatch(path):
        return _Url(path)
    # So that neither `javascript:x` nor `//host/x` is more than a file's name.
    return _Url(
        "./" + quote(path.removeprefix("./"), safe="/", errors="surrogateescape")
    )


def _tasks_with_videos(
    contents: ReportContents, cards: Sequence[_Card]
) -> list[tuple[int, str]]:
    indices = dict.fromkeys(card.task for card in cards)
    return [(i, contents.tasks[i].name) for i in sorted(indices)]


def _selection(tasks: Sequence[ReportTask]) -> list[str]:
    """Return the rules by which episodes got a video, as the provenance states them."""
    rules = {
        _readable(value): None
        for task in tasks
        for label, value in task.provenance
        if _SELECTION in label.casefold()
    }
    return list(rules)[:10]


_CHOICE: Final = r"(?:best|median|worst|failures)(?::\d+)?"
_CHOICES: Final = re.compile(rf"\b({_CHOICE}),(?={_CHOICE}\b)")


def _readable(rule: str) -> str:
    """Return what is said of a rule of selection, with its parts apart."""
    return _CHOICES.sub(r"\1, ", rule)


# --- The table of episodes --------------------------------------------------------


def _episodes(contents: ReportContents, cards: Sequence[_Card]) -> dict[str, Any]:
    """Return the columns of the episodes that the page can show."""
    shown = {card.number for card in cards}
    places = {
        i: f"#video-{i}" if i in shown else _url(video.file, "video")
        for i, video in enumerate(contents.videos)
        if i in shown or video.file
    }
    choose = _chooser(contents.tasks)
    return {
        "outcomes": _OUTCOMES,
        "tasks": [_columns(task, choose(task), places) for task in contents.tasks],
    }


def _chooser(tasks: Sequence[ReportTask]) -> Callable[[ReportTask], NDArray[np.intp]]:
    if _count(tasks) <= _MOST_EPISODES:
        return lambda task: np.arange(len(task.episodes.episode))
    each = max(5, _MOST_EPISODES // (4 * len(tasks)))
    return lambda task: _most_telling(task.episodes, each)


def _most_telling(columns: EpisodeColumns, each: int) -> NDArray[np.intp]:
    """Return which episodes have a video or failed, and the best and the worst."""
    order = np.argsort(columns.total_reward, kind="stable")
    order = order[: np.isfinite(columns.total_reward).sum()]
    with_videos = np.array(sorted(columns.videos)[:each], np.intp)
    failed = np.flatnonzero(columns.outcome == _OUTCOMES.index("failed"))[:each]
    return np.unique(np.concatenate((order[:each], order[-each:], with_videos, failed)))


def _columns(
    task: ReportTask, rows: NDArray[np.intp], places: dict[int, str]
) -> dict[str, Any]:
    columns = task.episodes
    decimals = decimals_for((task.summary.minimum, task.summary.maximum))
    at = {int(row): i for i, row in enumerate(rows)}
    return {
        "name": _spelled_out(task.name, _LONGEST_NAME),
        "decimals": decimals,
        "runs": None if columns.runs is None else _names(columns.runs),
        "run": columns.run[rows].tolist(),
        "episode": columns.episode[rows].tolist(),
        "total_reward": _json_numbers(columns.total_reward[rows], decimals),
        "length": columns.length[rows].tolist(),
        "outcome": columns.outcome[rows].tolist(),
        "success": columns.success[rows].tolist(),
        "failures": {
            at[i]: _spelled_out(reason, 300)
            for i, reason in sorted(columns.failures.items())
            if i in at
        },
        "videos": {
            at[i]: [places[video] for video in videos if video in places]
            for i, videos in sorted(columns.videos.items())
            if i in at
        },
    }


def _names(names: Iterable[str]) -> list[str]:
    return [_spelled_out(name, _LONGEST_NAME) for name in names]


def _json_numbers(values: NDArray[np.float64], decimals: int) -> list[float | None]:
    """Return numbers with two decimals more than are shown, so that they sort well."""
    rounded = values.copy()
    # Larger ones have no decimals, and rounding would multiply them.
    small = np.abs(values) < 1e15
    rounded[small] = np.round(values[small], decimals + 2)
    return [value if math.isfinite(value) else None for value in rounded.tolist()]


_SPECIAL: Final = {ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}


def _own_json(value: Any) -> _Own:
    """Return JSON that cannot end the element which it stands in."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    return _Own(text.translate(_SPECIAL))


def _where_all_are(tasks: Sequence[ReportTask]) -> list[str]:
    """Return, for each directory, where all of its episodes are to be found."""
    sources = {task.source: task.is_evaluation for task in tasks}
    return [
        f"{source.rstrip('/')}/results.csv"
        if is_evaluation
        else f"mjrec.load_results({source!r})"
        for source, is_evaluation in sources.items()
    ][:20]


# --- Where it comes from ----------------------------------------------------------


class _Verdict(NamedTuple):
    """A verification, as the page shows it."""

    source: str
    words: str
    style: str
    counts: str
    level: str


def _verdict(verdict: Verdict) -> _Verdict:
    return _Verdict(
        source=verdict.source,
        words="Verified" if verdict.passed else "Does not hold",
        style="pass" if verdict.passed else "fail",
        counts=", ".join(f"{count} {what}" for what, count in verdict.counts.items()),
        level=verdict.level,
    )


_Pairs = Sequence[tuple[str, str]]


def _provenance(tasks: Sequence[ReportTask]) -> tuple[_Pairs, list[tuple[str, _Pairs]]]:
    """Return what is so for all tasks, and what else is so for some of them."""
    if not tasks:
        return [], []
    others = [set(task.provenance) for task in tasks]
    everywhere = set.intersection(*others)
    common = [_pair(pair) for pair in tasks[0].provenance if pair in everywhere]
    differing = [
        (task.name, [_pair(pair) for pair in task.provenance if pair not in everywhere])
        for task in tasks
    ]
    return common, [(name, pairs) for name, pairs in differing if pairs]


def _pair(pair: tuple[str, str]) -> tuple[str, str]:
    label, value = pair
    return label, _readable(value) if _SELECTION in label.casefold() else value
