# SPDX-License-Identifier: Apache-2.0
"""mjrec: a headless MuJoCo recorder.

Importing this package imports no simulator, no OpenGL and no ffmpeg, and changes no
environment variable; each name below is loaded when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from . import errors
from .errors import ArchiveError as ArchiveError
from .errors import ArchiveTooLarge as ArchiveTooLarge
from .errors import BlankVideo as BlankVideo
from .errors import ClosedError as ClosedError
from .errors import DifferentEnvironment as DifferentEnvironment
from .errors import DifferentEvaluation as DifferentEvaluation
from .errors import DirectoryInUse as DirectoryInUse
from .errors import DirectoryNotWritable as DirectoryNotWritable
from .errors import EncoderError as EncoderError
from .errors import EnvironmentNotMade as EnvironmentNotMade
from .errors import Error as Error
from .errors import ExistingRecordings as ExistingRecordings
from .errors import FileNotWritten as FileNotWritten
from .errors import FrameCountError as FrameCountError
from .errors import GLError as GLError
from .errors import IdentityLeft as IdentityLeft
from .errors import InvalidArgument as InvalidArgument
from .errors import InvalidFrame as InvalidFrame
from .errors import MissingDependency as MissingDependency
from .errors import NoPictures as NoPictures
from .errors import NotPicklable as NotPicklable
from .errors import PackError as PackError
from .errors import PicturesDiffer as PicturesDiffer
from .errors import PolicyError as PolicyError
from .errors import RenderError as RenderError
from .errors import ResetNeeded as ResetNeeded
from .errors import ResetNotAllowed as ResetNotAllowed
from .errors import UnfinishedRecordings as UnfinishedRecordings
from .errors import UnknownName as UnknownName
from .errors import UnreadableArchive as UnreadableArchive
from .errors import UnreadableFile as UnreadableFile
from .errors import UntrustedModel as UntrustedModel

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
    from .formats.video_writer import VideoWriter as VideoWriter
    from .formats.video_writer import save_video as save_video
    from .gl import use_gl as use_gl
    from .monitors import Monitor as Monitor
    from .monitors.dm_env_monitor import DmEnvMonitor as DmEnvMonitor
    from .monitors.gymnasium_monitor import GymnasiumMonitor as GymnasiumMonitor
    from .monitors.vector_monitor import VectorMonitor as VectorMonitor
    from .recorder.stats_recorder import StatsRecorder as StatsRecorder
    from .recorder.video_recorder import VideoRecorder as VideoRecorder
    from .rendering.recovery import Recovery as Recovery
    from .rendering.recovery import recover as recover
    from .rendering.render_frames import render as render
    from .rendering.render_frames import render_states as render_states
    from .rendering.render_videos import RenderedVideos as RenderedVideos
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
    "Recovery": "rendering.recovery",
    "RenderedVideos": "rendering.render_videos",
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
    "render": "rendering.render_frames",
    "render_states": "rendering.render_frames",
    "render_videos": "rendering.render_videos",
    "save_video": "formats.video_writer",
    "use_gl": "gl",
    "verify": "evidence.verifying",
    "write_archive": "formats.archive",
    "write_report": "reporting.report_folder",
}

# What can be had without any extra, so that `from mjrec import *` works there too;
# `DmEnvMonitor` needs dm_env.
__all__ = sorted({*errors.KINDS, *_LAZY} - {"DmEnvMonitor"})


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
