# SPDX-License-Identifier: Apache-2.0
"""Figures for the page of a report, as SVG that takes the page's colours.

Each function returns one `<svg>` element to stand inside an HTML page. It has no
colours of its own but classes (`f-` for filling, `s-` for stroking, such as
`s-accent`), so that one figure serves light, dark and paper; no `style` attribute, so
that a strict content security policy leaves it alone; no reference to anything outside
of it; and a title and a description in words. The same input gives the same bytes.

Drawing is by matplotlib, without its axes, whose ticks and layout cost ten times as
much as everything else: a report may have fifty figures.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingDependency
from ..evaluation.summaries import AcrossTasks, TaskSummary
from .contents import EpisodeColumns, ReportTask
from .numbers import decimals_for, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_Floats: TypeAlias = NDArray[np.float64]

# The classes that tell lines apart, each with a dash pattern of its own as well.
SERIES: Final = 6
_DASHES: Final = ((), (6, 2), (2, 2), (8, 2, 2, 2), (10, 4), (4, 4))

# Colours that stand for classes: matplotlib writes them, and `_as_part_of_a_page` reads
# them.
_ROLES: Final = ("ink", "faint", "grid", "accent", "ground")
_MARKS: Final = {
    role: f"#0{i:x}0{i:x}0{i:x}"
    for i, role in enumerate(
        (*_ROLES, *(f"series-{i}" for i in range(SERIES))), start=1
    )
}
_OF_MARKS: Final = {mark: role for role, mark in _MARKS.items()}

# Of SVG's units, which are CSS pixels where there is room: a phone's width.
_WIDTH: Final = 340
_HEIGHT: Final = 210
_LETTERS: Final = 11

# More are neither seen apart nor laid out quickly.
_MOST_DOTS: Final = 600
_MOST_POINTS: Final = 160
_MOST_COLUMNS: Final = 40
# A window of more episodes than this is told from as many of it, evenly spread.
_WIDEST_WINDOW: Final = 1000
_LARGEST: Final = 1e300


def learning_curve(task: ReportTask, *, key: str) -> str:
    """Return a figure of returns over episodes: a running mean and how they spread.

    Episodes are in the order in which they ended, where that is known of all, else in
    the order of the task's columns; the first is 0, as in all that counts episodes.
    Where they are few, each has a dot.

    Args:
        task: episodes of monitors, such as those of a training.
        key: makes the ids of this figure's elements unique on the page.

    Raises:
        MissingDependency: there is no matplotlib.
    """
    returns = _returns_in_time(task.episodes)
    count, window = len(returns), _window(len(returns))
    figure = _Drawing()
    middle, low, mean, high = _running(returns, window)
    # What is not drawn needs no room.
    seen = returns if count <= _MOST_DOTS else np.append(low, high)
    episodes = _span(np.array([0.0, count - 1]), margin=0.01)
    panel = _Panel(figure, left=46, right=14, x=episodes, y=_span(seen))
    panel.grid()
    if count <= _MOST_DOTS:
        panel.dots(np.arange(float(count)), returns, "accent", opacity=0.4)
    panel.band(middle, low, high, "accent")
    panel.line(middle, mean, "accent")
    panel.label_y("Return")
    ticks = [x for x in panel.ticks_x if 0 <= x < count and x == round(x)]
    panel.label_x("Episode", [(tick, _short(tick)) for tick in ticks])
    said = (
        f"{_told(task.summary)} Mean of {window} episodes in a row, and the range of "
    )
    said += "the middle 80 % of them."
    return figure.svg(f"Returns of {task.name} over episodes", said, key)


def evaluation_curve(task: ReportTask, *, key: str) -> str:
    """Return a figure of an evaluation's returns: by seed, and which share is how high.

    On the left each episode is a dot over its seed, each seed's mean a short line, and
    the mean of all a long one with its interval. On the right stands, for each return,
    the share of episodes that reach it.

    Args:
        task: of an evaluation.
        key: makes the ids of this figure's elements unique on the page.

    Raises:
        MissingDependency: there is no matplotlib.
    """
    columns = task.episodes
    known = np.isfinite(columns.total_reward)
    returns, runs = _drawable(columns.total_reward[known]), columns.run[known]
    seeds, place = np.unique(runs, return_inverse=True)
    figure = _Drawing()
    reach = _span(np.append(returns, _ends(task.summary)))
    dots = _Panel(figure, left=46, right=128, x=(-0.6, len(seeds) - 0.4), y=reach)
    shares = _Panel(figure, left=_WIDTH - 112, right=22, x=(0.0, 1.0), y=reach)
    dots.grid()
    shares.grid(labels=False)
    if task.summary.mean is not None and len(returns):
        _draw_mean(dots, task.summary, len(seeds))
    if len(seeds) <= _MOST_COLUMNS:
        _draw_seeds(dots, returns, place, len(seeds))
    else:
        chosen = _spread(len(returns), _MOST_DOTS)
        dots.dots(place[chosen].astype(float), returns[chosen], "accent", opacity=0.35)
    share, height = _survival(returns)
    shares.line(share, height, "accent")
    dots.label_y("Return")
    dots.label_x("Seed", _seed_labels(seeds))
    shares.label_x("Share reaching it", [(0.0, "0"), (0.5, "50 %"), (1.0, "100 %")])
    return figure.svg(f"Returns of {task.name} by seed", _told(task.summary), key)


def profile_curve(across: Mapping[str, AcrossTasks], *, key: str) -> str:
    """Return a figure of performance profiles, one line with its band for each.

    The share of scores above a threshold, over the threshold. Line i has the class
    `s-series-<i>`, counted modulo `SERIES`; the page says which is which.

    Args:
        across: what is said of evaluations over all tasks; those without a profile are
            left out, and count for i.
        key: makes the ids of this figure's elements unique on the page.

    Raises:
        MissingDependency: there is no matplotlib.
    """
    figure = _Drawing(width=520, height=260)
    profiles = {name: told.profile for name, told in across.items()}
    thresholds = [x for p in profiles.values() if p is not None for x in p.thresholds]
    panel = _Panel(
        figure,
        left=52,
        right=14,
        x=_span(np.array(thresholds or [0.0, 1.0]), margin=0.0),
        y=(0.0, 1.0),
    )
    panel.grid(ticks=[(share, f"{share:.0%}") for share in (0, 0.25, 0.5, 0.75, 1)])
    for index, profile in enumerate(profiles.values()):
        if profile is None:
            continue
        role = f"series-{index % SERIES}"
        x = np.array(profile.thresholds, float)
        panel.band(x, np.array(profile.low), np.array(profile.high), role, opacity=0.14)
        dashes = _DASHES[index % SERIES]
        panel.line(x, np.array(profile.shares, float), role, dashes=dashes)
    panel.label_y("Share of scores above")
    panel.label_x("Score", [(tick, f"{tick:g}") for tick in panel.ticks_x])
    said = " ".join(_told_of_scores(name, told) for name, told in across.items())
    return figure.svg("Performance profile", said, key)


# --- What is drawn ----------------------------------------------------------------


def _returns_in_time(columns: EpisodeColumns) -> _Floats:
    known = np.isfinite(columns.total_reward)
    returns, times = _drawable(columns.total_reward[known]), columns.end_time[known]
    if len(returns) and np.isfinite(times).all():
        returns = returns[np.argsort(times, kind="stable")]
    return returns


def _drawable(returns: _Floats) -> _Floats:
    """Return returns whose sums are numbers, too."""
    return np.clip(returns, -_LARGEST, _LARGEST)


def _window(count: int) -> int:
    """Return of how many episodes a running mean is."""
    return max(5, count // 20)


def _running(
    returns: _Floats, window: int
) -> tuple[_Floats, _Floats, _Floats, _Floats]:
    """Return episodes' numbers, and the 10 %, the mean and the 90 % around them."""
    count = max(0, len(returns) - window + 1)
    if not count:
        return (np.empty(0),) * 4
    starts = _spread(count, _MOST_POINTS)
    inside = _spread(window, _WIDEST_WINDOW)
    windows = returns[starts[:, None] + inside[None, :]]
    low, high = np.quantile(windows, (0.1, 0.9), axis=1)
    # The last window ends with the last episode.
    middle = starts.astype(np.float64) + (window - 1) / 2
    return middle, low, windows.mean(axis=1), high


def _spread(count: int, most: int) -> NDArray[np.intp]:
    """Return up to `most` of `count` indices, the first and the last among them."""
    if count <= most:
        return np.arange(count)
    return np.linspace(0, count - 1, most).round().astype(np.intp)


def _survival(returns: _Floats) -> tuple[_Floats, _Floats]:
    """Return, as the corners of steps, shares of the episodes and what they reach."""
    if not len(returns):
        return np.empty(0), np.empty(0)
    height = np.sort(returns)[::-1][_spread(len(returns), _MOST_POINTS)]
    edges = np.linspace(0, 1, len(height) + 1)
    return np.repeat(edges, 2)[1:-1], np.repeat(height, 2)


def _draw_mean(panel: _Panel, summary: TaskSummary, seeds: int) -> None:
    ends = np.array([-0.6, seeds - 0.4])
    mean, interval = summary.mean, summary.mean_interval
    assert mean is not None
    if interval is not None:
        low, high = np.full(2, interval.low), np.full(2, interval.high)
        panel.band(ends, low, high, "accent")
    panel.line(ends, np.full(2, mean), "accent", width=1.25)


def _draw_seeds(
    panel: _Panel, returns: _Floats, place: NDArray[np.intp], seeds: int
) -> None:
    """Draw episodes from left to right in their seed's column, and its mean."""
    for seed in range(seeds):
        of_seed = returns[place == seed]
        chosen = _spread(len(of_seed), max(20, _MOST_DOTS // seeds))
        x = seed + np.linspace(-0.26, 0.26, len(chosen) + 2)[1:-1]
        panel.dots(x, of_seed[chosen], "accent", opacity=0.45)
        ends = np.array([seed - 0.34, seed + 0.34])
        panel.line(ends, np.full(2, of_seed.mean()), "ink", width=1.5)


def _seed_labels(seeds: NDArray[np.int64]) -> list[tuple[float, str]]:
    chosen = _spread(len(seeds), 6 if max(map(_digits, seeds), default=1) < 4 else 2)
    return [(float(i), str(seeds[i])) for i in chosen]


def _digits(seed: int) -> int:
    return len(str(seed))


def _ends(summary: TaskSummary) -> _Floats:
    """Return what else must be inside of the figure."""
    if summary.mean_interval is None:
        return np.empty(0)
    return np.array([summary.mean_interval.low, summary.mean_interval.high])


# --- What is said -----------------------------------------------------------------


def _told(summary: TaskSummary) -> str:
    """Return a task's key figures in words."""
    if summary.mean is None or summary.minimum is None or summary.maximum is None:
        return f"{summary.episodes} episodes."
    decimals = decimals_for((summary.minimum, summary.maximum))
    told = f"{summary.episodes} episodes: mean {number(summary.mean, decimals)}"
    if summary.mean_interval is not None:
        low, high = summary.mean_interval.low, summary.mean_interval.high
        told += f" (interval {number(low, decimals)} to {number(high, decimals)})"
    least, most = number(summary.minimum, decimals), number(summary.maximum, decimals)
    return f"{told}, from {least} to {most}."


def _told_of_scores(name: str, told: AcrossTasks) -> str:
    tasks = "1 task" if len(told.tasks) == 1 else f"{len(told.tasks)} tasks"
    if told.iqm is None:
        return f"{name}: {tasks}."
    return f"{name}: interquartile mean of scores {told.iqm:.3f} over {tasks}."


def _short(value: float) -> str:
    """Return a number as short as a label needs it: 12k for 12000."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= size:
            return f"{value / (1e3 if letter == 'k' else size):g}{letter}"
    return f"{value:g}"


# --- How it is drawn --------------------------------------------------------------


def _span(values: _Floats, *, margin: float = 0.06) -> tuple[float, float]:
    """Return from where to where an axis goes that shows all finite values."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    if not math.isfinite(high - low):
        low, high = low / 4, high / 4
    room = (high - low) * margin or (abs(high) * 0.1 or 1.0)
    if low == high and not margin:
        return low - room, high + room
    room = room if margin else 0.0
    return low - room, high + room


class _Drawing:
    """A matplotlib figure whose coordinates are pixels from the lower left."""

    def __init__(self, *, width: int = _WIDTH, height: int = _HEIGHT) -> None:
        self.width, self.height = width, height
        self._figure: Figure = _matplotlib().Figure(
            figsize=(width / 72, height / 72), dpi=72
        )

    def path(self, points: _Floats, codes: NDArray[np.uint8], **style: Any) -> None:
        """Add a path; `style` is that of matplotlib's patches."""
        drawn = _matplotlib()
        patch = drawn.PathPatch(drawn.Path(points, codes), transform=None, **style)
        # It would be told where other artists are, which costs more than drawing.
        patch.set_in_layout(False)
        self._figure.add_artist(patch)

    def text(self, x: float, y: float, text: str, **style: Any) -> None:
        """Add a text, as it stands: no formulas."""
        self._figure.text(
            x / self.width,
            y / self.height,
            text,
            parse_math=False,
            fontsize=_LETTERS,
            **style,
        )

    def svg(self, title: str, description: str, key: str) -> str:
        """Return the figure."""
        written = io.StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        with _own_settings():
            canvas = _matplotlib().FigureCanvasSVG(self._figure)
            canvas.print_svg(written, metadata=nothing)
        body = _as_part_of_a_page(written.getvalue())
        size = f'viewBox="0 0 {self.width} {self.height}"'
        return (
            f'<svg class="curve" {size} width="{self.width}" height="{self.height}" '
            f'role="img" aria-labelledby="{key}-title {key}-desc">'
            f'<title id="{key}-title">{escape(title)}</title>'
            f'<desc id="{key}-desc">{escape(description)}</desc>{body}</svg>'
        )


class _Panel:
    """A part of a drawing with scales of its own.

    Attributes:
        ticks_x: round values of x.
        ticks_y: likewise of y.
    """

    def __init__(
        self,
        drawing: _Drawing,
        *,
        left: float,
        right: float,
        x: tuple[float, float],
        y: tuple[float, float],
    ) -> None:
        self._drawing = drawing
        self._left, self._right = left, drawing.width - right
        self._bottom, self._top = 38.0, drawing.height - 24.0
        self._x, self._y = x, y
        self.ticks_x = _ticks(x)
        self.ticks_y = _ticks(y)

    def grid(
        self,
        *,
        labels: bool = True,
        ticks: Sequence[tuple[float, str]] | None = None,
    ) -> None:
        """Draw lines at the ticks of y, with what they stand for."""
        ticks = ticks or [(tick, _short(tick)) for tick in self.ticks_y]
        ends = np.array([(x, y) for y, _ in ticks for x in self._x], float)
        lines = np.tile((1, 2), len(ticks))
        self._path(ends, lines, edgecolor=_MARKS["grid"], linewidth=1)
        for y, text in ticks if labels else ():
            at = self._pixels(np.array([(self._x[0], y)]))[0]
            self._drawing.text(
                *(self._left - 7, at[1], text),
                ha="right",
                va="center_baseline",
                color=_MARKS["faint"],
            )

    def label_x(self, name: str, ticks: Sequence[tuple[float, str]]) -> None:
        """Write what is below the panel."""
        for x, text in ticks:
            at = self._pixels(np.array([(x, self._y[0])]))[0]
            self._drawing.text(
                *(at[0], self._bottom - 16, text), ha="center", color=_MARKS["faint"]
            )
        middle = (self._left + self._right) / 2
        self._drawing.text(middle, 5, name, ha="center", color=_MARKS["faint"])

    def label_y(self, name: str) -> None:
        """Write what goes up, above the panel, where it can be read upright."""
        self._drawing.text(4, self._drawing.height - 13, name, color=_MARKS["faint"])

    def line(
        self,
        x: _Floats,
        y: _Floats,
        role: str,
        *,
        width: float = 2,
        dashes: Sequence[float] = (),
    ) -> None:
        """Draw a line through points."""
        codes = np.full(len(x), 2)
        codes[:1] = 1
        self._path(
            np.column_stack((x, y)),
            codes,
            edgecolor=_MARKS[role],
            linewidth=width,
            linestyle=(0, dashes) if dashes else "solid",
            joinstyle="round",
        )

    def dots(self, x: _Floats, y: _Floats, role: str, *, opacity: float) -> None:
        """Draw dots: lines of no length with round ends, all in one element."""
        points = np.repeat(np.column_stack((x, y)), 2, axis=0)
        self._path(
            points,
            np.tile((1, 2), len(x)),
            edgecolor=_MARKS[role],
            linewidth=5,
            capstyle="round",
            alpha=opacity,
        )

    def band(
        self, x: _Floats, low: _Floats, high: _Floats, role: str, opacity: float = 0.18
    ) -> None:
        """Fill what lies between two lines."""
        outline = np.concatenate(
            (np.column_stack((x, low)), np.column_stack((x, high))[::-1])
        )
        codes = np.full(len(outline), 2)
        codes[:1] = 1
        self._path(
            outline,
            codes,
            fill=True,
            facecolor=_MARKS[role],
            alpha=opacity,
            linewidth=0,
        )

    def _path(
        self, points: _Floats, codes: NDArray[Any], *, fill: bool = False, **style: Any
    ) -> None:
        if len(points):
            pixels = self._pixels(points).round(2)
            self._drawing.path(pixels, codes.astype(np.uint8), fill=fill, **style)

    def _pixels(self, points: _Floats) -> _Floats:
        low = np.array([self._x[0], self._y[0]])
        high = np.array([self._x[1], self._y[1]])
        corner = np.array([self._left, self._bottom])
        size = np.array([self._right, self._top]) - corner
        share: _Floats = np.clip((points - low) / (high - low), -0.01, 1.01)
        pixels: _Floats = corner + share * size
        return pixels


def _ticks(span: tuple[float, float]) -> list[float]:
    """Return a few round values inside of a span."""
    low, high = span
    step = (high - low) / 5
    size = 10.0 ** math.floor(math.log10(step))
    step = next(s * size for s in (1, 2, 2.5, 5, 10) if s * size >= step * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [float(f"{i * step:.12g}") for i in range(first, last + 1)]


@dataclass(frozen=True)
class _Matplotlib:
    """What is used of it."""

    Figure: Any
    FigureCanvasSVG: Any
    Path: Any
    PathPatch: Any


def _matplotlib() -> _Matplotlib:
    try:
        # Here, because it is an extra, and takes the better part of a second.
        from matplotlib.backends.backend_svg import FigureCanvasSVG
        from matplotlib.figure import Figure
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path
    except ImportError as error:
        raise MissingDependency(
            "matplotlib",
            purpose="Drawing the curves of a report",
            install="pip install 'mjrec[report]'",
        ) from error
    return _Matplotlib(Figure, FigureCanvasSVG, Path, PathPatch)


@contextmanager
def _own_settings() -> Iterator[None]:
    """Draw the same whatever stands in somebody's matplotlibrc."""
    import matplotlib

    settings: Any = {
        "svg.fonttype": "none",
        "svg.hashsalt": "mjrec",
        "path.simplify": False,
        "path.sketch": None,
        "path.snap": False,
        "font.family": ["sans-serif"],
        "font.sans-serif": ["DejaVu Sans"],
        "text.usetex": False,
    }
    with matplotlib.rc_context(settings):
        yield


_STYLE: Final = re.compile(r' style="([^"]*)"')
_UNUSED: Final = re.compile(
    r'<defs>\s*<style.*?</style>\s*</defs>| id="[^"]*"', re.DOTALL
)
_BACKGROUND: Final = re.compile(r'<g id="patch_1">.*?</g>', re.DOTALL)
_SPACE: Final = re.compile(r"\s*\n\s*")
_KEPT: Final = frozenset(
    (
        *("fill", "opacity", "stroke-width", "stroke-dasharray", "stroke-linecap"),
        *("stroke-linejoin", "text-anchor"),
    )
)


def _as_part_of_a_page(svg: str) -> str:
    """Return what is inside of `<svg>`, without what a page must not have."""
    body = svg[svg.index(">", svg.index("<svg")) + 1 : svg.rindex("</svg>")]
    body = _BACKGROUND.sub("", body, count=1)
    body = _STYLE.sub(_attributes, _UNUSED.sub("", body))
    # Nothing refers to another element, and no text has a line break.
    return _SPACE.sub(" ", body).replace("<g>", "").replace("</g>", "").strip()


def _attributes(match: re.Match[str]) -> str:
    """Return an element's classes and attributes for what was its style."""
    classes, attributes = [], []
    for declaration in match[1].split(";"):
        name, _, value = (part.strip() for part in declaration.partition(":"))
        if value in _OF_MARKS:
            classes.append(f"{name[0]}-{_OF_MARKS[value]}")
        elif name in _KEPT:
            attributes.append(f' {name}="{escape(value)}"')
    named = f' class="{" ".join(classes)}"' if classes else ""
    return named + "".join(attributes)
