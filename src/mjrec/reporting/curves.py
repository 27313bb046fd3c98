# SPDX-License-Identifier: Apache-2.0
"""SVG figures for a report's page, drawn in the page's colors.

Each function returns one `<svg>` element for an HTML page. The element uses classes
instead of colors (`f-` for fills, `s-` for strokes, such as `s-accent`), so that one
figure works in light mode, dark mode and print. It has no `style` attributes, which a
strict content security policy would block, and no external references. It contains a
title and a description in words. The same input yields the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..evaluation.summaries import AcrossTasks, TaskSummary
from ..plain_text import counted
from .contents import ReportTask, end_times
from .page_text import decimals_for, interval_text, number

_Floats: TypeAlias = NDArray[np.float64]
_Ticks: TypeAlias = Sequence[tuple[float, str]]

# The number of classes that distinguish lines. Each class also has a dash pattern.
SERIES: Final = 6

# Width and height in SVG units (CSS pixels if there is room); small enough for a phone.
_SMALL: Final = (340, 210)
_WIDE: Final = (520, 260)
_TOP: Final = 24
_BELOW: Final = 38

# More elements would be indistinguishable and slow to lay out.
_MOST_DOTS: Final = 600
_MOST_POINTS: Final = 160
_MOST_COLUMNS: Final = 40
# For a longer window, only this many evenly spaced episodes are used.
_WIDEST_WINDOW: Final = 1000
_LARGEST: Final = 1e300
_SMALLEST: Final = 1e-300


def learning_curve(task: ReportTask, *, key: str) -> str:
    """Return a figure of returns over episodes, with the running mean and the spread.

    Episodes are in the order in which they ended if all end times are known, otherwise
    in the task's order. They are numbered from 0. If there are few, each has a dot.

    Args:
        task: a task with episodes from monitors, such as a training run.
        key: a prefix that makes the figure's element ids unique on the page.
    """
    _, returns, times = _drawable(task)
    if np.isfinite(times).all():
        returns = returns[np.argsort(times, kind="stable")]
    count, window = len(returns), max(5, len(returns) // 20)
    middle, low, mean, high = _running(returns, window)
    has_dots = count <= _MOST_DOTS
    # The axis need not include dots that are not drawn.
    y = _span(returns if has_dots else np.append(low, high))
    panel = _Panel(46, _SMALL[0] - 14, x=_span([0, count - 1], margin=0.01), y=y)
    if has_dots:
        panel.dots(np.arange(count), returns, opacity=0.4)
    panel.band(middle, low, high, "accent")
    panel.line(middle, mean, "accent")
    ticks = [x for x in panel.ticks_x if 0 <= x < count and x == round(x)]
    panel.label("Return", "Episode", [(tick, _short(tick)) for tick in ticks])
    return _svg(
        panel.elements,
        title=f"Returns of {task.name} over episodes",
        description=(
            f"{_in_words(task.summary)} Running mean over {window} episodes, and the "
            "range of the middle 80%."
        ),
        key=key,
    )


def evaluation_curve(task: ReportTask, *, key: str) -> str:
    """Return a figure of an evaluation's returns by seed and of their distribution.

    On the left, each episode is a dot above its seed, each seed's mean is a short line,
    and the overall mean is a long line with its interval. On the right, a curve shows
    the share of episodes that reach each return.

    Args:
        task: a task in an evaluation.
        key: a prefix that makes the figure's element ids unique on the page.
    """
    runs, returns, _ = _drawable(task)
    seeds, place = np.unique(runs, return_inverse=True)
    mean, interval = task.summary.mean, task.summary.mean_interval
    ends = [interval.low, interval.high] if interval else []
    reach = _span(np.append(returns, ends))
    across = -0.6, len(seeds) - 0.4
    dots = _Panel(46, 212, x=across, y=reach)
    if interval is not None:
        dots.band(across, [interval.low] * 2, [interval.high] * 2, "accent")
    if mean is not None:
        dots.line(across, [mean] * 2, "accent", width=1.25)
    if len(seeds) <= _MOST_COLUMNS:
        _draw_seeds(dots, returns, place, len(seeds))
    else:
        chosen = _spread(len(returns), _MOST_DOTS)
        dots.dots(place[chosen], returns[chosen], opacity=0.35)
    longest = max((len(str(seed)) for seed in seeds), default=1)
    named = _spread(len(seeds), 6 if longest < 4 else 2)
    dots.label("Return", "Seed", [(i, str(seeds[i])) for i in named])
    shares = _Panel(228, 318, x=(0, 1), y=reach, y_labels=False)
    # The corners of a step curve: shares of episodes, and the returns they reach.
    heights = np.sort(returns)[::-1][_spread(len(returns), _MOST_POINTS)]
    edges = np.linspace(0, 1, len(heights) + 1)
    shares.line(np.repeat(edges, 2)[1:-1], np.repeat(heights, 2), "accent")
    shares.label("", "Share reaching it", [(0, "0"), (0.5, "50%"), (1, "100%")])
    return _svg(
        dots.elements + shares.elements,
        title=f"Returns of {task.name} by seed",
        description=_in_words(task.summary),
        key=key,
    )


def profile_curve(across: Mapping[str, AcrossTasks], *, key: str) -> str:
    """Return a figure that shows performance profiles, each as a line with a band.

    A profile is the share of scores above a threshold, as a function of the threshold.
    Line i has the class `s-series-<i>`, modulo `SERIES`; the page has the legend.

    Args:
        across: the statistics across tasks of each evaluation. Evaluations without a
            profile are not drawn, but are still counted in i.
        key: a prefix that makes the figure's element ids unique on the page.
    """
    profiles = [each.profile for each in across.values()]
    x = _span([x for p in profiles if p for x in p.thresholds] or [0, 1], margin=0)
    percents = [(share, f"{share:.0%}") for share in (0, 0.25, 0.5, 0.75, 1)]
    panel = _Panel(52, _WIDE[0] - 14, _WIDE[1], x=x, y=(0, 1), ticks=percents)
    for index, profile in enumerate(profiles):
        if profile is not None:
            thresholds, series = profile.thresholds, index % SERIES
            role = f"series-{series}"
            panel.band(thresholds, profile.low, profile.high, role, opacity=0.14)
            panel.line(thresholds, profile.shares, role, dash=series)
    ticks = [(tick, f"{tick:g}") for tick in panel.ticks_x]
    panel.label("Share of scores above", "Score", ticks)
    return _svg(
        panel.elements,
        title="Performance profile",
        description=" ".join(_scores_in_words(*each) for each in across.items()),
        key=key,
        size=_WIDE,
    )


# --- Data -------------------------------------------------------------------------


def _drawable(task: ReportTask) -> tuple[NDArray[np.int64], _Floats, _Floats]:
    """Return the runs, returns and end times of the episodes with finite returns.

    Returns are clipped so that their sums are also finite.
    """
    known = task.episodes[np.isfinite(task.episodes["total_reward"])]
    returns = np.clip(known["total_reward"], -_LARGEST, _LARGEST)
    return known["seed"], returns, end_times(known)


def _running(
    returns: _Floats, window: int
) -> tuple[_Floats, _Floats, _Floats, _Floats]:
    """Return the centers of running windows, and their 10%, mean and 90% values."""
    count = max(0, len(returns) - window + 1)
    if not count:
        return (np.empty(0),) * 4
    starts = _spread(count, _MOST_POINTS)
    inside = _spread(window, _WIDEST_WINDOW)
    windows = returns[starts[:, None] + inside[None, :]]
    low, high = np.quantile(windows, (0.1, 0.9), axis=1)
    # The last window ends at the last episode.
    middle = starts.astype(np.float64) + (window - 1) / 2
    return middle, low, windows.mean(axis=1), high


def _spread(count: int, most: int) -> NDArray[np.intp]:
    """Return up to `most` of `count` indices, including the first and the last."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.intp)


def _draw_seeds(
    panel: _Panel, returns: _Floats, place: NDArray[np.intp], seeds: int
) -> None:
    """Draw each seed's episodes from left to right in one column, and their mean."""
    for seed in range(seeds):
        of_seed = returns[place == seed]
        chosen = _spread(len(of_seed), max(20, _MOST_DOTS // seeds))
        x = seed + np.linspace(-0.26, 0.26, len(chosen) + 2)[1:-1]
        panel.dots(x, of_seed[chosen], opacity=0.45)
        panel.line([seed - 0.34, seed + 0.34], [of_seed.mean()] * 2, "ink", width=1.5)


# --- Descriptions -----------------------------------------------------------------


def _in_words(summary: TaskSummary) -> str:
    if summary.mean is None:
        return f"{summary.episodes} episodes."
    decimals = decimals_for((summary.minimum, summary.maximum))
    interval = interval_text(summary.mean_interval, decimals)
    return (
        f"{summary.episodes} episodes: mean {number(summary.mean, decimals)}"
        f"{f' (interval {interval})' if interval else ''}, from "
        f"{number(summary.minimum, decimals)} to {number(summary.maximum, decimals)}."
    )


def _scores_in_words(name: str, across: AcrossTasks) -> str:
    tasks = counted(len(across.tasks), "task")
    if across.iqm is None:
        return f"{name}: {tasks}."
    return f"{name}: interquartile mean of scores {across.iqm:.3f} over {tasks}."


def _short(value: float) -> str:
    """Return a number as a short label, such as 12k for 12000."""
    for least, size, letter in ((1e9, 1e9, "G"), (1e6, 1e6, "M"), (1e4, 1e3, "k")):
        if abs(value) >= least:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


# --- Drawing ----------------------------------------------------------------------


class _Panel:
    """A part of a figure with its own scales, and with grid lines at the y ticks.

    Args:
        left: the panel's left edge, in pixels from the figure's left edge.
        right: the panel's right edge, in pixels from the figure's left edge.
        height: the figure's height in pixels.
        x: the range of the x axis.
        y: the range of the y axis.
        ticks: the y ticks with their labels; chosen automatically by default.
        y_labels: whether to draw the labels of the y ticks.
    """

    def __init__(
        self,
        left: float,
        right: float,
        height: int = _SMALL[1],
        *,
        x: tuple[float, float],
        y: tuple[float, float],
        ticks: _Ticks | None = None,
        y_labels: bool = True,
    ) -> None:
        self.elements: list[str] = []
        self.ticks_x = _ticks(x)
        self._x, self._y = x, y
        self._left, self._right, self._bottom = left, right, height - _BELOW
        for value, label in ticks or [(tick, _short(tick)) for tick in _ticks(y)]:
            ((_, pixel),) = self._pixels([x[0]], [value])
            self._path(f"M{left:g} {pixel:g}H{right:g}", "s-grid")
            self._text(left - 7, pixel + 4, label if y_labels else "", anchor="end")

    def label(self, up: str, right: str, ticks: _Ticks) -> None:
        """Draw the axis labels and the x ticks.

        Args:
            up: the label of the y axis, above the panel.
            right: the label of the x axis, below the panel.
            ticks: the x ticks with their labels.
        """
        for value, label in ticks:
            ((x, _),) = self._pixels([value], [self._y[0]])
            self._text(x, self._bottom + 16, label)
        self._text((self._left + self._right) / 2, self._bottom + 33, right)
        self._text(4, 13, up, anchor="start")

    def line(
        self, x: ArrayLike, y: ArrayLike, role: str, *, width: float = 2, dash: int = 0
    ) -> None:
        """Draw a line through points, with the page's dash pattern number `dash`."""
        look = f'stroke-width="{width}" stroke-linejoin="round"'
        self._path(_joined(self._pixels(x, y)), f"s-{role} dash-{dash}", look)

    def dots(self, x: ArrayLike, y: ArrayLike, *, opacity: float) -> None:
        """Draw dots, as lines of zero length with round ends, all in one element."""
        data = "".join(f"M{x:g} {y:g}h0" for x, y in self._pixels(x, y))
        look = f'stroke-width="5" stroke-linecap="round" opacity="{opacity}"'
        self._path(data, "s-accent", look)

    def band(
        self,
        x: ArrayLike,
        low: ArrayLike,
        high: ArrayLike,
        role: str,
        opacity: float = 0.18,
    ) -> None:
        """Fill the area between two lines."""
        outline = [*self._pixels(x, low), *self._pixels(x, high)[::-1]]
        self._path(_joined(outline), f"f-{role}", f'opacity="{opacity}"')

    def _path(self, data: str, role: str, look: str = "") -> None:
        if data:
            fill = "" if role.startswith("f-") else 'fill="none"'
            self.elements.append(f'<path class="{role}" d="{data}" {fill} {look}/>')

    def _text(self, x: float, y: float, text: str, *, anchor: str = "middle") -> None:
        if text:
            place = f'x="{x:g}" y="{y:g}" text-anchor="{anchor}"'
            self.elements.append(f'<text class="f-faint" {place}>{escape(text)}</text>')

    def _pixels(self, x: ArrayLike, y: ArrayLike) -> list[list[float]]:
        low, high = np.transpose([self._x, self._y])
        corner = np.array([self._left, self._bottom])
        size = np.array([self._right, _TOP]) - corner
        share = (np.column_stack((x, y)) - low) / (high - low)
        pixels = corner + np.clip(share, -0.01, 1.01) * size
        # Adding 0.0 removes the sign of negative zeros.
        found: list[list[float]] = (pixels.round(2) + 0.0).tolist()
        return found


def _joined(points: Sequence[Sequence[float]]) -> str:
    """Return the data for a path through points; empty without points."""
    joined = "L".join(f"{x:g} {y:g}" for x, y in points)
    return f"M{joined}" if joined else ""


def _svg(
    elements: Sequence[str],
    *,
    title: str,
    description: str,
    key: str,
    size: tuple[int, int] = _SMALL,
) -> str:
    width, height = size
    return (
        f'<svg class="curve" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" role="img" aria-labelledby="{key}-title {key}-desc">'
        f'<title id="{key}-title">{escape(title)}</title>'
        f'<desc id="{key}-desc">{escape(description)}</desc>{"".join(elements)}</svg>'
    )


def _span(values: ArrayLike, *, margin: float = 0.06) -> tuple[float, float]:
    """Return the range of an axis that shows all values."""
    values = np.clip(np.asarray(values, np.float64), -_LARGEST, _LARGEST)
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    room = (high - low) * margin
    if high - low < _SMALLEST:
        room = abs(high) * 0.1 if abs(high) > _SMALLEST else 1.0
    return low - room, high + room


def _ticks(span: tuple[float, float]) -> list[float]:
    """Return a few round values within a span."""
    low, high = span
    step = (high - low) / 5
    size = 10.0 ** math.floor(math.log10(step))
    step = next(s * size for s in (1, 2, 2.5, 5, 10) if s * size >= step * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [float(f"{i * step:.12g}") for i in range(first, last + 1)]
