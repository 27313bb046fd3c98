# SPDX-License-Identifier: Apache-2.0
"""mjrec: a headless MuJoCo recorder.

Importing this package does not load a simulator, OpenGL or ffmpeg, and does not change
environment variables; each name below is loaded on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from . import errors

# All errors are public.
from .errors import *  # noqa: F403
from .errors import MissingDependency

if TYPE_CHECKING:
    from .engines.local import LocalEngine as LocalEngine
    from .engines.ray import RayEngine as RayEngine
    from .engines.slurm import SlurmEngine as SlurmEngine
    from .evaluation.comparing import Comparison as Comparison
    from .evaluation.comparing import compare as compare
    from .evaluation.evaluating import evaluate as evaluate
    from .evaluation.evaluation import Evaluation as Evaluation
    from .evaluation.statistics import Bootstrap as Bootstrap
    from .evidence.findings import Finding as Finding
    from .evidence.findings import Verdict as Verdict
    from .evidence.findings import Verification as Verification
    from .evidence.pack import pack as pack
    from .evidence.verify import verify as verify
    from .formats.archive import write_archive as write_archive
    from .formats.video_writer import VideoWriter as VideoWriter
    from .formats.video_writer import save_video as save_video
    from .gl.choice import use_gl as use_gl
    from .monitors import Monitor as Monitor
    from .monitors.dm_env_monitor import DmEnvMonitor as DmEnvMonitor
    from .monitors.gymnasium_monitor import GymnasiumMonitor as GymnasiumMonitor
    from .monitors.vector_monitor import VectorMonitor as VectorMonitor
    from .recorder.stats_recorder import StatsRecorder as StatsRecorder
    from .recorder.video_recorder import VideoRecorder as VideoRecorder
    from .rendering.jobs import RenderedVideos as RenderedVideos
    from .rendering.recovery import Recovery as Recovery
    from .rendering.recovery import recover as recover
    from .rendering.render_frames import render as render
    from .rendering.render_frames import render_states as render_states
    from .rendering.render_videos import render_videos as render_videos
    from .reporting.film_strips import film_strip as film_strip
    from .reporting.report_folder import write_report as write_report
    from .results import Episode as Episode
    from .results import clear_monitor_files as clear_monitor_files
    from .results import detect_monitor_files as detect_monitor_files
    from .results import detect_training_manifests as detect_training_manifests
    from .results import iter_episodes as iter_episodes
    from .results import load_results as load_results
    from .results import merge_stats_files as merge_stats_files
    from .schedules import capped_cubic_video_schedule as capped_cubic_video_schedule
    from .schedules import disable_videos as disable_videos
    from .signals import Terminated as Terminated
    from .signals import exit_on_signals as exit_on_signals
    from .simulation.trajectories import Trajectory as Trajectory
    from .simulation.trajectories import load_trajectory as load_trajectory
    from .viewing.replay import Replay as Replay
    from .viewing.replay import write_replay as write_replay

# Public names by module; a module is imported when one of its names is first used.
_NAMES = {
    "engines.local": "LocalEngine",
    "engines.ray": "RayEngine",
    "engines.slurm": "SlurmEngine",
    "evaluation.comparing": "Comparison compare",
    "evaluation.evaluating": "evaluate",
    "evaluation.evaluation": "Evaluation",
    "evaluation.statistics": "Bootstrap",
    "evidence.findings": "Finding Verdict Verification",
    "evidence.pack": "pack",
    "evidence.verify": "verify",
    "formats.archive": "write_archive",
    "formats.video_writer": "VideoWriter save_video",
    "gl.choice": "use_gl",
    "monitors": "Monitor",
    "monitors.dm_env_monitor": "DmEnvMonitor",
    "monitors.gymnasium_monitor": "GymnasiumMonitor",
    "monitors.vector_monitor": "VectorMonitor",
    "recorder.stats_recorder": "StatsRecorder",
    "recorder.video_recorder": "VideoRecorder",
    "rendering.recovery": "Recovery recover",
    "rendering.render_frames": "render render_states",
    "rendering.jobs": "RenderedVideos",
    "rendering.render_videos": "render_videos",
    "reporting.film_strips": "film_strip",
    "reporting.report_folder": "write_report",
    "results": (
        "Episode clear_monitor_files detect_monitor_files detect_training_manifests "
        "iter_episodes load_results merge_stats_files"
    ),
    "schedules": "capped_cubic_video_schedule disable_videos",
    "signals": "Terminated exit_on_signals",
    "simulation.trajectories": "Trajectory load_trajectory",
    "viewing.replay": "Replay write_replay",
}
_LAZY = {name: module for module, names in _NAMES.items() for name in names.split()}

# Only names that need no extra, so that `from mjrec import *` always works.
# `DmEnvMonitor` needs dm_env, and replays need viser.
__all__ = sorted({*errors.KINDS, *_LAZY} - {"DmEnvMonitor", "Replay", "write_replay"})


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("mjrec")
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = importlib.import_module(f".{_LAZY[name]}", __name__)
    except ModuleNotFoundError as error:
        if error.name != "dm_env":
            raise
        raise MissingDependency(
            "dm_env", purpose=name, install='pip install "mjrec[dm-control]"'
        ) from error
    value = getattr(module, name)
    # Cached, so that later uses cost nothing.
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
