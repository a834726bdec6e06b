"""The walls between the rooms: what each module loads, names, and how long it may be."""

import ast
import builtins
import dis
import importlib
import inspect
import pkgutil
import subprocess
import sys
from pathlib import Path
from types import CodeType

import pytest

import flx

SOURCES = sorted(Path(flx.__file__).parent.rglob("*.py"))


@pytest.mark.parametrize(
    "module",
    [
        "flx.types",
        "flx.config",
        "flx.geometry.copies",
        "flx.assets.read",
        "flx.assets.vase",
        "flx.commands.doctor",
        "flx.commands.train",
        "flx.commands.sample",
        "flx.pipeline.workers",
    ],
)
def test_geometry_and_the_command_line_load_no_jax(module):
    """Copies are built in processes that import this much; `--help` is quick."""
    code = f"import sys, {module}; print([m for m in ('jax', 'flax') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_the_processes_that_make_copies_load_little_of_the_command_line():
    """They load the file that was started; and until it is loaded, no signal is answered."""
    loaded = python("import sys, flx.launch; print(*sys.modules)").split()
    assert "flx.launch" in loaded and not {"numpy", "scipy", "tyro", "jax"} & set(loaded)


def python(code: str) -> str:
    """What a new process prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_flx_loads_itself_and_the_standard_library():
    """So it costs next to nothing: the rest is loaded where it is used."""
    code = "import sys; before = set(sys.modules); import flx; print(*sorted(set(sys.modules) - before))"
    loaded = {name.split(".")[0] for name in python(code).split()}
    assert "flx" in loaded and loaded - {"flx"} <= sys.stdlib_module_names


POSIX = ["fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"]  # Windows has none of these


@pytest.mark.slow
def test_every_module_loads_where_there_is_no_posix():
    code = (
        f"import importlib, pkgutil, sys; sys.modules.update(dict.fromkeys({POSIX!r})); import flx\n"
        "for m in pkgutil.walk_packages(flx.__path__, 'flx.'): importlib.import_module(m.name)\n"
        "print(len([name for name in sys.modules if name.startswith('flx.')]))"
    )
    assert int(python(code)) >= len(SOURCES) - 1


def test_what_windows_lacks_is_only_tried():
    """Inside functions too, where loading a module does not look."""
    found = []
    for path in SOURCES:
        tree = ast.parse(path.read_text())
        tried = {id(n) for t in ast.walk(tree) if isinstance(t, ast.Try) for s in t.body for n in ast.walk(s)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Import | ast.ImportFrom) and id(node) not in tried:
                of = [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
                found += [f"{path.name}: {name}" for name in of if name in POSIX]
    assert not found


def test_no_file_is_longer_than_a_reader_takes_in_at_once():
    """400 lines, unless the first line is a comment that says why it is more than 400."""
    assert len(SOURCES) > 60
    for path in SOURCES:
        first, *rest = path.read_text().splitlines()
        assert len(rest) < 400 or (first.startswith("#") and "400" in first), path


def global_names(code: CodeType) -> set[str]:
    """The global names that the functions of a piece of code use."""
    names = {step.argval for step in dis.get_instructions(code) if step.opname == "LOAD_GLOBAL"}
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return names.union(*map(global_names, inner))


@pytest.mark.parametrize("name", [m.name for m in pkgutil.walk_packages(flx.__path__, "flx.")])
def test_every_global_name_is_defined(name):
    """Linters take a shape, such as "N", for the name of a type: they cannot look for names that are not."""
    module = importlib.import_module(name)
    used = global_names(compile(inspect.getsource(module), name, "exec"))
    assert {n for n in used if not hasattr(module, n) and not hasattr(builtins, n)} == set()


# Calls that run what they are given. An Unpickler of one's own, which says what it finds, is none.
CODE = {"eval", "exec", "compile", "__import__", "pickle.load", "pickle.loads", "pickle.Unpickler"}
MODULES = {"cloudpickle", "dill", "joblib", "marshal", "shelve", "torch", "yaml"}


def test_only_configs_are_code():
    """Read from the sources: no unpickler, and one place that runs a file, the config's."""
    found = []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = (
                    [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
                )
                found += [f"{path.name}: {name}" for name in names if name.split(".")[0] in MODULES]
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                if name in CODE or name.endswith(".exec_module"):
                    found.append(f"{path.name}: {name}")
                refused = any(
                    k.arg == "allow_pickle" and ast.unparse(k.value) == "False" for k in node.keywords
                )
                if name in ("np.load", "numpy.load") and not refused:
                    found.append(f"{path.name}: {name}")
    assert found == ["config.py: spec.loader.exec_module"]
