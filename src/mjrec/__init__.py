# SPDX-License-Identifier: Apache-2.0
"""mjrec: a headless MuJoCo recorder.

Importing this package imports no simulator, no OpenGL and no ffmpeg, and changes no
environment variable; each name below is loaded when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from .errors import (
    ArchiveError,
    ArchiveTooLarge,
    BlankVideo,
    ClosedError,
    DifferentEnvironment,
    DifferentEvaluation,
    DirectoryInUse,
    DirectoryNotWritable,
    EncoderError,
    EnvironmentNotMade,
    Error,
    ExistingRecordings,
    FileNotWritten,
    FrameCountError,
    GLError,
    IdentityLeft,
    InvalidArgument,
    InvalidFrame,
    MissingDependency,
    NoPictures,
    NotPicklable,
    PackError,
    PicturesDiffer,
    PolicyError,
    RenderError,
    ResetNeeded,
    ResetNotAllowed,
    UnfinishedRecordings,
    UnknownName,
    UnreadableArchive,
    UnreadableFile,
    UntrustedModel,
)

if TYPE_CHECKING:
    from .engines.local import LocalEngine as LocalEngine
    from .engines.ray import RayEngine as RayEngine
    from .engines.slurm import SlurmEngine as SlurmEngine
    from .evaluation.comparing import Comparison as Comparison
    from .evaluation.comparing import compare as compare
    from .evaluation.evaluating import evaluate as evaluate
    from .evaluation.evaluation import Evaluation as Evaluation
    from .evidence.packing import pack as pack
    from .evidence.verification import Check as Check
    from .evidence.verification import Verification as Verification
    from .evidence.verifying import verify as verify
    from .formats.archive import write_archive as write_archive
    from .formats.frames_to_videos import save_video as save_video
    from .formats.video_writer import VideoWriter as VideoWriter
    from .gl import use_gl as use_gl
    from .monitors import Monitor as Monitor
    from .monitors.dm_env_monitor import DmEnvMonitor as DmEnvMonitor
    from .monitors.gymnasium_monitor import GymnasiumMonitor as GymnasiumMonitor
    from .monitors.vector_monitor import VectorMonitor as VectorMonitor
    from .recorder.stats_recorder import StatsRecorder as StatsRecorder
    from .recorder.video_recorder import VideoRecorder as VideoRecorder
    from .rendering.directory_videos import RenderedVideos as RenderedVideos
    from .rendering.directory_videos import render_videos as render_videos
    from .rendering.pictures import render as render
    from .rendering.pictures import render_states as render_states
    from .rendering.recovery import recover as recover
    from .rendering.recovery_report import Recovery as Recovery
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

_LAZY = {
    "Check": "evidence.verification",
    "Comparison": "evaluation.comparing",
    "DmEnvMonitor": "monitors.dm_env_monitor",
    "Episode": "results",
    "Evaluation": "evaluation.evaluation",
    "GymnasiumMonitor": "monitors.gymnasium_monitor",
    "LocalEngine": "engines.local",
    "Monitor": "monitors",
    "RayEngine": "engines.ray",
    "Recovery": "rendering.recovery_report",
    "RenderedVideos": "rendering.directory_videos",
    "SlurmEngine": "engines.slurm",
    "StatsRecorder": "recorder.stats_recorder",
    "Terminated": "signals",
    "Trajectory": "simulation.trajectories",
    "VectorMonitor": "monitors.vector_monitor",
    "Verification": "evidence.verification",
    "VideoRecorder": "recorder.video_recorder",
    "VideoWriter": "formats.video_writer",
    "capped_cubic_video_schedule": "schedules",
    "clear_monitor_files": "results",
    "compare": "evaluation.comparing",
    "detect_monitor_files": "results",
    "detect_training_manifests": "results",
    "disable_videos": "schedules",
    "evaluate": "evaluation.evaluating",
    "exit_on_signals": "signals",
    "film_strip": "reporting.film_strips",
    "iter_episodes": "results",
    "load_results": "results",
    "load_trajectory": "simulation.trajectories",
    "merge_stats_files": "results",
    "pack": "evidence.packing",
    "recover": "rendering.recovery",
    "render": "rendering.pictures",
    "render_states": "rendering.pictures",
    "render_videos": "rendering.directory_videos",
    "save_video": "formats.frames_to_videos",
    "use_gl": "gl",
    "verify": "evidence.verifying",
    "write_archive": "formats.archive",
    "write_report": "reporting.report_folder",
}

# What can be had without any extra, so that `from mjrec import *` works there too;
# `DmEnvMonitor` needs dm_env.
__all__ = [
    "ArchiveError",
    "ArchiveTooLarge",
    "BlankVideo",
    "Check",
    "ClosedError",
    "Comparison",
    "DifferentEnvironment",
    "DifferentEvaluation",
    "DirectoryInUse",
    "DirectoryNotWritable",
    "EncoderError",
    "EnvironmentNotMade",
    "Episode",
    "Error",
    "Evaluation",
    "ExistingRecordings",
    "FileNotWritten",
    "FrameCountError",
    "GLError",
    "GymnasiumMonitor",
    "IdentityLeft",
    "InvalidArgument",
    "InvalidFrame",
    "LocalEngine",
    "MissingDependency",
    "Monitor",
    "NoPictures",
    "NotPicklable",
    "PackError",
    "PicturesDiffer",
    "PolicyError",
    "RayEngine",
    "Recovery",
    "RenderError",
    "RenderedVideos",
    "ResetNeeded",
    "ResetNotAllowed",
    "SlurmEngine",
    "StatsRecorder",
    "Terminated",
    "Trajectory",
    "UnfinishedRecordings",
    "UnknownName",
    "UnreadableArchive",
    "UnreadableFile",
    "UntrustedModel",
    "VectorMonitor",
    "Verification",
    "VideoRecorder",
    "VideoWriter",
    "capped_cubic_video_schedule",
    "clear_monitor_files",
    "compare",
    "detect_monitor_files",
    "detect_training_manifests",
    "disable_videos",
    "evaluate",
    "exit_on_signals",
    "film_strip",
    "iter_episodes",
    "load_results",
    "load_trajectory",
    "merge_stats_files",
    "pack",
    "recover",
    "render",
    "render_states",
    "render_videos",
    "save_video",
    "use_gl",
    "verify",
    "write_archive",
    "write_report",
]


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
    # Kept, so that later uses cost nothing.
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
