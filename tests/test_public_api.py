# SPDX-License-Identifier: Apache-2.0
"""Test the package's layers, its public names, and what importing it loads."""

import ast
import importlib.metadata
from pathlib import Path

import pytest
from other_python import run_python

import mjrec
from mjrec import errors

PACKAGE = Path(mjrec.__file__).parent

# Rows are listed bottom-up; a module may import from its own row and those below.
ROWS = (
    {
        *("errors", "json_text", "rates", "frames", "schedules", "atomic_files"),
        *("worker_thread", "gl", "machine", "blank_frames", "timeouts", "signals"),
        *("annotation", "plain_text", "provenance"),
        *("child_python", "messages", "sandbox", "confined"),
    },
    {"engines"},
    {"formats"},
    {"results"},
    {"simulation"},
    {"recorder"},
    {"rendering"},
    {"trackers"},
    {"environments"},
    {"monitors"},
    {"sessions", "machine_report"},
    {"evidence", "evaluation"},
    {"viewing"},
    {"reporting"},
    {"commands"},
)

# Each framework may be imported only by these rows or files.
CONFINED = {
    "mujoco": {"simulation", "viewing"},
    "OpenGL": {"simulation"},
    "gymnasium": {"environments", "monitors"},
    "dm_env": {"environments", "monitors"},
    "dm_control": {"environments"},
    "imageio": {"evidence", "reporting"},
    "imageio_ffmpeg": {"formats"},
    "h5py": {"formats", "evidence"},
    "tyro": {"commands"},
    "scipy": {"evaluation", "viewing"},
    "rich": {"commands", "monitors"},
    "ray": {"engines.ray"},
    "submitit": {"engines.slurm"},
    "viser": {"viewing"},
    "mjviser": {"viewing"},
    "trimesh": {"viewing"},
}

HEAVY = (
    *("mujoco", "gymnasium", "dm_control", "dm_env", "OpenGL", "imageio_ffmpeg"),
    *("h5py", "imageio", "ray", "submitit", "viser", "mjviser", "trimesh"),
)

# The keys are dotted names relative to the package.
MODULES = {
    ".".join(part for part in parts if part != "__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
    if (parts := path.relative_to(PACKAGE).with_suffix("").parts)
    not in (("__init__",), ("__main__",))
}


def imports(name, path):
    """Yield the absolute names of a module's imports, even of those in functions."""
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Call):
            yield from _imported_by_call(node, package)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module or ""
        elif isinstance(node, ast.ImportFrom):
            base = ["mjrec", *package[: len(package) - node.level + 1]]
            module = [*base, *filter(None, [node.module])]
            for alias in node.names:
                yield ".".join([*module, alias.name] if not node.module else module)


def _imported_by_call(call, package):
    """Yield the module that `import_module("..a.b", __package__)` would import."""
    function = ast.unparse(call.func).rpartition(".")[2]
    first = call.args[0] if call.args else None
    if function == "import_module" and isinstance(first, ast.Constant):
        dots = len(first.value) - len(first.value.lstrip("."))
        base = ["mjrec", *package[: len(package) - dots + 1]] if dots else []
        yield ".".join([*base, first.value.lstrip(".")])


def row(name):
    return next(i for i, names in enumerate(ROWS) if name.split(".")[0] in names)


IMPORTED = {name: {*imports(name, path)} for name, path in MODULES.items()}
OURS = {
    name: {each.removeprefix("mjrec.") for each in all_ if each.startswith("mjrec.")}
    for name, all_ in IMPORTED.items()
}


def test_modules_import_only_from_rows_below():
    pairs = [(name, each) for name in OURS for each in OURS[name]]
    assert [(name, each) for name, each in pairs if row(each) > row(name)] == []


def test_frameworks_stay_in_their_rows():
    assert [
        (name, imported)
        for name in IMPORTED
        for imported in IMPORTED[name]
        if (allowed := CONFINED.get(imported.split(".")[0])) is not None
        and allowed.isdisjoint({name, name.split(".")[0]})
    ] == []


def test_all_names_exist_and_are_sorted():
    assert mjrec.__all__ == sorted(mjrec.__all__)
    for name in mjrec.__all__:
        assert getattr(mjrec, name) is not None
    assert mjrec.__version__ == importlib.metadata.version("mjrec")
    assert "__version__" in dir(mjrec)
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = mjrec.no_such_name


def test_every_error_is_public_and_in_the_error_tree():
    assert {"Error", "InvalidFrame", "UntrustedModel"} <= errors.KINDS.keys()
    tree = errors.__doc__ or ""
    for name, kind in errors.KINDS.items():
        assert name in mjrec.__all__
        assert getattr(mjrec, name) is kind
        assert name in tree


def test_import_is_inert():
    """Importing mjrec loads no simulator, OpenGL or ffmpeg; a monitor loads no HDF5."""
    assert run_python(
        "import os, sys; before = dict(os.environ); import mjrec; "
        f"print([m for m in {HEAVY} if m in sys.modules], before == os.environ); "
        "import mjrec.monitors.gymnasium_monitor; print('h5py' in sys.modules)"
    ).stdout.split() == ["[]", "True", "False"]


def test_reading_results_needs_no_simulator():
    assert run_python(
        "import sys; "
        f"sys.modules.update(dict.fromkeys({HEAVY})); "
        "import mjrec; mjrec.load_results, mjrec.iter_episodes, mjrec.write_archive; "
        "mjrec.StatsRecorder, mjrec.capped_cubic_video_schedule; print('read')"
    ).stdout.split() == ["read"]


def test_no_module_hides_a_public_name():
    """A submodule with the name of a public object would replace it when imported."""
    assert run_python(
        "import contextlib, importlib, importlib.util, pkgutil, types, mjrec\n"
        "lacks = not importlib.util.find_spec('dm_control')\n"
        "missing = (ModuleNotFoundError, mjrec.MissingDependency) * lacks\n"
        "for module in pkgutil.walk_packages(mjrec.__path__, 'mjrec.'):\n"
        "    if module.name != 'mjrec.__main__':\n"
        "        with contextlib.suppress(*missing):\n"
        "            importlib.import_module(module.name)\n"
        "names = {name: getattr(mjrec, name) for name in mjrec.__all__}\n"
        "print([n for n, v in names.items() if isinstance(v, types.ModuleType)])\n"
        "print([n for n, where in mjrec._LAZY.items() if n in names and names[n] "
        "is not getattr(importlib.import_module('mjrec.' + where), n)])"
    ).stdout.split() == ["[]", "[]"]
