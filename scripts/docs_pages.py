# SPDX-License-Identifier: Apache-2.0
"""A hook for mkdocs.yml that generates pages from the program itself.

The page of commands comes from their parsers, the page of Python names from
`mjrec.__all__` and the docstrings, and the page of OpenGL errors from the table that
`mjrec doctor` uses. The changelog and the measured figures are copied.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import os
import re
import textwrap
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]

# The groups of Python names on their page. A test checks that each public name is in
# exactly one group.
GROUPS = {
    "Record": (
        "Monitor GymnasiumMonitor VectorMonitor DmEnvMonitor use_gl exit_on_signals "
        "Terminated capped_cubic_video_schedule disable_videos"
    ),
    "Render": (
        "load_trajectory Trajectory render render_states render_videos RenderedVideos "
        "recover Recovery film_strip write_replay Replay VideoWriter save_video"
    ),
    "Read results": (
        "load_results iter_episodes Episode detect_training_manifests "
        "detect_monitor_files clear_monitor_files merge_stats_files"
    ),
    "Evaluate": "evaluate Evaluation compare Comparison Bootstrap write_report",
    "Engines": "LocalEngine RayEngine SlurmEngine",
    "Share": "pack verify Verification Verdict Finding write_archive",
    "gym's recorders": "StatsRecorder VideoRecorder",
}
# Public names in other modules.
MODULES = {
    "All monitors": ("mjrec.monitors.base", "EnvironmentMonitor"),
    "Trackers": (
        "mjrec.trackers",
        "Tracker TensorBoardTracker WandbTracker MonitorCsvTracker Run FinishedEpisode "
        "FinishedVideo",
    ),
    "OpenGL": ("mjrec.gl", "render_on_given_gpu diagnose Diagnosis Probe EglDevice"),
    "What mjrec doctor finds": (
        "mjrec.machine_report",
        "MachineReport Package Ffmpeg Cpus",
    ),
}

# Messages as users see them, each with the backend that prints it.
GL_MESSAGES = (
    ("glfw", "an OpenGL platform library has not been loaded into this process"),
    ("glfw", "gladLoadGL error"),
    ("glfw", "GLFWError: (65550) b'X11: The DISPLAY environment variable is missing'"),
    ("glfw", "GLFWError: (65537) b'The GLFW library is not initialized'"),
    ("glfw", "GLFWError: (65542) b'GLX: No GLXFBConfigs returned'"),
    ("egl", "'NoneType' object has no attribute 'eglQueryString'"),
    ("osmesa", "'NoneType' object has no attribute 'glGetError'"),
    ("egl", "Cannot initialize a EGL device display"),
    ("egl", "Cannot initialize a headless EGL display"),
    ("egl", "Cannot use EGL rendering platform"),
    ("", "'GLXPlatform' object has no attribute 'EGL'"),
    (
        "egl",
        "The MUJOCO_EGL_DEVICE_ID environment variable must be an integer between 0 "
        "and 3 (inclusive), got 7",
    ),
    ("", "invalid value for environment variable MUJOCO_GL: gpu"),
    (
        "",
        "module 'mujoco.rendering.classic.gl_context' has no attribute 'GLContext'",
    ),
    ("", "'MjModel' object has no attribute 'flex_vertedge'"),
    ("", "No module named 'OpenGL'"),
    ("", "Image width 1280 > framebuffer width 640"),
    ("", "Offscreen framebuffer is not complete, error 0x8cdd"),
    ("", "OpenGL error 0x502 in or before mjr_makeContext"),
    ("", "EGL_BAD_ACCESS"),
    ("", "Cannot make context <EGLContext> current on thread"),
    ("", "failed to open /dev/dri/renderD128: Permission denied"),
    ("", "EGLError: <exception str() failed>"),
)
# Environment variables without which a message has a different cause.
_GL_ENVIRONMENTS = {
    "GLContext'": {"MUJOCO_GL": "off"},
    "Cannot use": {"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "osmesa"},
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    pages = {
        "reference/commands.md": commands_page(),
        "reference/api.md": api_page(),
        "reference/opengl-errors.md": gl_page(),
        "reference/figures.md": (ROOT / "benchmarks" / "RESULTS.md").read_text(
            encoding="utf-8"
        ),
        "changelog.md": (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
    }
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def commands_page() -> str:
    """Return the page of the command line, with the help texts of its parsers."""
    from mjrec.commands import COMMANDS

    parts = ["# Commands\n", _block(_help())]
    for name in COMMANDS:
        parts += [f"## mjrec {name}\n", _block(_help(name))]
    return "\n".join(parts)


def _block(text: str) -> str:
    return f"```text\n{text}\n```\n"


def _help(*command: str) -> str:
    """Return what `mjrec [COMMAND] --help` prints in a terminal of 80 columns."""
    from mjrec.commands import main

    out = io.StringIO()
    # tyro and argparse read the line width from the environment.
    earlier = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "80"
    try:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            main([*command, "--help"])
    finally:
        os.environ.pop("COLUMNS")
        if earlier is not None:
            os.environ["COLUMNS"] = earlier
    plain = re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue()).strip()
    # tyro does not wrap paragraphs.
    return "\n".join(
        textwrap.fill(line, 80) if len(line) > 80 else line
        for line in plain.splitlines()
    )


def api_page() -> str:
    """Return the page of all public names, with references to their docstrings."""
    import mjrec

    lines = [
        "# Python",
        "",
        "`import mjrec` loads nothing heavy; each name loads its own.",
    ]
    for group, names in GROUPS.items():
        lines += ["", f"## {group}", ""]
        for name in names.split():
            lines.append(f"::: mjrec.{mjrec._LAZY[name]}.{name}\n")
    for group, (module, names) in MODULES.items():
        lines += ["", f"## {group}", ""]
        lines += [f"::: {module}.{name}\n" for name in names.split()]
    lines += ["", "## Errors", "", *_errors()]
    return "\n".join(lines) + "\n"


def _errors() -> list[str]:
    from mjrec import errors

    drawn = inspect.cleandoc(errors.__doc__ or "")
    return ["```text", *drawn.splitlines(), "```"]


def gl_page() -> str:
    """Return the page of OpenGL errors, with their causes and fixes."""
    from mjrec.gl import diagnose

    lines = [
        "# OpenGL errors",
        "",
        "`mjrec doctor` and `mjrec.gl.diagnose(text)` explain these messages.",
        "",
    ]
    # Messages with the same cause and fix are grouped.
    answers: dict[tuple[str, str], list[str]] = {}
    for backend, message in GL_MESSAGES:
        environ = next(
            (e for part, e in _GL_ENVIRONMENTS.items() if part in message), {}
        )
        found = diagnose(message, backend=backend or None, environ=environ)
        assert found is not None, message
        answers.setdefault((found.cause, found.fix), []).append(message)
    for (cause, fix), messages in answers.items():
        lines += [f"**`{message}`**  " for message in messages]
        lines += ["", cause, "", *_fix(fix), ""]
    lines += [
        "**It hangs**",
        "",
        "A process was forked after it had rendered (`AsyncVectorEnv` without "
        '`context="spawn"`), or the driver hangs. Use spawn instead, and fewer '
        "processes per GPU.",
        "",
        "**Black frames**",
        "",
        "They were rendered on a thread other than the one that created the context.",
        "",
        "**Slow despite a GPU**",
        "",
        "llvmpipe renders on the CPU instead of the GPU's driver. See "
        "[Choose a GPU](../howto/headless.md#choose-a-gpu).",
    ]
    return "\n".join(lines) + "\n"


def _fix(text: str) -> list[str]:
    """Return a fix as Markdown lines, with each command indented on its own line."""
    lines: list[str] = []
    for line in text.strip().splitlines():
        if line.startswith("  ") and (not lines or not lines[-1].startswith("    ")):
            lines.append("")
        lines.append(
            f"    {line.strip()}" if line.startswith("  ") else f"{line.strip()}"
        )
    return lines
