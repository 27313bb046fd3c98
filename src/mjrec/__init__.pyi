# SPDX-License-Identifier: Apache-2.0
"""The public names, by module; `__init__.py` imports a module on first use of a name.

All errors are public too.
"""

from .engines.local import LocalEngine as LocalEngine
from .engines.ray import RayEngine as RayEngine
from .engines.slurm import SlurmEngine as SlurmEngine
from .errors import *  # noqa: F403
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

__version__: str
