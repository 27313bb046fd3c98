# SPDX-License-Identifier: Apache-2.0
"""Build contents of reports."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mjrec.evaluation.result_tables import ROW
from mjrec.evaluation.statistics import Bootstrap
from mjrec.evaluation.summaries import AcrossTasks, summarize_across, summarize_task
from mjrec.reporting.contents import ReportContents, ReportTask, ReportVideo, Verdict

_FEW = Bootstrap(resamples=50)

# These include markup, quotes, a template, a formula, addresses, very long names, a
# mark that reverses text, and a line separator that JSON allows but old JavaScript
# does not.
HOSTILE = (
    "<script>alert(1)</script>",
    "</script><script>alert(2)</script>",
    "\"><img src=x onerror=alert(3)>'",
    "<!--<script>",
    "{{ 7 * 7 }} {% raw %}",
    "abc\u202edef\u2028ghi\x00\x1b[31m",
    "$\\frac{1}{0$ &amp; &lt;",
    "javascript:alert(4)",
    "data:text/html;base64,PGI+",
    "//host/x.mp4",
    "שלום مرحبا",
    "x" * 10_000,
    "a b/" * 2_500,
)


def task(name, returns, *, seeds=1, failures=None, score_range=(0.0, 1e3), **changes):
    """Return a task with the same number of episodes per seed or monitor (`runs`)."""
    count = len(returns)
    each = max(1, count // seeds)
    episodes = np.zeros(count, ROW)
    episodes["seed"] = np.arange(count) // each
    episodes["episode"] = np.arange(count) % each
    episodes["total_reward"] = returns
    episodes["length"] = np.arange(count) % 7 + 10
    episodes["start_time"] = 1.7e9 + np.arange(count)
    episodes["truncated"] = 1
    episodes["success"] = -1
    failed = list(failures or {})
    episodes["total_reward"][failed] = np.nan
    known = episodes["total_reward"]
    made = ReportTask(
        name=name,
        source="evaluation",
        is_evaluation="runs" not in changes,
        summary=summarize_task(
            name,
            total_rewards=known[np.isfinite(known)],
            runs=len(np.unique(episodes["seed"])),
            failed=len(failed),
            score_range=score_range,
            bootstrap=_FEW,
        ),
        episodes=episodes,
        failures=failures or {},
        provenance=[
            ("Policy", "random"),
            ("Selection of videos", "best, median and worst"),
        ],
    )
    return replace(made, **changes)


def video(index=0, **changes):
    made = ReportVideo(
        path=Path("evaluation/a b.mp4"),
        index=index,
        file="videos/a b.mp4",
        poster="videos/a b.png",
        roles=("best",),
        height=48,
        width=64,
        seconds=2.0,
        camera="side",
        sha256="0123456789abcdef" * 4,
        command="mjrec render evaluation/walker --episode 3 -o again.mp4",
    )
    return replace(made, **changes)


def contents(*tasks, **changes):
    """Return a report of tasks, by default two tasks with five seeds each."""
    if not tasks:
        tasks = (
            task("dm_control/walker-walk", _returns(900, 40), seeds=5),
            task("dm_control/cheetah-run", _returns(600, 100), seeds=5),
        )
    returns = {t.name: t.episodes["total_reward"] for t in tasks}
    scales = dict.fromkeys(returns, (0.0, 1000.0))
    finite = all(np.isfinite(s).all() and len(s) for s in returns.values())
    summary = summarize_across(returns, scales, bootstrap=_FEW)
    across = {"evaluation": summary} if finite else {}
    made = ReportContents(
        title="An evaluation", tasks=list(tasks), across=across, bootstrap=_FEW
    )
    return replace(made, **changes)


def hostile_report():
    """Return contents in which every text is hostile."""
    tasks = [
        task(
            text,
            [1.0, 2.0, 3.0],
            source=text,
            failures={1: text},
            provenance=[(text, text), ("Selection of videos", text)],
            videos=[
                video(
                    path=Path(text),
                    file=text,
                    poster=text,
                    camera=text,
                    sha256=text,
                    command=text,
                    notes=[text],
                )
            ],
            **({"runs": [text]} if i % 2 else {}),
        )
        for i, text in enumerate(HOSTILE)
    ]
    scores = AcrossTasks(
        tasks=tuple(HOSTILE), left_out={text: text for text in HOSTILE}, iqm=0.5
    )
    return contents(
        *tasks,
        title=HOSTILE[0],
        across=dict.fromkeys(HOSTILE, scores),
        problems=list(HOSTILE),
        verdicts=[
            Verdict(source=text, verdict="FAIL", counts={text: 1}, level=text)
            for text in HOSTILE
        ],
    )


def _returns(mean, spread):
    return np.random.default_rng(0).normal(mean, spread, 50).tolist()
